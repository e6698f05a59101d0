"""Meshing: every node of the grid against coarse to fine.

Run: python benchmarks/meshing.py [--resolutions 128 256]

Prints for each field and resolution the evaluations and seconds of both ways (one core), and how many
vertices of the dense mesh the coarse-to-fine mesh lacks. Fields: analytic distances, exact distances to
procedural chairs, and a random network of 5 x 128 ReLU units.
"""

import argparse
import itertools
import time

import igl
import numpy as np
import torch
from scipy.spatial import cKDTree

from sdfhub.data.procedural import generate
from sdfhub.geometry.mesher import mesh_dense, mesh_field

TOLERANCE = 1e-6


class Counted:
    """A field that counts the points it is asked for."""

    def __init__(self, field):
        self.field, self.count = field, 0

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        self.count += len(points)
        return self.field(points)


def sphere(points: torch.Tensor) -> torch.Tensor:
    return points.norm(dim=-1) - 0.6


def rods(points: torch.Tensor) -> torch.Tensor:
    """Nine leaning rods of radius 0.01, thinner than two steps of a 128^3 grid: it sees them in pieces."""
    x, y, z = points.T
    x, y = x - 0.2 * z, y + 0.1 * z
    across, along = (a - 0.3 * (a / 0.3).round().clamp(-1, 1) for a in (x, y))
    return torch.maximum(torch.hypot(across, along) - 0.01, z.abs() - 0.7)


def random_network(seed: int = 0) -> torch.nn.Module:
    """5 x 128 ReLU units, untrained, shifted so that about half of the cube is inside."""
    torch.manual_seed(seed)
    widths = [3, *[128] * 5]
    layers = [(torch.nn.Linear(a, b), torch.nn.ReLU()) for a, b in itertools.pairwise(widths)]
    network = torch.nn.Sequential(*itertools.chain(*layers), torch.nn.Linear(128, 1), torch.nn.Flatten(0))
    with torch.no_grad():
        network[-2].bias -= network(torch.rand(4096, 3) * 2 - 1).median()
    return network


def chair(index: int):
    """Exact distances to a procedural chair in the normalised frame."""
    vertices, faces = generate("chairs", index)
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices /= 1.03 * np.linalg.norm(vertices, axis=1).max()
    kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL  # exact: these meshes are closed and one shell

    def field(points: torch.Tensor) -> torch.Tensor:
        distance = igl.signed_distance(points.double().numpy(), vertices, faces, sign_type=kind)[0]
        return torch.from_numpy(distance)

    return field


def timed(mesh, field, resolution: int):
    counted, start = Counted(field), time.perf_counter()
    vertices, _ = mesh(counted, resolution)
    return vertices, counted.count, time.perf_counter() - start


def without_partner(points: np.ndarray, others: np.ndarray) -> int:
    if not (len(points) and len(others)):
        return len(points)
    return np.count_nonzero(cKDTree(others).query(points)[0] > TOLERANCE)


def compare(name: str, field, resolution: int) -> None:
    dense, all_nodes, dense_seconds = timed(mesh_dense, field, resolution)
    sparse, nodes, seconds = timed(mesh_field, field, resolution)
    missed, extra = without_partner(dense, sparse), without_partner(sparse, dense)
    evaluations = f"{all_nodes / 1e6:>10.2f}{nodes / 1e6:>10.3f}"
    clock = f"{dense_seconds:>10.2f}{seconds:>10.2f}"
    print(f"{name:<12}{resolution:>4}{evaluations}{clock}{len(dense):>10}{missed:>8}{extra:>7}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resolutions", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--chairs", type=int, default=2, help="exact distances to so many procedural chairs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    fields = {"sphere": sphere, "rods": rods, "relu 5x128": random_network()}
    fields |= {f"chair {i}": chair(i) for i in range(arguments.chairs)}
    print("evaluations in millions; missed and extra: vertices without a partner within 1e-6")
    print("field        res     dense    sparse   dense s  sparse s  vertices  missed  extra")
    for resolution in arguments.resolutions:
        for name, field in fields.items():
            compare(name, field, resolution)


if __name__ == "__main__":
    main()
