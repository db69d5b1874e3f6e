"""What all commands share: compose the configuration, run, and say errors in one line."""

import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from ghpt.config import plain
from ghpt.errors import GhptConfigError, GhptError
from ghpt.jobs import Job, awaited, chosen_launcher, first_of_several_ends, own_command, take_signals
from ghpt.lost import out_of_memory
from ghpt.overrides import check_overrides
from ghpt.signals import stopped_by_signals

USERS_ERRORS = (GhptError, HydraException, OmegaConfBaseException, OSError)
"""What a user can cause and mend: said in one line. Anything else is a fault of the program, with its trace."""
_FULL = "HYDRA_FULL_ERROR"
_log = logging.getLogger(__name__)


@stopped_by_signals()
def run(
    conf: Path,
    config_name: str,
    task: Callable[[dict[str, Any], Path], Any],
    summary: Callable[[Any], str],
    after: Callable[[list[Job]], Any] | None = None,
) -> None:
    """Compose ``<conf>/<config_name>.yaml`` with the command line and call ``task(config, output folder)``.

    A user's error ends the program with one line, ``error: ...``, and exit status 1; ``HYDRA_FULL_ERROR=1`` shows the
    trace. In a sweep the other jobs run on, here or in submitit's processes, and the ``summary`` of what ``task``
    returned is printed for each; then ``after`` is called here with all of them, failed ones too.
    """
    trace = os.environ.get(_FULL) == "1"
    os.environ[_FULL] = "1"  # Hydra then lets errors through, to be said here
    script = os.path.abspath(sys.argv[0])
    ended: list[Job] = []
    try:
        arguments = get_args_parser().parse_args()
        sweep, launcher = bool(arguments.multirun), "basic"
        if not (arguments.help or arguments.hydra_help or arguments.info):
            overrides = check_overrides(conf.resolve(), config_name, arguments.overrides)
            launcher = chosen_launcher(overrides, compose_only=bool(arguments.cfg))
            sys.argv += _folder_names(overrides) if sweep else []
        job = _Job(task, summary, script, os.getpid(), sweep, trace, ended)
        program = hydra.main(version_base="1.3", config_path=str(conf.resolve()), config_name=config_name)(job)
        try:
            with awaited(ended) if launcher != "basic" else nullcontext():
                program()
        finally:
            if sweep and ended:
                print("\n".join(["", "Jobs of the sweep:", *(f"  {job.name}: {job.said}" for job in ended)]))
        if sweep and ended and after is not None:
            after(ended)
    except BrokenPipeError:  # whoever read what is printed has had enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (*USERS_ERRORS, ValueError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if trace or not (isinstance(error, USERS_ERRORS) or isinstance(cause, OSError)):
            raise
        if isinstance(cause, OSError):  # Hydra makes the folder, and opens the log file in it
            error = GhptConfigError("output", _one_line(cause), "Name a folder that can be written.")
        sys.exit(f"error: {_one_line(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
    if any(job.failed for job in ended):
        sys.exit(1)


@dataclass(frozen=True)
class _Job:
    """What Hydra calls for each job: ``task``, with its errors and end. Also in another process, where it is a copy."""

    task: Callable[[dict[str, Any], Path], Any]
    summary: Callable[[Any], str]
    script: str
    process: int
    sweep: bool
    trace: bool
    ended: list[Job]

    def __call__(self, config: Any) -> Job:
        elsewhere = os.getpid() != self.process
        if elsewhere:
            take_signals()
        _quieten()
        output = Path(HydraConfig.get().runtime.output_dir)
        settings, result, said, failed = {}, None, "stopped", True
        try:
            with own_command(self.script) if self.sweep else nullcontext():
                settings = plain(config)
                with stopped_by_signals():
                    result = self.task(settings, output)
            said, failed = self.summary(result) if self.sweep else "", False
        except Exception as caught:
            if first_of_several_ends():
                sys.exit(1)
            error = out_of_memory(caught) or caught
            users = isinstance(error, USERS_ERRORS)
            if users or elsewhere:
                said = f"error: {_one_line(error)}" if users else f"error: {type(error).__name__}: {_one_line(error)}"
                _log.error(said, exc_info=elsewhere and (self.trace or not users))
            if not elsewhere and (self.trace or not users):
                raise
        except (SystemExit, KeyboardInterrupt):
            if not elsewhere:
                raise
        finally:
            self.ended.append(Job(output.name, settings, result, said, failed))
        return self.ended[-1]


def _folder_names(overrides: Sequence[Override]) -> list[str]:
    """The setting by which a job's folder is named by what the sweep changes, and by nothing else."""
    fixed = ",".join(o.key_or_group for o in overrides if not o.is_sweep_override() or "/" in o.input_line)
    return [f"hydra.job.config.override_dirname.exclude_keys=[{fixed}]"]


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
