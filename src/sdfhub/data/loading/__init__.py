"""Prepared shapes as training batches."""

from sdfhub.data.loading.batches import Augmentation as Augmentation
from sdfhub.data.loading.batches import Loading as Loading
from sdfhub.data.loading.datamodule import SdfDataModule as SdfDataModule
from sdfhub.data.loading.datamodule import ValidationShape as ValidationShape
