"""Yaml is parsed by libyaml in the tests, which compose configurations many hundred times."""

from typing import Any
from unittest.mock import patch

import omegaconf._utils
import yaml


def _loader() -> Any:
    """Return OmegaConf's loader, derived from libyaml's; the same one each time."""
    with patch.object(yaml, "SafeLoader", yaml.CSafeLoader):
        return omegaconf._utils.get_yaml_loader()


def use_libyaml() -> None:
    """Have OmegaConf, and with it Hydra, parse by libyaml, where there is one."""
    if hasattr(yaml, "CSafeLoader"):
        loader = _loader()
        omegaconf._utils.get_yaml_loader = lambda: loader
