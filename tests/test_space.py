"""A space as a library: what it says of its shapes, from a run's folder and from one file."""

import doctest
import json
import os
import shutil
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import sdfhub
import sdfhub.space
from sdfhub.checkpoint_file import LAST, read_checkpoint, write_checkpoint
from sdfhub.errors import SdfhubError
from sdfhub.opening import FORMAT, write_space
from sdfhub.shapes import Frame
from tests.ball_space import FRAME, IDS, RADII, write_ball_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_ball_run(tmp_path_factory.mktemp("balls") / "run")


@pytest.fixture(scope="module")
def space(run):
    return sdfhub.load(run, device="cpu")


@pytest.fixture(scope="module")
def exported(space, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "model.safetensors"
    write_space(space, path)
    return path


def on_axis(radius: float) -> torch.Tensor:
    return torch.tensor([[radius, 0.0, 0.0], [0.0, radius, 0.0]])


@pytest.mark.parametrize("row", range(4))
def test_a_shapes_distance_is_that_of_its_ball_by_id_row_and_code(space, row):
    points = torch.cat([on_axis(RADII[row]), on_axis(RADII[row] - 0.05)])
    by_id = space.sdf(points, IDS[row])
    assert torch.allclose(by_id, torch.tensor([0.0, 0.0, -0.05, -0.05]), atol=0.02)
    assert torch.equal(by_id, space.sdf(points.numpy(), row))
    assert torch.equal(by_id, space.sdf(points, space.codes[row]))


def test_several_shapes_at_once_are_each_alone(space):
    points = torch.rand(2, 9000, 3) - 0.5  # more than go through the decoder together
    both = space.sdf(points, [IDS[0], 2])
    alone = torch.stack([space.decoder(points[i : i + 1], space.code([s]))[0] for i, s in enumerate([0, 2])])
    assert torch.allclose(both, alone, atol=1e-6)
    assert torch.equal(both, space.sdf(points, space.codes[[0, 2]]))


def test_arrays_with_reversed_axes_are_arrays(space):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    swapped = points[:, ::-1]
    assert torch.equal(space.sdf(swapped, 0), space.sdf(swapped.copy(), 0))


def test_distances_have_gradients_by_points_and_code_and_the_weights_have_none(space):
    points, code = on_axis(0.5).requires_grad_(), space.code(1).clone().requires_grad_()
    distances = space.sdf(points, code)
    by_points, by_code = torch.autograd.grad(distances.sum(), (points, code), create_graph=True)
    assert torch.allclose(by_points, on_axis(1.0), atol=0.3), "the outward normal of a ball"
    step = 1e-2 * torch.nn.functional.normalize(by_code.detach(), dim=0)
    change = (space.sdf(points, code + step) - space.sdf(points, code - step)).sum()
    assert torch.isclose(change, 2 * step @ by_code, rtol=0.02)
    assert torch.autograd.grad(by_points.sum(), code)[0].isfinite().all(), "twice"
    assert not any(weight.requires_grad for weight in space.decoder.parameters())


def test_a_mesh_lies_in_its_sources_frame_and_in_the_normalised_one_where_none_is_known(space):
    vertices, faces = space.mesh(IDS[1], resolution=24)
    radius = np.linalg.norm(vertices - FRAME.center, axis=1)
    assert len(faces) and np.allclose(radius, RADII[1] / FRAME.scale, atol=0.05)
    for unknown in (IDS[3], space.code(3)):
        assert np.allclose(np.linalg.norm(space.mesh(unknown, 24)[0], axis=1), RADII[3], atol=0.03)


def test_meshes_together_equal_meshes_alone(space):
    together = list(space.meshes(IDS, 16))
    for shape, (vertices, faces) in zip(IDS, together, strict=True):
        alone = space.mesh(shape, 16)
        assert np.allclose(vertices, alone[0], atol=1e-5) and np.array_equal(faces, alone[1])


def test_a_frame_leads_there_and_back():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.allclose(FRAME.to_normalized(FRAME.to_source(points)), points)
    with pytest.raises(ValueError, match="scale"):
        Frame(np.zeros(3), 0.0)


def test_a_fit_to_samples_of_an_unseen_ball_finds_its_field(space):
    points = torch.rand(4000, 3) * 2 - 1
    sdf = points.norm(dim=1) - 0.475
    code = space.fit(points=points, sdf=sdf)
    near = sdf.abs() < 0.1
    assert (space.sdf(points, code) - sdf)[near].abs().mean() < 0.015
    assert torch.equal(code, space.fit(points=points.numpy(), sdf=sdf.numpy()))


@pytest.mark.parametrize("oriented", [True, False], ids=["oriented", "bare"])
def test_a_fit_to_the_surface_of_an_unseen_ball_finds_its_field(space, oriented):
    normals = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
    code = space.fit(points=0.475 * normals, normals=normals if oriented else None)
    assert space.sdf(0.475 * normals, code).abs().mean() < 0.015


def test_a_cloud_of_any_size_and_place_is_fitted_by_its_own_box(space):
    normals = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
    box = normals.amax(0) - normals.amin(0)
    normalised = (normals - (normals.amax(0) + normals.amin(0)) / 2) / 1.03
    far = space.fit(points=50 * normals + 7, normals=normals, frame="shape")
    assert (box - 2).abs().max() < 0.02
    torch.testing.assert_close(far, space.fit(points=normalised, normals=normals), rtol=0, atol=0.05)


POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (64, 3))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"points": POINTS[:5]}, "5 points"),
        ({"points": POINTS[:, :2]}, r"\[64, 3\]"),
        ({"points": POINTS, "sdf": np.zeros(4)}, r"\[64\] numbers, they are \[4\]"),
        ({"points": POINTS, "sdf": np.ones(64)}, "one side"),
        ({"points": POINTS * np.nan}, "not finite"),
        ({"points": POINTS * 20}, "fit: reaches .* from the origin"),
        ({"points": POINTS * 1e-6 + 0.5}, "in one place"),
        ({"points": POINTS, "sdf": POINTS[:, 0], "normals": POINTS}, "not both"),
    ],
)
def test_a_fit_refuses_what_it_cannot_fit(space, given, message):
    with pytest.raises(SdfhubError, match=message):
        space.fit(**given)


def test_interpolation_has_both_ends_and_equal_steps(space):
    codes = space.interpolate(IDS[0], 3, steps=5)
    assert torch.equal(codes[0], space.codes[0]) and torch.allclose(codes[-1], space.codes[3])
    assert torch.allclose(codes.diff(dim=0), (space.codes[3] - space.codes[0]).expand(4, -1) / 4, atol=1e-6)


def test_neighbours_are_the_nearest_codes_and_a_shape_is_not_its_own(space):
    distances = torch.cdist(space.codes[:1], space.codes)[0]
    order = distances.argsort()[1:].tolist()
    found = space.neighbours(IDS[0], k=9)
    assert [id for id, _ in found] == [IDS[row] for row in order]
    assert np.allclose([far for _, far in found], distances[order])
    assert space.neighbours(space.codes[2] + 1e-4, k=1)[0][0] == IDS[2]


def test_a_strangers_code_is_unusual_and_known_ones_are_not(space):
    known = space.unusual(space.codes)
    far = space.codes.mean(0) + 10 * (space.codes[0] - space.codes.mean(0))
    assert known.shape == (len(space.codes),) and known.mean() < 1.1
    torch.testing.assert_close(space.unusual(far), 100 * known[0])
    torch.testing.assert_close(space.unusual(IDS[:2]), known[:2])


def test_principal_directions_are_orthogonal_and_as_long_as_codes_spread_along_them(space):
    axes = space.principal_directions
    assert axes.shape == (3, 4), "four codes spread in three directions"
    gram = axes @ axes.T
    assert torch.allclose(gram, torch.diag(gram.diagonal()), atol=1e-5)
    along = (space.codes - space.codes.mean(0)) @ torch.nn.functional.normalize(axes, dim=1).T
    assert torch.allclose(along.std(0), axes.norm(dim=1), atol=1e-5)
    assert (axes.norm(dim=1).diff() <= 0).all()


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda space: space.sdf(on_axis(1), "balls/smal"), "it has balls/small"),
        (lambda space: space.mesh("zebra"), "it has balls/"),
        (lambda space: space.mesh(4), "rows are 0 to 3"),
        (lambda space: space.mesh(-1), "rows are 0 to 3"),
        (lambda space: space.sdf(on_axis(1), torch.zeros(5)), "tensor of 4 numbers; got"),
        (lambda space: space.sdf(on_axis(1), [0.0] * 4), "tensor of 4 numbers; got"),
        (lambda space: space.sdf(on_axis(1), []), r"got \[0\]"),
        (lambda space: space.sdf(on_axis(1), True), "no row True"),
        (lambda space: space.mesh(IDS[:2], resolution=8), "expected one shape, got several"),
        (lambda space: next(space.meshes(IDS[0])), "takes several shapes"),
        (lambda space: next(space.meshes(space.codes[0])), "takes several shapes"),
        (lambda space: space.interpolate(IDS[:2], 1, 3), "expected one shape, got several"),
        (lambda space: space.fit(POINTS, frame="unknown"), "frame='unknown': must be 'shape'"),
        (lambda space: space.interpolate(0, 1, 2.5), "steps=2.5: must be a whole number"),
        (lambda _: sdfhub.prepare_mesh("chair.obj"), "prepare_mesh takes a trimesh.Trimesh"),
        (lambda space: space.sdf(on_axis(1)[None], 0), "of B shapes"),
        (lambda space: space.sdf(torch.zeros(2, 2), 0), "points"),
        (lambda space: space.sdf("abc", 0), "numbers, got 'abc'"),
        (lambda space: space.fit("abc"), "fit: "),
        (lambda space: space.mesh(0, resolution=1), "resolution=1"),
        (lambda space: space.mesh(0, resolution=2.5), "resolution=2.5: must be a whole number"),
        (lambda space: space.interpolate(0, 1, 1), "steps=1"),
        (lambda space: space.sample(0), "n=0"),
        (lambda space: space.sample(2, seed=-1), "seed=-1"),
        (lambda space: space.sample(2, seed="a"), "seed='a'"),
        (lambda space: space.mesh(0, resolution=0), "resolution=0"),
        (lambda space: space.neighbours(0, 0), "k=0"),
    ],
)
def test_a_mistake_is_one_clear_line(space, ask, message):
    with pytest.raises(SdfhubError, match=message):
        ask(space)


def test_a_grid_that_does_not_fit_is_one_clear_line(space, monkeypatch):
    def too_large(*_, **__):
        raise MemoryError

    monkeypatch.setattr(sdfhub.space, "mesh_fields", too_large)
    with pytest.raises(SdfhubError, match="resolution=5000: there is not enough memory"):
        space.mesh(0, resolution=5000)


def test_the_examples_in_the_documentation_run(run):
    failed, tried = doctest.testmod(sdfhub.space, extraglobs={"run": run, "sdfhub": sdfhub})
    assert tried > 1 and not failed


def test_loading_leaves_the_random_numbers_of_others_alone(run):
    torch.manual_seed(7)
    wanted = torch.rand(3)
    torch.manual_seed(7)
    sdfhub.load(run)
    assert torch.equal(torch.rand(3), wanted)


def test_a_file_holds_all_that_the_run_has(space, exported):
    again = sdfhub.load(exported, device="cpu")
    points = torch.rand(50, 3) - 0.5
    assert again.ids == space.ids == tuple(IDS), "codes of augmented copies have no id"
    assert torch.equal(again.codes, space.codes) and torch.equal(again.sdf(points, 2), space.sdf(points, 2))
    assert again.config == space.config and again.model == space.model
    assert again.delta == space.delta and again.metrics == space.metrics and again.up == space.up
    assert again.metrics["train"]["summary"]["cd"]["mean"] == 1.0
    assert np.array_equal(again.mesh(IDS[1], 16)[0], space.mesh(IDS[1], 16)[0])
    assert IDS[3] not in again.frames and again.frames[IDS[0]].scale == FRAME.scale


def test_a_run_without_frames_meshes_in_the_normalised_frame(run, tmp_path):
    old = shutil.copytree(run, tmp_path / "old")
    (old / "frames.json").unlink()
    (old / "metrics.json").unlink()
    space = sdfhub.load(old)
    assert space.metrics is None
    assert np.allclose(np.linalg.norm(space.mesh(IDS[0], 16)[0], axis=1), RADII[0], atol=0.05)


@pytest.mark.parametrize("content", ["[]", '{"train": 3, "held_out": []}', '{"train": [1]}', "null", "{"])
def test_a_split_that_training_did_not_write_is_named(run, tmp_path, content):
    odd = shutil.copytree(run, tmp_path / "odd")
    (odd / "split.json").write_text(content)
    with pytest.raises(SdfhubError, match=r"config.yaml or split.json is (broken|not what training writes)"):
        sdfhub.load(odd)


@pytest.mark.parametrize(
    "content", ["[]", '{"up": "z"}', '{"up": "x", "shapes": {}}', '{"up": "z", "shapes": 3}']
)
def test_frames_that_training_did_not_write_are_refused_in_one_line(run, tmp_path, content):
    odd = shutil.copytree(run, tmp_path / "odd")
    (odd / "frames.json").write_text(content)
    with pytest.raises(SdfhubError, match="odd"):
        sdfhub.load(odd)


def test_a_folder_that_is_no_run_a_missing_one_and_a_device_that_is_not_there_are_named(run, tmp_path):
    with pytest.raises(SdfhubError, match="no such run or file"):
        sdfhub.load(tmp_path / "nowhere")
    with pytest.raises(SdfhubError, match="not a run's folder"):
        sdfhub.load(tmp_path)
    with pytest.raises(SdfhubError, match="device=cuda:99"):
        sdfhub.load(run, device="cuda:99")
    with pytest.raises(SdfhubError, match="device=abacus"):
        sdfhub.load(run, device="abacus")


def changed(space, change) -> tuple[dict, dict]:
    """Metadata and tensors of an export, changed by a function of its plain data and tensors."""
    about = json.loads(json.dumps({"model": space.model, "config": space.config}))
    about |= {"ids": IDS, "frames": {}, "up": "z", "metrics": None}
    tensors = {f"decoder.{name}": tensor.clone() for name, tensor in space.decoder.state_dict().items()}
    tensors["codes"] = space.codes.clone()
    change(about, tensors)
    return {"format": FORMAT, "about": json.dumps(about)}, tensors


STRANGERS = {
    "another class": (lambda a, t: a["model"]["decoder"].update(_target_="os.system"), "os.system"),
    "a class of another part": (
        lambda a, t: a["model"]["decoder"].update(
            encoding={"_target_": "sdfhub.model.codes.CodeTable", "shapes": 4, "size": 3}
        ),
        "encoding must be a torch.nn.Module",
    ),
    "an unknown setting": (lambda a, t: a["model"]["decoder"].update(evil=1), "decoder.evil"),
    "a decoder without end": (
        lambda a, t: a["model"]["decoder"].update(depth=10**12),
        "more than a decoder",
    ),
    "a table without end": (
        lambda a, t: a["model"]["decoder"].update(
            encoding={
                "_target_": "sdfhub.model.encodings.Hash",
                "levels": 60,
                "width": 60,
                "log2_table": 30,
                "coarsest": 60,
                "finest": 64,
            }
        ),
        "another model",
    ),
    "a number that is none": (lambda a, t: a["model"]["decoder"].update(width="wide"), "decoder.width"),
    "no decoder": (lambda a, t: a["model"].pop("decoder"), "not a shape space"),
    "an activation that is no recipe": (
        lambda a, t: a["model"]["decoder"].update(activation="sine"),
        "decoder.activation",
    ),
    "a model that is a list": (lambda a, t: a.update(model=[]), "not a shape space"),
    "another width": (lambda a, t: a["model"]["decoder"].update(width=31), "another model"),
    "a weight too many": (
        lambda a, t: t.update({"decoder.more": torch.zeros(3)}),
        "decoder.*another model|more",
    ),
    "too few codes": (lambda a, t: t.update(codes=torch.zeros(2, 4)), "codes: expected"),
    "codes that are no numbers": (lambda a, t: t.update(codes=torch.full((4, 4), torch.nan)), "finite"),
    "codes of integers": (lambda a, t: t.update(codes=torch.zeros(4, 4, dtype=torch.int64)), "float32"),
    "no codes": (lambda a, t: t.pop("codes"), "not a readable export"),
    "an id that leads out": (lambda a, t: a.update(ids=["../../x", *IDS[1:]]), "shape id"),
    "an id that is no text": (lambda a, t: a.update(ids=[1, 2, 3, 4]), "shape id"),
    "the same id twice": (lambda a, t: a.update(ids=[IDS[0], *IDS[:3]]), "must differ"),
    "a frame without size": (lambda a, t: a.update(frames={IDS[0]: [0, 0, 0, 0]}), "positive scale"),
    "a frame of text": (lambda a, t: a.update(frames={IDS[0]: "here"}), "not a shape space"),
    "no metrics": (lambda a, t: a.pop("metrics"), "not a readable export"),
    "a third axis": (lambda a, t: a.update(up="x"), "up: must be"),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_a_strangers_file_is_refused_with_one_line_that_names_it(space, tmp_path, name):
    change, message = STRANGERS[name]
    metadata, tensors = changed(space, change)
    path = tmp_path / "stranger.safetensors"
    save_file(tensors, path, metadata=metadata)
    with pytest.raises(SdfhubError, match=message) as refusal:
        sdfhub.load(path)
    assert str(path) in str(refusal.value)
    assert len(str(refusal.value)) < 400


def test_broken_files_and_files_of_another_format_are_refused(exported, tmp_path):
    content = exported.read_bytes()
    (size,) = struct.unpack("<Q", content[:8])
    broken = {
        "empty": b"",
        "half": content[: len(content) // 2],
        "a header without end": struct.pack("<Q", 2**60) + content[8:],
        "no header": struct.pack("<Q", size) + b"x" * (len(content) - 8),
        "a checkpoint": b"PK\x03\x04" + bytes(100),
    }
    for name, wrong in broken.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(wrong)
        with pytest.raises(SdfhubError, match="not a readable export"):
            sdfhub.load(path)
    other = tmp_path / "other.safetensors"
    save_file({"w": torch.zeros(2)}, other, metadata={"format": "pt"})
    with pytest.raises(SdfhubError, match="its format is 'pt'"):
        sdfhub.load(other)


def test_a_strangers_run_folder_runs_no_code(run, tmp_path):
    canary = tmp_path / "canary"

    class Stranger:
        def __reduce__(self):
            return os.system, (f"touch {canary}",)

    stranger = shutil.copytree(run, tmp_path / "stranger")
    torch.save({"state_dict": Stranger()}, stranger / "checkpoints" / "last.ckpt")
    with pytest.raises(SdfhubError, match="not a readable checkpoint"):
        sdfhub.load(stranger)
    for decoder in ({"_target_": "os.system"}, {"width": 10**9}):
        other = shutil.copytree(run, tmp_path / f"other{len(str(decoder))}")
        checkpoint = read_checkpoint(run / "checkpoints" / LAST)
        checkpoint["hyper_parameters"]["decoder"] |= decoder
        write_checkpoint(checkpoint, other / "checkpoints" / LAST)
        with pytest.raises(SdfhubError, match=str(other)):
            sdfhub.load(other)
    assert not canary.exists()


def test_points_of_other_shapes_than_the_codes_are_refused_and_none_give_none(space):
    for shapes in (1, 3):
        with pytest.raises(SdfhubError, match=rf"of B shapes, got points \[{shapes}, 5, 3\]"):
            space.sdf(torch.zeros(shapes, 5, 3), space.codes[:2])
    assert space.sdf(torch.zeros(2, 0, 3), space.codes[:2]).shape == (2, 0)
    assert space.sdf(torch.zeros(0, 3), space.codes[0]).shape == (0,)
