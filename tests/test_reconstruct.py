"""`sdfhub reconstruct` as a user runs it, in a space of balls that stands in for a trained run."""

import json
import shutil
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from sdfhub.checkpoint_file import LAST, read_checkpoint, write_checkpoint
from sdfhub.composition import plain
from sdfhub.errors import SdfhubError
from sdfhub.opening import begin_run
from sdfhub.reconstruction import calibration as calibrations
from sdfhub.reconstruction.calibration import Calibration
from sdfhub.reconstruction.reconstructor import Limits, Result
from sdfhub.scans import simulated
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.observed_scan import observe
from sdfhub.scans.scan import Scan
from sdfhub.scans.simulated import ScanKind
from sdfhub.shapes import NORMALIZED, Frame, NormalizedMesh
from sdfhub.tasks import reconstruct as task
from tests.test_fitting import ball
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed, run_command

SPACE = ["scale=tiny", "decoder.width=32", "decoder.code_size=4", "activation=siren"]
SPACE += ["encoding=none", "data.preparation.samples=4000", "data.preparation.surface_points=2000"]
QUICK = ["evidence.rows=1200", "evidence.samples=1200", "evidence.cells=24", "fit.thinning=2"]
QUICK += ["fit.probes=64", "resolution=24"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder whose codes are balls of radius 0.4 to 0.55, and whose data are chairs."""
    folder = tmp_path_factory.mktemp("space") / "run"
    config = composed(*SPACE, f"data.store={folder.parent / 'store'}", "data.workers=1")
    model, stream = build_autodecoder(config, rows=4), batches(shapes=4, per_step=4, samples=256, surface=0)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for step in range(400):
        optimizer.param_groups[0]["lr"] = 5e-3 * (1 - step / 400)  # to an end that roundings do not move
        batch = stream[step]
        loss = (model(batch.points, batch.rows) - batch.sdf).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    train, held_out = [f"chairs/000{row}" for row in range(4)], ["chairs/0007", "chairs/0009"]
    begin_run(folder, plain(config), train, held_out, {}, "z")
    checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    write_checkpoint(checkpoint, folder / "checkpoints" / LAST)
    return folder


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Three balls, one of them far away and large, and a file that is none."""
    folder = tmp_path_factory.mktemp("scans")
    away = np.random.default_rng(0).standard_normal((2000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    np.savez(folder / "oriented.npz", points=0.5 * away, normals=away)
    np.save(folder / "bare.npy", 0.45 * away)
    seen = ball(0.5)
    frame = {"center": np.array([100.0, 0, 0]), "scale": np.ones(1) / 20}
    np.savez(folder / "samples.npz", points=seen.points, sdf=seen.low, **frame)
    (folder / "broken.xyz").write_text("no numbers\n")
    (folder / "notes.txt").write_text("where they were taken\n")
    return folder


def reconstructed(run, *overrides):
    quick = [*QUICK, f"run={run}", "frame=normalised", *overrides]
    return task.reconstruct_run(composed(*quick, config_name="reconstruct"))


def test_what_can_be_read_is_reconstructed_in_its_own_frame(run, scans, tmp_path, capsys, caplog):
    results = reconstructed(run, f"scans={scans}", f"out={tmp_path}", "calibration.shapes=0")
    found = {each.name: each for each in results}
    assert {name: each.verdict for name, each in found.items()} == {
        "broken": "failed",
        "bare": "unjudged",
        "oriented": "unjudged",
        "samples": "unjudged",
    }
    assert "broken.xyz" in capsys.readouterr().err
    assert "passes over what is no scan: .txt" in caplog.text
    for name, centre, radius in (("bare", 0, 0.45), ("oriented", 0, 0.5), ("samples", [100.0, 0, 0], 10.0)):
        mesh = trimesh.load_mesh(tmp_path / f"{name}.ply")
        assert np.abs(np.linalg.norm(mesh.vertices - centre, axis=1) / radius - 1).max() < 0.15
        said = json.loads((tmp_path / f"{name}.json").read_text())
        assert len(said["code"]) == 4 and said["residual"] < 0.02 and said["mesh"] == f"{name}.ply"
        assert said["frame"][3] == [0, 0, 0, 1]
    assert [path.name for path in tmp_path.iterdir() if "broken" in path.name] == ["broken.json"]
    assert "broken.xyz" in json.loads((tmp_path / "broken.json").read_text())["reason"]


def test_a_scan_that_fails_later_leaves_what_was_found_of_it(run, scans, tmp_path):
    common = f"out={tmp_path / 'found'}", "calibration.shapes=0"
    (tmp_path / "bare.npy").write_bytes((scans / "bare.npy").read_bytes())
    both = f"scans=[{tmp_path / 'bare.npy'},{scans / 'oriented.npz'}]"
    reconstructed(run, both, *common)
    before = (tmp_path / "found" / "bare.json").read_bytes()
    (tmp_path / "bare.npy").unlink()
    verdicts = {each.name: each.verdict for each in reconstructed(run, both, *common)}
    assert verdicts == {"bare": "failed", "oriented": "unjudged"}
    assert (tmp_path / "found" / "bare.json").read_bytes() == before


def test_a_file_gives_the_same_code_alone(run, scans, tmp_path):
    common = f"out={tmp_path}", "calibration.shapes=0"
    all_of, alone = (reconstructed(run, f"scans={at}", *common) for at in (scans, scans / "bare.npy"))
    assert [each.code for each in all_of if each.name == "bare"] == [alone[0].code]


def test_limits_are_measured_once_a_run_and_kind(run, scans, tmp_path, monkeypatch):
    """The run's data are chairs, which its space of balls cannot fit: the doubts are large."""
    first = reconstructed(run, f"scans={scans / 'bare.npy'}", f"out={tmp_path}", "calibration.shapes=3")
    kept = json.loads((run / calibrations.FILE).read_text())
    (entry,) = next(iter(kept.values())).values()
    assert first[0].verdict == "fitted" and asdict(first[0].limits) == entry["limits"]
    assert len(entry["residuals"]) == len(entry["doubts"]) == len(entry["shapes"]) == 3
    assert entry["shapes"][:2] == ["chairs/0007", "chairs/0009"], "the held-out ones first"
    assert min(entry["doubts"]) > 3 * first[0].doubt
    monkeypatch.setattr(task, "unseen_shapes", lambda *_: pytest.fail("a second measurement"))
    again = reconstructed(run, f"scans={scans / 'bare.npy'}", f"out={tmp_path}", "calibration.shapes=3")
    assert again == first


def test_limits_that_cannot_be_kept_serve_the_command_that_measured_them(scans, run, monkeypatch, caplog):
    def refused(path, text):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(calibrations, "write_whole", refused)
    monkeypatch.setattr(calibrations, "FILE", "elsewhere.json")
    fitter = SimpleNamespace(
        evidence=None, fitted=lambda scans: SimpleNamespace(residuals=1.0), doubts=lambda fitted: 2.0
    )
    kind, shapes = ScanKind("samples"), [SimpleNamespace(id=id) for id in "abc"]
    monkeypatch.setattr(ScanKind, "observations", lambda self, shapes, evidence: shapes)
    measured = Calibration(3, 3.0, 2.0).limits(run, {}, [kind], fitter, lambda count: shapes)
    assert measured == {kind: Limits(1.0, 2.0)}
    assert "elsewhere.json: is not kept: Permission denied" in caplog.text
    assert not (run / "elsewhere.json").exists()


def test_without_the_runs_data_there_are_meshes_but_no_verdicts(run, scans, tmp_path, monkeypatch, caplog):
    def gone(*_):
        raise calibrations.SdfhubError("data.source.root: no such folder")

    monkeypatch.setattr(task, "unseen_shapes", gone)
    (found,) = reconstructed(run, f"scans={scans / 'samples.npz'}", f"out={tmp_path}")
    assert found.verdict == "unjudged" and found.mesh and "no such folder" in caplog.text


def test_a_limit_lies_above_what_it_was_measured_on():
    doubts = np.exp(np.random.default_rng(0).normal(-6, 0.3, 200))
    limit = Calibration(shapes=200, spread=2.5, reach=1.5).limit(doubts)
    assert (doubts <= limit).mean() > 0.98 and limit < 2 * np.exp(-6 + 2.5 * 0.3)


def test_a_limit_stays_near_the_worst_however_far_doubts_spread():
    doubts = np.array([0.001, 0.002, 0.02])
    assert Calibration(shapes=3, spread=2.5, reach=1.5).limit(doubts) == pytest.approx(0.03)


def test_neither_a_large_residual_nor_an_unlikely_code_passes():
    limits, found = Limits(residual=0.01, doubt=0.1), Result("a", residual=0.005, doubt=0.05, mesh="a.ply")
    assert found.judged(limits, True).verdict == "fitted"
    for other, reason in (({"residual": 0.02}, "residual 2.00 x"), ({"doubt": 0.3}, "doubt 3.00 x")):
        judged = replace(found, **other).judged(limits, True)
        assert judged.verdict == "doubtful" and reason in judged.reason
    assert (
        found.judged(limits, False).verdict
        == replace(found, mesh=None).judged(limits, True).verdict
        == "doubtful"
    )
    assert replace(found, residual=np.nan).judged(limits, True).verdict == "doubtful"


def test_of_each_shape_several_views_are_calibrated_and_one_of_any_other_scan():
    evidence = Evidence()
    box = trimesh.creation.box((0.9, 0.7, 0.5))
    mesh = NormalizedMesh(np.array(box.vertices), np.array(box.faces))
    shapes = [SimpleNamespace(id=id, fingerprint="f", up="z", mesh=mesh) for id in ("a", "b")]
    views = ScanKind("view").observations(shapes, evidence)
    assert len(views) == 2 * simulated.VIEWS == 4
    assert len({each.observation.points.tobytes() for each in views}) == 4
    assert len(ScanKind("bare", 1024, 0.0).observations(shapes, evidence)) == 2


def test_a_rod_is_looked_at_again_where_it_was_seen_from_its_end(monkeypatch):
    rod = trimesh.creation.box((0.03, 0.03, 1.9))
    mesh = NormalizedMesh(np.array(rod.vertices), np.array(rod.faces))
    shape = SimpleNamespace(id="rod", fingerprint="f", up="z", mesh=mesh)
    end, side = np.array([0, 0, 2.5]), np.array([2.5, 0, 0])
    sensors = iter([end, end, side])
    monkeypatch.setattr(simulated, "random_sensor", lambda *_: next(sensors))
    assert ScanKind("view").scan(shape).sensor is side
    monkeypatch.setattr(simulated, "random_sensor", lambda *_: end)
    with pytest.raises(SdfhubError, match="rod: is too thin to be seen"):
        ScanKind("view").scan(shape)


def test_limits_of_another_rule_are_not_taken(run, monkeypatch):
    before = calibrations.digest(run, {"fit": 1})
    monkeypatch.setattr(calibrations, "RULE", "residual")
    assert calibrations.digest(run, {"fit": 1}) != before


def test_scans_are_judged_by_scans_like_them():
    evidence = Evidence()
    away = np.random.default_rng(0).standard_normal((3000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    for noise, level in ((0.0, 0.0), (0.012, 0.014), (0.03, 0.028)):
        points = away * (0.6 + noise * np.random.default_rng(1).standard_normal((3000, 1)))
        target = observe(Scan(points), evidence, NORMALIZED, np.random.default_rng(0))
        assert ScanKind.of(target) == ScanKind("bare", 4096, level)


def test_a_scan_in_the_frame_of_a_known_shapes_source_comes_back_there(run, tmp_path):
    away = np.random.default_rng(0).standard_normal((2000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    known = tmp_path / "run"
    shutil.copytree(run, known)
    frames = {"chairs/0000": [10.0, 0, 0, 0.1], "chairs/0001": [0.0, 0, 0, 1.0]}
    (known / "frames.json").write_text(json.dumps({"up": "z", "shapes": frames}))
    np.save(tmp_path / "a.npy", Frame(np.array([10.0, 0, 0]), 0.1).to_source(0.5 * away))
    words = ["frame=source", f"scans={tmp_path / 'a.npy'}", f"out={tmp_path}", "calibration.shapes=0"]
    reconstructed(known, *words, "of=chairs/0000")
    mesh = trimesh.load_mesh(tmp_path / "a.ply")
    assert np.abs(np.linalg.norm(mesh.vertices - [10, 0, 0], axis=1) / 5 - 1).max() < 0.15
    for override, message in (
        ([], "of=ID"),
        (["of=chairs/0003"], "does not know where chairs/0003"),
        (["of=chairs/0001"], "reaches"),
    ):
        if message == "reaches":
            assert message in reconstructed(known, *words, *override)[0].reason
        else:
            with pytest.raises(SdfhubError, match=message):
                reconstructed(known, *words, *override)


def test_plain_words_name_the_run_and_the_scans(run, scans, tmp_path, monkeypatch, capsys):
    odd = tmp_path / "a = 'b', [c] {d} ${e} \\ é"
    odd.mkdir()
    shutil.copy(scans / "bare.npy", odd / "x=1,2.npy")
    shutil.copy(scans / "oriented.npz", tmp_path / "plain.npz")
    words = [str(run), str(odd / "x=1,2.npy"), str(tmp_path / "plain.npz")]
    rest = ["frame=normalised", f"out={tmp_path / 'out'}", "calibration.shapes=0"]
    assert run_command(monkeypatch, *words, *QUICK, *rest, task="reconstruct") == 0
    assert "unjudged" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").glob("*.ply")} == {"x=1,2.ply", "plain.ply"}


MISTAKES = {
    "frame=metres": ["frame", "metres"],
    "fit.nearest=-1": ["fit.nearest=-1"],
    "evidence.cells=2": ["evidence", "cells"],
    "resolution=1": ["resolution=1"],
    "sensor=[1,2]": ["sensor"],
    "scans=nowhere.ply": ["nowhere.ply", "no such file"],
    "fit.shrinkage=2": ["shrinkage"],
    "calibration.shapes=1": ["calibration.shapes=1", "equal to 3"],
}


@pytest.mark.parametrize("override", MISTAKES)
def test_a_mistake_is_one_line_that_names_it(run, scans, override, monkeypatch, capsys, tmp_path):
    arguments = [f"run={run}", f"scans={scans / 'bare.npy'}", f"out={tmp_path}", override]
    status = run_command(monkeypatch, *arguments, task="reconstruct")
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert status == (1 if override.startswith("scans") else 2)
    assert message.startswith("sdfhub: error: ") and all(word in message for word in MISTAKES[override])


def test_a_fit_that_is_not_there_is_refused_with_those_that_are(run, scans, monkeypatch, capsys):
    status = run_command(monkeypatch, f"run={run}", f"scans={scans}", "fit=newton", task="reconstruct")
    message = capsys.readouterr().err
    assert status == 1 and "Traceback" not in message
    assert all(word in message for word in ("fit/newton", "deepsdf", "gauss_newton"))


def test_a_run_of_another_version_is_one_line(run, scans, tmp_path, monkeypatch, capsys):
    other = tmp_path / "other"
    begin_run(other, {"seed": 0, "model": {}}, ["a"], [], {}, "z")
    weights = read_checkpoint(run / "checkpoints" / LAST)["state_dict"]
    write_checkpoint({"state_dict": weights}, other / "checkpoints" / LAST)
    status = run_command(monkeypatch, f"run={other}", f"scans={scans / 'bare.npy'}", task="reconstruct")
    message = capsys.readouterr().err.strip()
    assert (
        status == 2
        and "not a shape space that this version reads" in message
        and len(message.splitlines()) == 1
    )


def test_results_never_overwrite_a_scan(run, tmp_path):
    trimesh.creation.icosphere().export(tmp_path / "ball.ply")
    with pytest.raises(task.SdfhubError, match="overwrite"):
        reconstructed(run, f"scans={tmp_path}", f"out={tmp_path}")


def test_results_beside_their_scans_are_no_scans_and_replace_no_stranger(run, scans, tmp_path):
    shutil.copy(scans / "oriented.npz", tmp_path / "a.npz")
    words = [f"scans={tmp_path}", f"out={tmp_path}", "calibration.shapes=0"]
    for _ in range(2):
        assert [found.name for found in reconstructed(run, *words)] == ["a"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.npz", "a.ply"]
    (tmp_path / "a.json").unlink()
    with pytest.raises(task.SdfhubError, match="overwrite"):
        reconstructed(run, f"scans={tmp_path / 'a.npz'}", *words[1:])
