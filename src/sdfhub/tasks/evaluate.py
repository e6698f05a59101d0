"""Task `evaluate`: a finished run is judged again."""

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sdfhub.data.loading import SdfDataModule
from sdfhub.data.sources import Source
from sdfhub.data.splits import Split, split
from sdfhub.described import built, check
from sdfhub.errors import SdfhubError
from sdfhub.evaluation.judging import evaluate_model
from sdfhub.opening import beside, load, read_run
from sdfhub.composition import instantiate, plain, with_environment
from sdfhub.tasks.app import run_task

log = logging.getLogger(__name__)


def evaluate_run(config: DictConfig) -> dict[str, Any]:
    """Judges a finished run again, as `config` says, into `out` or a folder `evaluation` of the run."""
    run = Path(str(config.run))
    out = beside(str(run), config.out, "evaluation")
    evaluation = instantiate(config.evaluate, "evaluate")
    trained, roles_then = read_run(run)
    trust = config.trust or ()
    space, data = load(run, trust=trust), data_of(trained, trust)
    then, is_same = data.source, True
    if config.data.get("source"):  # another source, or the same with other settings
        data.source = instantiate(config.data.source, "data.source")
        is_same = plain(config.data)["source"] == trained["data"]["source"]
    data.store, data.workers = config.data.store or data.store, config.data.workers or data.workers
    # under other settings (categories, count) a source of the same name offers shapes of the same ids
    seen = set(roles_then["train"]) if data.source.name == then.name else set()
    roles = choose_shapes(data.source, roles_then if is_same else {"train": [], "held_out": []}, seen, config)
    log.info("shapes: %d of the training, %d held out", len(roles.train), len(roles.held_out))
    shapes, held_out = data.prepared(roles)
    train = {roles_then["train"].index(shape.id): shape for shape in shapes}
    delta = space.model["loss"]["delta"]
    return evaluate_model(space.decoder, space.codes, space.delta, train, held_out, evaluation, out)


def data_of(config: dict[str, Any], trust: str | tuple[str, ...] = ()) -> SdfDataModule:
    """The data that a run's config describes.

    Raises:
        SdfhubError: it describes none, or names a class of a package that is not trusted.
    """
    if "data" not in config:
        raise SdfhubError("the run's config.yaml says nothing of its data")
    data = built(with_environment(config["data"]), "data", trust, within="sdfhub.data")
    if not isinstance(data, SdfDataModule):
        raise SdfhubError("the run's config.yaml describes no data")
    return data


def choose_shapes(
    source: Source, trained: dict[str, list[str]], seen: set[str], config: DictConfig
) -> Split:
    """The shapes to judge: those of the run, those that `shapes` names, or `held_out` unseen ones.

    Args:
        source: offers them.
        trained: ids by role in the run; none where another source or other settings of it are judged.
        seen: ids that were trained on: never judged as unseen ones.
        config: the task's.

    Raises:
        SdfhubError: a shape that the source does not have.
    """
    offered = {shape.id: shape for shape in source.shapes()}
    ids = check(plain(config)["shapes"], list[str] | None, "shapes")
    count = check(config.held_out, int | None, "held_out")
    unseen = [id for id in offered if id not in seen]
    train = trained["train"]
    if ids is not None:
        train, unseen = [id for id in ids if id in train], [id for id in ids if id not in train]
        if trained_on := seen.intersection(unseen):
            raise SdfhubError(
                f"shapes: {min(trained_on)} was trained on; leave out data= to judge it as a training shape"
            )
    elif trained["train"] and count is None:
        unseen = trained["held_out"]
    elif count is not None:
        unseen = [shape.id for shape in split([offered[id] for id in unseen], 0, count, seed=0).held_out]
    for id in (*train, *unseen):
        if id not in offered:
            raise SdfhubError(
                f"shapes: {source.name} has no shape {id!r}; it has {', '.join(list(offered)[:3])} ..."
            )
    return Split([offered[id] for id in train], [offered[id] for id in unseen])


def main() -> None:
    """Console entry: `sdfhub evaluate RUN evaluate.resolution=512`."""

    def task(config: DictConfig) -> None:
        evaluate_run(config)

    run_task(task, "evaluate", positional=["run"])
