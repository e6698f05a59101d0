"""Prepared shapes as training batches. Names are imported when they are used: Lightning takes a second."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sdfhub.data.loading.batches import Augmentation, Loading
    from sdfhub.data.loading.datamodule import SdfDataModule, ValidationShape

__all__ = ["Augmentation", "Loading", "SdfDataModule", "ValidationShape"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "batches" if name in ("Augmentation", "Loading") else "datamodule"
    return getattr(import_module(f"{__name__}.{module}"), name)
