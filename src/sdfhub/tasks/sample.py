"""Task `sample`: new shapes, drawn from a Gaussian fitted to the codes of the known ones."""

from typing import Any

from omegaconf import DictConfig

from sdfhub.tasks.app import run_task
from sdfhub.composition import plain
from sdfhub.described import check
from sdfhub.tasks.gallery import write_gallery
from sdfhub.opening import beside, load
from sdfhub.tasks.words import take_words


def sample(config: dict[str, Any]) -> None:
    """The task: `config` as conf/sample.yaml has it."""
    run, seed = check(config["run"], str, "run"), check(config["seed"], Seed, "seed")
    out = check(config["out"], str | None, "out")
    resolution = check(config["resolution"], int, "resolution")
    space = load(run)
    codes = space.sample(check(config["n"], int, "n"), seed)
    nearest = [space.neighbours(code, 1)[0] for code in codes]
    for index, (id, distance) in enumerate(nearest):
        print(f"{index:03d}  nearest known shape: {id} ({distance:.4f})")
    captions = [f"new\nnearest {id}" for id, _ in nearest]
    write_gallery(space, codes, captions, beside(run, out, f"sample/seed_{seed}"), resolution)


def main() -> None:
    """Console entry: `sdfhub sample RUN n=8`."""
    take_words("run")

    def task(config: DictConfig) -> None:
        sample(plain(config))

    run_task(task, "sample")
