"""Files of checkpoints: whole or not at all, read without running code. Knows no Lightning."""

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from sdfhub.errors import SdfhubError
from sdfhub.whole_file import whole_file

LAST = "last.ckpt"  # the newest state of a training


def write_checkpoint(checkpoint: dict[str, Any], path: Path) -> None:
    content = io.BytesIO()
    torch.save(checkpoint, content)  # to memory: on a full disk torch does not say what is wrong
    with whole_file(path, beside=".checkpoint.part") as file:
        file.write(content.getbuffer())


def read_checkpoint(path: Path, map_location: Any = "cpu") -> dict[str, Any]:
    """The content of a checkpoint whose records have their checksums still; runs no code of it."""
    try:
        content = path.read_bytes()
    except OSError as error:
        why = "there is no such checkpoint" if isinstance(error, FileNotFoundError) else error.strerror
        raise SdfhubError(f"{path}: {why}; a run keeps checkpoints/{LAST}") from error
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as records:
            if any(record.compress_type != zipfile.ZIP_STORED for record in records.infolist()):
                raise ValueError("packed, which no training does")  # and may unpack to any size
            if broken := records.testzip():  # PyTorch does not look at checksums
                raise ValueError(f"{broken} has changed since it was written")
        return torch.load(io.BytesIO(content), map_location=map_location, weights_only=True)
    except Exception as error:  # torch knows a dozen kinds of damage, and advises to read it unsafely
        raise SdfhubError(f"{path}: not a readable checkpoint: damaged or none of ours") from error
