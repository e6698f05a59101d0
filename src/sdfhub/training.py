"""Training from Python: the command line's words in, a trained space out."""

from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict

from sdfhub.composition import configuration_folder, drop_replaced
from sdfhub.described import trusted_packages
from sdfhub.multirun.names import register_resolvers
from sdfhub.opening import load
from sdfhub.space import Space
from sdfhub.tasks.train import train_into


def train(overrides: Sequence[str] = (), trust: str | Sequence[str] = ()) -> Space:
    """Trains what `sdfhub train` would train by the same words, and opens the result.

    Args:
        overrides: words of the command line, such as `["experiment=fft_siren", "scale=demo"]`.
        trust: packages beside sdfhub whose classes the words name.

    Raises:
        SdfhubError: a setting that is wrong.
    """
    register_resolvers()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        config = compose("config", list(overrides), return_hydra_config=True)
    folder = Path(config.hydra.run.dir).absolute()
    with open_dict(config):
        config.hydra.runtime.output_dir = str(folder)
        HydraConfig.instance().set_config(config)
        del config["hydra"]
    drop_replaced(config, overrides)
    folder.mkdir(parents=True, exist_ok=True)
    train_into(config, folder)
    return load(folder, trust=trusted_packages(trust))
