"""Shapes of a space shown together: a strip of pictures, an animation, meshes one by one and in one scene."""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor
from tqdm import tqdm

from sdfhub.geometry.mesh_file import write_mesh, write_row
from sdfhub.geometry.picture_file import animation, contact_sheet
from sdfhub.geometry.render import render
from sdfhub.space import Space, reconstruct

COLUMNS = 8  # pictures side by side where there is no order in them


def write_gallery(
    space: Space, codes: Tensor, captions: Sequence[str], out: Path, resolution: int, animated: bool = False
) -> None:
    """Writes `strip.png`, `meshes.glb`, `meshes/NUMBER.ply` and, where asked for, `animation.gif`.

    All lie in the normalised frame: a code between two shapes, or a new one, has no source.

    Args:
        space, codes: a space and S of its codes [S, L].
        captions: S texts below which the pictures stand, of one or two lines.
        out: folder of the results.
        resolution: points along an axis of the marching-cubes grid, >= 2.
        animated: whether the codes are steps of a way, which then stays in one line.
    """
    results = reconstruct(space.decoder, codes, resolution)
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
