"""Task `prepare`: shapes of a source become samples in the store. Training calls the same on demand."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from sdfhub.data import store as stores
from sdfhub.data.shards import StoredShape
from sdfhub.data.splits import Split, split
from sdfhub.data.store import Store
from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain


@dataclass(frozen=True)
class Prepared:
    """Stored shapes by role; rejected ones have already left."""

    train: list[StoredShape]
    held_out: list[StoredShape]
    store: Store


def prepare_data(data: Mapping[str, Any], progress: bool = True) -> Prepared:
    """Lists, splits and prepares the shapes that the config's `data` group asks for; prints what came of it.

    Args:
        data: the plain `data` group.
        progress: show a bar.
    """
    shapes = check(data["shapes"], int | None, "data.shapes")
    held_out = check(data["held_out"], int, "data.held_out")
    if shapes is not None and shapes < 1:
        raise SdfhubError(f"data.shapes={shapes}: must be at least 1, or null for all")
    if held_out < 0:
        raise SdfhubError(f"data.held_out={held_out}: must not be negative")
    source = build(data["source"], "data.source", within="sdfhub.data.sources")
    preparation = build(data["preparation"], "data.preparation", within="sdfhub.data")
    roles = split(
        source.shapes(),
        train=shapes,
        test=held_out,
        seed=check(data["split_seed"], int, "data.split_seed"),
    )
    return prepare_split(source, roles, preparation, data, progress)


def prepare_split(
    source, roles: Split, preparation, data: Mapping[str, Any], progress: bool = True
) -> Prepared:
    """The stored shapes of a given split."""
    store = stores.prepare(
        source,
        roles.train + roles.test,
        preparation,
        root=check(data["store"], str, "data.store"),
        workers=check(data["workers"], int | None, "data.workers"),
        progress=progress,
    )
    train = [store[shape.id] for shape in roles.train if shape.id in store]
    held_out = [store[shape.id] for shape in roles.test if shape.id in store]
    lost = len(roles.train) + len(roles.test) - len(train) - len(held_out)
    print(
        f"data: {source.name}: {_counted(len(train))} to train on, {len(held_out)} held out"
        + (f" ({_counted(len(roles.train + roles.test))} asked for, {lost} rejected)" if lost else "")
    )
    print(f"store: {store.folder}: {store.summary()}")
    return Prepared(train, held_out, store)


def _counted(shapes: int) -> str:
    return f"{shapes} shape" + "s" * (shapes != 1)


def main() -> None:
    """Console entry: `sdfhub prepare data=open category=chairs data.shapes=null`."""

    def task(config: DictConfig) -> None:
        prepare_data(plain(config)["data"])

    run_task(task, "prepare")
