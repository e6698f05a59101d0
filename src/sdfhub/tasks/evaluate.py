"""Task `evaluate`: a finished run is judged again."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sdfhub.composition import instantiate, plain
from sdfhub.data.loading import SdfDataModule
from sdfhub.data.sources.source import Source
from sdfhub.data.splits import Split, split
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.evaluation.judging import evaluate_model
from sdfhub.opening import beside, data_of, load, read_run
from sdfhub.whole_file import refuse_unwritable


def evaluate(config: DictConfig) -> None:
    """Judges a finished run again, as `config` says, into `out` or a folder `evaluation` of the run."""
    run = Path(str(config.run))
    out = beside(str(run), config.out, "evaluation")
    evaluation = instantiate(config.evaluate, "evaluate")
    trained, data, roles_then = data_again(run, config)
    space = load(run, trust=config.trust or ())
    then, is_same = data.source, True
    if config.data.get("source"):  # another source, or the same with other settings
        data.source = instantiate(config.data.source, "data.source")
        is_same = plain(config.data)["source"] == trained["data"]["source"]
    # under other settings (categories, count) a source of the same name offers shapes of the same ids
    seen = set(roles_then["train"]) if data.source.name == then.name else set()
    roles = choose_shapes(data.source, roles_then if is_same else {"train": [], "held_out": []}, seen, config)
    shapes, held_out = data.prepared(roles)
    train = {roles_then["train"].index(shape.id): shape for shape in shapes}
    refuse_unwritable(out)
    evaluate_model(space.decoder, space.codes, space.delta, train, held_out, evaluation, out)


def data_again(run: Path, config: DictConfig) -> tuple[dict[str, Any], SdfDataModule, dict[str, list[str]]]:
    """A run's config, its data with the store and workers of a task's `config`, and its ids by role."""
    trained, roles = read_run(run)
    data = data_of(trained, config.trust or ())
    data.store, data.workers = config.data.store or data.store, config.data.workers or data.workers
    return trained, data, roles


def choose_shapes(source: Source, trained: dict[str, list[str]], seen: set[str], config: DictConfig) -> Split:
    """The shapes to judge: the run's (`trained`), those that `shapes` names, or others, none of `seen`."""
    offered = {shape.id: shape for shape in source.shapes()}
    ids = check(plain(config)["shapes"], list[str] | None, "shapes")
    count = check(config.held_out, int | None, "held_out")
    train, unseen = trained["train"], [id for id in offered if id not in seen]
    if ids is not None:
        train, unseen = [id for id in ids if id in train], [id for id in ids if id not in train]
        if trained_on := seen.intersection(unseen):
            raise SdfhubError(f"shapes: {min(trained_on)} was trained on; leave out data= to judge it so")
    elif count is not None:
        unseen = [shape.id for shape in split([offered[id] for id in unseen], 0, count, seed=0).held_out]
    elif train:
        unseen = trained["held_out"]
    if unknown := {*train, *unseen} - offered.keys():
        some = ", ".join(list(offered)[:3])
        raise SdfhubError(f"shapes: {source.name} has no shape {min(unknown)!r}; it has {some} ...")
    return Split([offered[id] for id in train], [offered[id] for id in unseen])
