"""What leaves the house: functions for other runtimes, meshes, strips and animations, by their commands."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import sdfhub
from sdfhub.composition import instantiate
from sdfhub.geometry.picture_file import animation
from sdfhub.tasks.export import as_function, function_file
from tests.ball_space import FRAME, IDS, RADII, write_ball_run
from tests.tiny import composed, run_command

TINY = ["decoder.depth=2", "decoder.width=24", "decoder.code_size=4", "decoder.inject_code=[1]"]
DECODERS = {
    "hosc and fourier": ["activation=hosc", "encoding=fourier"],
    "hash": ["activation=siren", "encoding=hash", "encoding.log2_table=6", "encoding.levels=3"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_ball_run(tmp_path_factory.mktemp("balls") / "run")


def told(monkeypatch, capsys, task: str, *words: str, expect: int = 0) -> str:
    """What a task prints, or the last line of its complaint."""
    assert run_command(monkeypatch, *words, task=task) == expect
    if not expect:
        return capsys.readouterr().out
    message = capsys.readouterr().err.strip().splitlines()
    assert len(message) == 1 and message[0].startswith("sdfhub: error: ")
    return message[0]


@pytest.mark.parametrize("words", DECODERS.values(), ids=DECODERS)
def test_an_exported_function_is_the_decoder_for_any_number_of_shapes_and_points(words):
    torch.manual_seed(0)
    decoder = instantiate(composed(*words, *TINY).decoder, "decoder").eval().requires_grad_(False)
    function = as_function(decoder)
    module = torch.export.load(io.BytesIO(function_file(function, "torch_export"))).module()
    ort = pytest.importorskip("onnxruntime")
    session = ort.InferenceSession(function_file(function, "onnx"))
    axes = {part.name: part.shape for part in (*session.get_inputs(), *session.get_outputs())}
    assert axes["points"] == ["B", "N", 3] and axes["codes"][0] == "B" and axes["sdf"] == ["B", "N"]
    for shapes, count in ((1, 1), (3, 70), (2, 5)):
        points, codes = torch.rand(shapes, count, 3) * 2 - 1, torch.randn(shapes, 4)
        wanted = decoder(points, codes)
        (by_onnx,) = session.run(["sdf"], {"points": points.numpy(), "codes": codes.numpy()})
        assert torch.allclose(module(points, codes), wanted, rtol=0, atol=2e-6)
        assert torch.allclose(torch.from_numpy(by_onnx), wanted, rtol=0, atol=2e-6)
        assert wanted.abs().max() > 1e-4


def test_without_onnx_its_export_says_what_to_install(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    message = told(monkeypatch, capsys, "export", f"run={run}", "to=onnx", expect=2)
    assert "pip install 'sdfhub[onnx]'" in message


def test_a_function_is_written_with_the_codes_beside_it(run, monkeypatch, capsys, tmp_path):
    printed = told(monkeypatch, capsys, "export", f"run={run}", f"to={tmp_path / 'balls.pt2'}")
    assert str(tmp_path / "balls.pt2") in printed
    space = sdfhub.load(tmp_path / "balls.safetensors", device="cpu")
    function = torch.export.load(tmp_path / "balls.pt2").module()
    points = torch.rand(1, 9, 3) - 0.5
    assert torch.allclose(function(points, space.code([IDS[2]])), space.sdf(points, [IDS[2]]), atol=2e-6)


def test_a_space_in_one_file_needs_no_run(run, monkeypatch, capsys):
    told(monkeypatch, capsys, "export", f"run={run}", "to=safetensors")
    path = run / "export" / "model.safetensors"
    code = f"import sys, sdfhub\nprint(*sdfhub.load({str(path)!r}).ids)\nprint('lightning' in sys.modules)"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=path.parent
    )
    assert done.stdout.splitlines() == [" ".join(IDS), "False"], done.stderr


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_meshes_are_exported_in_their_sources_frame(run, monkeypatch, capsys, tmp_path, suffix):
    words = [f"run={run}", "to=meshes", f"shapes=[{IDS[1]},2]", f"format={suffix}", "resolution=16"]
    printed = told(monkeypatch, capsys, "export", *words, f"out={tmp_path}")
    assert "2 in their source's frame" in printed
    files = sorted(path.relative_to(tmp_path / "meshes") for path in tmp_path.rglob("*.*"))
    assert [str(file) for file in files] == [f"{IDS[2]}.{suffix}", f"{IDS[1]}.{suffix}"]
    mesh = trimesh.load_mesh(tmp_path / "meshes" / f"{IDS[1]}.{suffix}")
    radius = np.linalg.norm(mesh.vertices - FRAME.center, axis=1)
    assert np.allclose(radius, RADII[1] / FRAME.scale, atol=0.1)


def test_interpolation_is_a_strip_an_animation_there_and_back_a_scene_and_meshes(
    run, monkeypatch, capsys, tmp_path
):
    words = [f"run={run}", f"a={IDS[0]}", "b=3", "steps=4", "resolution=16", f"out={tmp_path}"]
    told(monkeypatch, capsys, "interpolate", *words)
    with Image.open(tmp_path / "animation.gif") as gif:
        assert gif.n_frames == 6 and gif.info["loop"] == 0
        frames = []
        for index in range(6):
            gif.seek(index)
            frames.append(np.asarray(gif.convert("RGB"), int))
    assert np.array_equal(frames[2], frames[4]) and np.array_equal(frames[1], frames[5])
    blue = [(frame[..., 2] > frame[..., 0] + 10).sum() for frame in frames[:4]]
    assert blue == sorted(blue) and blue[0] < 0.8 * blue[3], "the ball grows"
    assert Image.open(tmp_path / "strip.png").width > 4 * 256
    radii = [
        np.linalg.norm(trimesh.load_mesh(f).vertices, axis=1).mean()
        for f in sorted(tmp_path.glob("meshes/*"))
    ]
    assert len(radii) == 4 and np.allclose([radii[0], radii[3]], [RADII[0], RADII[3]], atol=0.03)
    scene = trimesh.load_scene(tmp_path / "meshes.glb")
    assert len(scene.geometry) == 4 and scene.extents[0] > 6
    words[3] = "steps=2"
    told(monkeypatch, capsys, "interpolate", *words)
    assert len(list(tmp_path.glob("meshes/*"))) == 2, "those of the longer way are gone"


def test_sampling_and_neighbours_name_the_known_shapes_nearest(run, monkeypatch, capsys):
    printed = told(monkeypatch, capsys, "sample", f"run={run}", "n=3", "resolution=12")
    assert printed.count("nearest training shape: balls/") == 3
    assert len(list((run / "sample" / "seed_0" / "meshes").iterdir())) <= 3
    printed = told(monkeypatch, capsys, "neighbours", f"run={run}", f"of={IDS[0]}", "k=2", "resolution=12")
    assert printed.splitlines()[0].split()[0] == sdfhub.load(run).neighbours(IDS[0], 1)[0][0]
    assert (run / "neighbours" / "balls-small" / "strip.png").is_file()
    scan = run / "scan.xyz"
    away = np.random.default_rng(0).normal(size=(2000, 3))
    np.savetxt(scan, 7 + 3 * away / np.linalg.norm(away, axis=1, keepdims=True))
    printed = told(monkeypatch, capsys, "neighbours", f"run={run}", f"of={scan}", "k=1", "resolution=12")
    assert printed.splitlines()[0].split()[0] in IDS
    assert (run / "neighbours" / "scan.xyz" / "strip.png").is_file()
    np.savez(run / "view.npz", points=away[:200], sensor=np.array([0, 0, 9.0]))
    complaint = told(monkeypatch, capsys, "neighbours", f"run={run}", f"of={run / 'view.npz'}", expect=2)
    assert "view.npz: is a single view" in complaint


MISTAKES = [
    ("interpolate", ["a=balls/smal", "b=0"], "it has balls/small"),
    ("interpolate", ["a=0"], "Missing mandatory value: b"),
    ("interpolate", ["a=0", "b=1", "steps=1"], "steps=1: must be a whole number, at least 2"),
    ("interpolate", ["a=0", "b=1", "resolution=fine"], "resolution='fine'"),
    ("sample", ["n=0"], "n=0"),
    ("neighbours", ["of=9"], "rows are 0 to 3"),
    ("export", ["to=stl"], "choose safetensors, onnx, torch_export, meshes"),
    ("export", ["to=meshes", "format=stl"], "format='stl'"),
    ("export", ["to=meshes", "shapes=[cube]"], "not trained on a shape 'cube'"),
    ("export", ["to=meshes", "shapes=cube"], "not trained on a shape 'cube'"),
    ("export", ["to=meshes", "shapes=[]"], "shapes=[]"),
    ("export", ["to=meshes", "resolution=1"], "resolution=1"),
]


@pytest.mark.parametrize(("task", "words", "message"), MISTAKES, ids=[" ".join(m[1]) for m in MISTAKES])
def test_a_mistake_is_one_line_that_names_it(run, monkeypatch, capsys, task, words, message):
    assert message in told(monkeypatch, capsys, task, f"run={run}", *words, expect=2)


@pytest.mark.parametrize(
    ("word", "message"),
    [("step=3", "Could not override 'step'"), ("activation=relu", "Could not override 'activation'")],
)
def test_a_key_that_a_task_does_not_have_is_refused_by_name(run, monkeypatch, capsys, word, message):
    assert run_command(monkeypatch, f"run={run}", "a=0", "b=1", word, task="interpolate") == 1
    told = capsys.readouterr().err
    assert told.startswith(message) and "Traceback" not in told


def test_help_tells_a_tasks_own_keys(monkeypatch, capsys):
    assert run_command(monkeypatch, "--help", task="export") == 0
    keys = capsys.readouterr().out.partition("== Config ==")[2].splitlines()
    assert {"run: ???", "out: null"} <= set(keys)
    assert not any(key.startswith(("activation:", "hydra:")) for key in keys)


@pytest.mark.parametrize("task", ["export", "interpolate", "sample", "neighbours", "reconstruct"])
def test_tasks_on_a_run_have_keys_of_their_own(task):
    config = composed(config_name=task)
    assert {"run", "out"} <= set(config) and "activation" not in config


def test_a_missing_run_is_named(monkeypatch, capsys, tmp_path):
    for folder, message in ((tmp_path / "nowhere", "no such run or file"), (tmp_path, "not a run's folder")):
        assert message in told(monkeypatch, capsys, "sample", f"run={folder}", expect=2)


def test_an_animation_of_one_picture_stands_still(tmp_path):
    path = animation([np.zeros((8, 8, 3), np.uint8)], tmp_path / "one.gif")
    assert Image.open(path).n_frames == 1
