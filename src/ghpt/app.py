"""What train.py and test.py share: compose the configuration, run, and say errors in one line."""

import logging
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from ghpt.config import plain, suggest
from ghpt.errors import GhptError


def run(conf: Path, config_name: str, task: Callable[[dict[str, Any], Path], Any]) -> None:
    """Compose ``<conf>/<config_name>.yaml`` with the command line and call ``task(config, output folder)``.

    A GhptError ends the program with its message alone and exit status 1; ``HYDRA_FULL_ERROR=1`` shows the trace.
    """

    def job(config: DictConfig) -> Any:
        logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
        # Lightning's own use of torch, and an advice that memory-mapped reading has no need of
        warnings.filterwarnings("ignore", r".*treespec, LeafSpec.* is deprecated")
        warnings.filterwarnings("ignore", r".*does not have many workers")
        warnings.filterwarnings("ignore", r"Checkpoint directory .* exists and is not empty")
        output = Path(HydraConfig.get().runtime.output_dir)
        try:
            return task(plain(config), output)
        except GhptError as error:
            if os.environ.get("HYDRA_FULL_ERROR"):
                raise
            sys.exit(f"error: {error}")
        except KeyboardInterrupt:
            sys.exit(130)

    try:
        _check_keys(conf.resolve(), config_name, sys.argv[1:])
    except GhptError as error:
        sys.exit(f"error: {error}")
    hydra.main(version_base="1.3", config_path=str(conf.resolve()), config_name=config_name)(job)()


def _check_keys(conf: Path, config_name: str, arguments: list[str]) -> None:
    """Say what exists when an override names a key that does not (Hydra itself only says that it does not)."""
    words = [a for a in arguments if "=" in a and not a.startswith("-")]
    try:
        overrides = OverridesParser.create().parse_overrides(words)
        groups = [o.input_line for o in overrides if (conf / o.key_or_group).is_dir() and not o.is_sweep_override()]
        with hydra.initialize_config_dir(str(conf), version_base="1.3"):
            config = hydra.compose(config_name, overrides=groups, return_hydra_config=True)
    except HydraException:
        return  # Hydra reports these itself, with the options of a group
    for override in overrides:
        if override.is_add() or (conf / override.key_or_group).is_dir():
            continue
        node: Any = config
        for depth, part in enumerate(override.key_or_group.split(".")):
            if not isinstance(node, DictConfig) or part not in node:
                above = ".".join(override.key_or_group.split(".")[:depth])
                existing = [k for k in node if k != "hydra"] if isinstance(node, DictConfig) else []
                raise GhptError(
                    f"{override.key_or_group}: no such setting{f' in {above}' if above else ''}. "
                    + suggest(part, existing)
                )
            node = OmegaConf.select(node, part) if not OmegaConf.is_missing(node, part) else None
