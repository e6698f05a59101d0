"""Tasks `interpolate`, `sample` and `neighbours`: shapes of a space shown together."""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesh_file import write_mesh, write_row
from sdfhub.geometry.picture_file import animation, contact_sheet
from sdfhub.geometry.render import render
from sdfhub.opening import beside, load
from sdfhub.scans.scan import read_scan
from sdfhub.space import Space, reconstruct

COLUMNS = 8  # pictures side by side where there is no order in them


def interpolate(config: DictConfig) -> None:
    """The shapes on the way from one to another: `config` as conf/interpolate.yaml has it."""
    space = load(config.run, trust=config.trust or ())
    codes = space.interpolate(config.a, config.b, config.steps)
    a, b = (space.ids[space.row(shape)] for shape in (config.a, config.b))
    captions = [a, *(f"{index / (len(codes) - 1):.2f}" for index in range(1, len(codes) - 1)), b]
    name = f"{a}_to_{b}".replace("/", "-")
    write_gallery(config, space, codes, captions, f"interpolate/{name}", animated=True)


def sample(config: DictConfig) -> None:
    """New shapes, drawn from a Gaussian fitted to the training codes: `config` as conf/sample.yaml has it."""
    space = load(config.run, trust=config.trust or ())
    codes = space.sample(config.n, config.seed)
    nearest = [space.neighbours(code, 1)[0] for code in codes]
    for index, (id, distance) in enumerate(nearest):
        print(f"{index:03d}  nearest training shape: {id} ({distance:.4f})")
    captions = [f"new\nnearest {id}" for id, _ in nearest]
    write_gallery(config, space, codes, captions, f"sample/seed_{config.seed}")


def neighbours(config: DictConfig) -> None:
    """The training shapes whose codes are nearest to that of one of them, or of a scan, as conf/ says."""
    space, shape = load(config.run, trust=config.trust or ()), config.of
    path = Path(str(shape))
    if path.is_file():
        name, scan = path.name, read_scan(path)
        if scan.kind == "view":
            raise SdfhubError(f"of={shape}: is a single view; see `sdfhub reconstruct`, which takes such")
        shape = space.fit_scan(scan)
    else:
        name = space.ids[space.row(shape)]
    nearest = space.neighbours(shape, config.k)
    for id, distance in nearest:
        print(f"{id:<40} {distance:.4f}")
    captions = [f"of {name}", *(f"{id}\n{distance:.3f}" for id, distance in nearest)]
    codes = space.code([shape, *(id for id, _ in nearest)])
    write_gallery(config, space, codes, captions, f"neighbours/{name.replace('/', '-')}")


def write_gallery(
    config: DictConfig, space: Space, codes: Tensor, captions: Sequence[str], name: str, animated=False
) -> None:
    """Writes pictures, meshes (normalised frame) and maybe an animation into `out` or `name` of the run."""
    out, results = beside(config.run, config.out, name), reconstruct(space.decoder, codes, config.resolution)
    meshes = list(tqdm(results, "meshing", len(codes), leave=False, disable=None))
    pictures = [render(*mesh, up=space.up) for mesh in meshes]
    shown = [p if len(mesh.faces) else "no surface" for p, mesh in zip(pictures, meshes, strict=True)]
    columns = len(shown) if animated else COLUMNS
    rows = [shown[start : start + columns] for start in range(0, len(shown), columns)]
    contact_sheet(rows, [], captions, out / "strip.png")
    for stale in (out / "meshes").glob("[0-9][0-9][0-9].ply"):  # of a longer row
        stale.unlink()
    for index, mesh in enumerate(meshes):
        write_mesh(mesh.vertices, mesh.faces, out / "meshes" / f"{index:03d}.ply")
    write_row(meshes, space.up, out / "meshes.glb")
    if animated:
        animation(pictures, out / "animation.gif")
        print(f"animation: {out / 'animation.gif'}")
    print(f"strip:     {out / 'strip.png'}\nscene:     {out / 'meshes.glb'}\nmeshes:    {out / 'meshes'}")
