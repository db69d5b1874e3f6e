"""What train.py and test.py share: compose the configuration, run, and say errors in one line."""

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ghpt.config import plain, suggest
from ghpt.errors import GhptConfigError, GhptError

USERS_ERRORS = (GhptError, HydraException, OmegaConfBaseException, OSError)
"""What a user can cause and mend: said in one line. Anything else is a fault of the program, with its trace."""
_FULL = "HYDRA_FULL_ERROR"
_log = logging.getLogger(__name__)


def run(
    conf: Path, config_name: str, task: Callable[[dict[str, Any], Path], Any], summary: Callable[[Any], str]
) -> None:
    """Compose ``<conf>/<config_name>.yaml`` with the command line and call ``task(config, output folder)``.

    A user's error ends the program with one line, ``error: ...``, and exit status 1; ``HYDRA_FULL_ERROR=1`` shows the
    trace. In a sweep the other jobs run on, and the ``summary`` of what ``task`` returned is printed for each.
    """
    trace = os.environ.get(_FULL) == "1"
    os.environ[_FULL] = "1"  # Hydra then lets errors through, to be said here
    process, command = os.getpid(), list(sys.argv)
    jobs: list[str] = []
    failed: list[Exception] = []

    def job(config: Any) -> None:
        _quieten()
        sys.argv[:] = command
        job_of_sweep = HydraConfig.get().mode == RunMode.MULTIRUN
        output = Path(HydraConfig.get().runtime.output_dir)
        outcome = "stopped"
        try:
            outcome = summary(task(plain(config), output))
        except USERS_ERRORS as error:
            outcome = f"error: {_one_line(error)}"
            _log.error(outcome)
            failed.append(error)
            if trace or os.getpid() != process:  # a launcher's own process reports by raising
                raise
        finally:
            if job_of_sweep:
                jobs.append(f"  {output.name}: {outcome}")

    try:
        arguments = get_args_parser().parse_args()
        if not (arguments.help or arguments.hydra_help or arguments.info):
            overrides = check_overrides(conf.resolve(), config_name, arguments.overrides)
            if arguments.multirun:  # a job's folder is named by what the sweep changes, and by nothing else
                fixed = ",".join(o.key_or_group for o in overrides if not o.is_sweep_override() or "/" in o.input_line)
                sys.argv.append(f"hydra.job.config.override_dirname.exclude_keys=[{fixed}]")
        hydra.main(version_base="1.3", config_path=str(conf.resolve()), config_name=config_name)(job)()
    except (*USERS_ERRORS, ValueError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if trace or not (isinstance(error, USERS_ERRORS) or isinstance(cause, OSError)):
            raise
        if isinstance(cause, OSError):  # Hydra makes the folder, and opens the log file in it
            error = GhptConfigError("output", _one_line(cause), "Name a folder that can be written.")
        sys.exit(f"error: {_one_line(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        if jobs:
            print("\n".join(["", "Jobs of the sweep:", *jobs]))
    if failed:
        sys.exit(1)


def _quieten() -> None:
    """Leave out what Lightning says that its users can neither use nor mend."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r".*treespec, LeafSpec.* is deprecated")
    warnings.filterwarnings("ignore", r".*does not have many workers")  # reading is memory-mapped
    warnings.filterwarnings("ignore", r"torch\.distributed\.nn\.functional\.all_gather is deprecated")
    warnings.filterwarnings("ignore", r"It is recommended to use `self\.log\('validation/.*sync_dist=True")  # they are
    warnings.filterwarnings("ignore", r"Checkpoint directory .* exists and is not empty")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def check_overrides(conf: Path, config_name: str, words: Sequence[str]) -> list[Override]:
    """The parsed overrides. Raises GhptConfigError, saying what exists, for a setting or a choice that does not."""
    overrides = [_parse(word) for word in words]
    groups = {}
    for override in overrides:
        if (conf / override.key_or_group).is_dir() and not override.is_delete():
            chosen = [_check_choice(conf, override.key_or_group, value) for value in _values(override)]
            groups[override.key_or_group] = f"{override.get_key_element()}={chosen[0]}"
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        config: Any = OmegaConf.to_container(hydra.compose(config_name, overrides=list(groups.values())))
    for override in overrides:
        key = override.key_or_group
        if key not in groups and not key.startswith("hydra") and "@" not in key and not (conf / key).is_dir():
            _check_key(config, key, added=override.is_add() or override.is_force_add())
    return overrides


def _parse(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        mend = "Such as data=cmu2 or 'data.cameras=[1,2]'; --help shows all settings."
        raise GhptConfigError(word, "is not of the form key=value", mend) from None


def _values(override: Override) -> list[Any]:
    """The values that a sweep takes in turn, or the only one."""
    value = override.value()
    return list(override.sweep_string_iterator()) if override.is_sweep_override() else [value]


def _check_choice(conf: Path, group: str, value: Any) -> Any:
    existing = sorted(path.stem for path in (conf / group).glob("[!_]*.yaml"))
    for name in value if isinstance(value, list) else [value]:
        if name not in existing:
            shown = "null" if name is None else repr(name)
            raise GhptConfigError(group, f"there is no {shown}", suggest(str(name), existing))
    return value if not isinstance(value, list) else f"[{','.join(map(str, value))}]"


def _check_key(config: dict[str, Any], key: str, added: bool) -> None:
    node: Any = config
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if not isinstance(node, dict) or part not in node:
            if added and depth:
                return  # whatever is built from it knows its settings
            above = ".".join(parts[:depth])
            mend = suggest(part, node if isinstance(node, dict) else [])
            elsewhere = [path for path in _paths(config) if path.endswith(f".{parts[-1]}")]
            if elsewhere and "Did you mean" not in mend:
                mend = f"Did you mean {elsewhere[0]!r}? {mend}"
            raise GhptConfigError(key, f"no such setting{f' in {above}' if above else ''}", mend)
        node = node[part]


def _paths(node: dict[str, Any], above: str = "") -> Iterator[str]:
    for key, value in node.items():
        yield f"{above}{key}"
        if isinstance(value, dict):
            yield from _paths(value, f"{above}{key}.")
