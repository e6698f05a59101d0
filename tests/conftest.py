"""What tests of several files ask for."""

import copy

import pytest
import torch
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from sdfhub.composition import configuration_folder


@pytest.fixture(scope="session", autouse=True)
def parsed_once():
    """Hydra parses each file of conf/ once, not in each of some 600 compositions: a third of their time."""
    Plugins.instance()  # registers the sources
    source = SourcesRegistry.instance().resolve("file")
    load, parsed = source.load_config, {}

    def load_config(self, config_path):
        if self.path != str(configuration_folder()):
            return load(self, config_path)
        key = (self.provider, config_path)
        if key not in parsed:
            parsed[key] = load(self, config_path)
        return copy.deepcopy(parsed[key])

    source.load_config = load_config


@pytest.fixture(params=[2, 3])
def several(request):
    """As many threads for PyTorch."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)
