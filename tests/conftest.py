"""What tests of several files ask for."""

import copy

import pytest
import torch
from hydra._internal import defaults_list
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from sdfhub.composition import configuration_folder


@pytest.fixture(scope="session", autouse=True)
def composed_in_half_the_time():
    """Of some 600 compositions each parses no file of conf/ again, and resolves no defaults without `${`."""
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
    choices = defaults_list._create_interpolation_map

    def choices_if_needed(overrides, defaults, *rest):
        is_needed = any(default.is_interpolation() for default in defaults)
        return choices(overrides, defaults, *rest) if is_needed else None

    defaults_list._create_interpolation_map = choices_if_needed


@pytest.fixture(params=[2, 3])
def several(request):
    """As many threads for PyTorch."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)
