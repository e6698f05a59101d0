"""What the groups of conf/ name, found by walking them."""

from pathlib import Path

from hydra.utils import instantiate
from omegaconf import OmegaConf

CONF = Path(__file__).parents[1] / "conf"


def choices(group: str) -> list[str]:
    """Names of the files of a group."""
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


def rival(group: str, choice: str):
    """The object that a file of conf/ describes, at `scale=cpu`."""
    around = {
        "scale": OmegaConf.load(CONF / "scale" / "cpu.yaml").scale,
        "normals": {"tau": 0.01, "tau_start": 0.0},
    }
    config = OmegaConf.create(around | {group: OmegaConf.load(CONF / group / f"{choice}.yaml")})
    return instantiate(config[group])
