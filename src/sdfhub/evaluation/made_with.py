"""What a training ran with: versions and hardware, kept beside its scores so that both can be told."""

import platform
import re
from importlib.metadata import version
from pathlib import Path

import torch
from lightning.pytorch import Trainer

PACKAGES = ("sdfhub", "torch", "lightning", "numpy")


def made_with(trainer: Trainer) -> dict[str, str]:
    """Versions, the device that trained, its threads or processes, and the precision; plain text by name."""
    device = trainer.strategy.root_device
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "system": f"{platform.system()} {platform.machine()}",
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else _processor(),
        "threads": str(torch.get_num_threads()),
        "processes": str(trainer.world_size),
        "precision": str(trainer.precision),
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.*)", cpuinfo.read_text("utf-8")) if cpuinfo.exists() else None
    return name[1] if name else platform.processor() or "unknown"
