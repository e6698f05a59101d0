"""What a training ran with: versions and hardware, kept beside its scores so that both can be told."""

import platform
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
    """The processor's name; Python itself knows it on few systems."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
