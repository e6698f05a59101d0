"""What a training ran with, kept beside its scores."""

import platform
import re
from importlib.metadata import version
from pathlib import Path

import torch
from lightning.pytorch import Trainer


def made_with(trainer: Trainer) -> dict[str, str]:
    """Versions and hardware as plain text by name."""
    device, cpuinfo = trainer.strategy.root_device, Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.*)", cpuinfo.read_text("utf-8")) if cpuinfo.exists() else None
    processor = name[1] if name else platform.processor() or "unknown"
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in ("sdfhub", "torch", "lightning", "numpy")},
        "system": f"{platform.system()} {platform.machine()}",
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else processor,
        "threads": str(torch.get_num_threads()),
        "processes": str(trainer.world_size),
        "precision": str(trainer.precision),
    }
