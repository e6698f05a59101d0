"""Task `interpolate`: the shapes on the way from one to another."""

from typing import Any

from omegaconf import DictConfig

from sdfhub.tasks.app import run_task
from sdfhub.composition import plain
from sdfhub.described import check
from sdfhub.tasks.gallery import write_gallery
from sdfhub.opening import beside, load
from sdfhub.tasks.words import take_words


def interpolate(config: dict[str, Any]) -> None:
    """The task: `config` as conf/interpolate.yaml has it."""
    run, (a, b) = check(config["run"], str, "run"), (check(config[key], str | int, key) for key in "ab")
    out = check(config["out"], str | None, "out")
    resolution = check(config["resolution"], int, "resolution")
    space = load(run)
    codes = space.interpolate(a, b, check(config["steps"], int, "steps"))
    ends = [space.ids[space.row(shape)] for shape in (a, b)]
    shares = [index / (len(codes) - 1) for index in range(1, len(codes) - 1)]
    captions = [ends[0], *(f"{share:.2f}" for share in shares), ends[1]]
    folder = beside(run, out, "interpolate/" + "_to_".join(end.replace("/", "-") for end in ends))
    write_gallery(space, codes, captions, folder, resolution, animated=True)


def main() -> None:
    """Console entry: `sdfhub interpolate RUN A B steps=8`."""
    take_words("run", "a", "b")

    def task(config: DictConfig) -> None:
        interpolate(plain(config))

    run_task(task, "interpolate")
