"""Task `prepare`: shapes of a source become samples in the store. Training calls the same on demand."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig
from pydantic import NonNegativeInt, PositiveInt

from sdfhub.data.preparation.sampling import Preparation
from sdfhub.data.sources.source import Source
from sdfhub.data.splits import Split, split
from sdfhub.data.store import store as stores
from sdfhub.data.store.shards import StoredShape
from sdfhub.data.store.store import Store
from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain


@dataclass(frozen=True)
class Prepared:
    """Stored shapes by role; rejected ones have already left."""

    train: list[StoredShape]
    held_out: list[StoredShape]
    store: Store


def prepare_data(data: Mapping[str, Any]) -> Prepared:
    """Lists, splits and prepares the shapes that the config's `data` group asks for; prints what came of it.

    Args:
        data: the plain `data` group.
    """
    source, roles = source_and_split(data)
    preparation = build(data["preparation"], "data.preparation", within="sdfhub.data")
    return prepare_split(source, roles, preparation, data)


def source_and_split(data: Mapping[str, Any]) -> tuple[Source, Split]:
    """The source that a plain `data` group names, and its shapes by role."""
    shapes = check(data["shapes"], int | None, "data.shapes")
    held_out = check(data["held_out"], int, "data.held_out")
    if shapes is not None and shapes < 1:
        raise SdfhubError(f"data.shapes={shapes}: must be at least 1, or null for all")
    if held_out < 0:
        raise SdfhubError(f"data.held_out={held_out}: must not be negative")
    source = build(data["source"], "data.source", within="sdfhub.data.sources")
    seed = check(data["split_seed"], NonNegativeInt, "data.split_seed")
    return source, split(source.shapes(), train=shapes, test=held_out, seed=seed)


def prepare_part(data: Mapping[str, Any], part: str) -> None:
    """Prepares every n-th of the shapes that the config's `data` group asks for; prints what came of it.

    Args:
        data: the plain `data` group.
        part: `i/n`, the i-th of n parts, 1 <= i <= n.
    """
    numbers = re.fullmatch(r"(\d+)/(\d+)", part)
    i, n = map(int, numbers.groups()) if numbers else (0, 0)
    if not 1 <= i <= n:
        raise SdfhubError(f"part={part}: must be i/n with 1 <= i <= n, such as part=1/4,2/4,3/4,4/4 with -m")
    source, roles = source_and_split(data)
    preparation = build(data["preparation"], "data.preparation", within="sdfhub.data")
    own = (roles.train + roles.test)[i - 1 :: n]
    workers = check(data["workers"], PositiveInt | None, "data.workers")
    made = stores.prepare_part(source, own, preparation, check(data["store"], str, "data.store"), workers)
    print(f"part {part}: {_counted(len(own))}, {made} of them prepared now", flush=True)


def prepare_split(
    source: Source, roles: Split, preparation: Preparation, data: Mapping[str, Any]
) -> Prepared:
    """The stored shapes of a given split; prints what came of it."""
    prepared = stored_split(source, roles, preparation, data)
    asked, train, held_out = len(roles.train + roles.test), len(prepared.train), len(prepared.held_out)
    lost = asked - train - held_out
    print(
        f"data: {source.name}: {_counted(train)} to train on, {held_out} held out"
        + (f" ({_counted(asked)} asked for, {lost} rejected)" if lost else "")
    )
    print(f"store: {prepared.store.folder}: {prepared.store.summary()}")
    return prepared


def stored_split(source: Source, roles: Split, preparation: Preparation, data: Mapping[str, Any]) -> Prepared:
    """The stored shapes of a given split, without a word."""
    store = stores.prepare(
        source,
        roles.train + roles.test,
        preparation,
        root=check(data["store"], str, "data.store"),
        workers=check(data["workers"], PositiveInt | None, "data.workers"),
    )
    train = [store[shape.id] for shape in roles.train if shape.id in store]
    held_out = [store[shape.id] for shape in roles.test if shape.id in store]
    return Prepared(train, held_out, store)


def _counted(shapes: int) -> str:
    return f"{shapes} shape" + "s" * (shapes != 1)


def main() -> None:
    """Console entry: `sdfhub prepare data=open category=chairs data.shapes=null`."""

    def task(config: DictConfig) -> None:
        settings = plain(config)
        if settings["part"] is None:
            prepare_data(settings["data"])
        else:
            prepare_part(settings["data"], str(settings["part"]))

    run_task(task, "prepare")
