"""What all commands share: compose the configuration, run, and say errors in one line."""

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ghpt.commands.jobs import (
    Job,
    awaited,
    chosen_launcher,
    first_of_several_ends,
    is_first_process,
    own_command,
    take_signals,
)
from ghpt.commands.outputs import Files, OutputFolder, SweepFolder
from ghpt.commands.overrides import check_overrides
from ghpt.config import plain
from ghpt.config import settings as typed_settings
from ghpt.errors import GhptConfigError, GhptError, one_line, out_of_memory
from ghpt.files import atomic_write
from ghpt.signals import stopped_by_signals

S = TypeVar("S")
R = TypeVar("R")
USERS_ERRORS = (GhptError, HydraException, OmegaConfBaseException, OSError)
"""What a user can cause and mend: said in one line. Anything else is a fault of the program, with
its trace.
"""
_FULL = "HYDRA_FULL_ERROR"
_CONFIGURATION = ".hydra"
"""Where Hydra's users look for a run's configuration, within its output folder."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Command(Generic[S, R]):
    """What a script such as train.py does.

    ``settings`` is the frozen dataclass of all keys of the yaml, derived from `OutputSettings`;
    `run` makes it once, with `ghpt.config.settings`, and gives it to ``files``, ``task`` and
    ``after``. With ``settings=dict`` they get the plain configuration.
    """

    name: str
    """The name of the configuration file in conf/."""
    settings: type[S]
    """The type of the settings."""
    task: Callable[[S, Path], R]
    """Takes the settings and the output folder."""
    summary: Callable[[R], str]
    """Says in one line what ``task`` returned."""
    files: Callable[[S], Files]
    """Says what the settings make it read and write."""
    after: Callable[[list[Job[S, R]]], object] | None = None
    """Called after a sweep with all of its jobs, the failed ones included."""


@stopped_by_signals()
def run(conf: Path, command: Command[Any, Any]) -> None:
    """Compose ``<conf>/<command.name>.yaml`` with the command line and call ``command.task``.

    The output folder is locked and guarded meanwhile, see `ghpt.commands.outputs`. A user's error
    ends the program with one line, ``error: ...``, and exit status 1; ``HYDRA_FULL_ERROR=1`` shows
    the trace. In a sweep the other jobs run on, here or in submitit's processes, and the summary of
    each is printed; a job that finished in an earlier run of the sweep is not done again.
    """
    trace = os.environ.get(_FULL) == "1"
    os.environ[_FULL] = "1"  # Hydra then lets errors through, to be said here
    script = os.path.abspath(sys.argv[0])
    ended: list[Job[Any, Any]] = []
    try:
        arguments = get_args_parser().parse_args()
        sweep = bool(arguments.multirun)
        launcher = "basic"
        if not (arguments.help or arguments.hydra_help or arguments.info):
            overrides = check_overrides(conf.resolve(), command.name, arguments.overrides)
            launcher = chosen_launcher(overrides, compose_only=bool(arguments.cfg))
            sys.argv += _folder_names(overrides) if sweep else []
        job = _Job(command, script, os.getpid(), sweep, trace, ended)
        program = hydra.main(
            version_base="1.3", config_path=str(conf.resolve()), config_name=command.name
        )(job)
        with SweepFolder.released():
            try:
                with awaited(ended) if launcher != "basic" else nullcontext():
                    program()
            finally:
                if sweep and ended:
                    print(
                        "\n".join(
                            [
                                "",
                                "Jobs of the sweep:",
                                *(f"  {job.name}: {job.said}" for job in ended),
                            ]
                        )
                    )
            if sweep and ended and command.after is not None:
                command.after(ended)
    except BrokenPipeError:  # whoever read what is printed has had enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (*USERS_ERRORS, ValueError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if trace or not (isinstance(error, USERS_ERRORS) or isinstance(cause, OSError)):
            raise
        if isinstance(cause, OSError):  # Hydra makes the folder
            error = GhptConfigError("output", one_line(cause), "Name a folder that can be written.")
        sys.exit(f"error: {one_line(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
    if any(job.failed for job in ended):
        sys.exit(1)


@dataclass(frozen=True)
class _Job:
    """What Hydra calls for each job: the task, with its errors and end. Also in another process,
    where it is a copy.
    """

    command: Command[Any, Any]
    script: str
    process: int
    sweep: bool
    trace: bool
    ended: list[Job[Any, Any]]

    def __call__(self, config: Any) -> Job[Any, Any]:
        elsewhere = os.getpid() != self.process
        if elsewhere:
            take_signals()
        _quieten()
        output = Path(HydraConfig.get().runtime.output_dir)
        settings = None
        result = None
        said = "stopped"
        failed = True
        with ExitStack() as stack:  # the log is open until the end is in it
            try:
                values = plain(config)
                if self.sweep and values.get("resume") is False and not values.get("overwrite"):
                    values["resume"] = "auto"
                settings = self._settings(values)
                folder = stack.enter_context(self._folder(output, settings, values))
                before = folder.finished(values) if folder is not None and self.sweep else None
                if before is not None and not values.get("overwrite"):
                    said = f"{before} (finished before)"
                    failed = False
                else:
                    stack.enter_context(self._records(config, output))
                    stack.enter_context(self._as_command(values))
                    with stopped_by_signals():
                        result = self.command.task(settings, output)
                    said = self.command.summary(result) if self.sweep else ""
                    failed = False
                    if folder is not None:
                        folder.finish(values, said)
            except Exception as caught:
                if first_of_several_ends():
                    sys.exit(1)
                error = out_of_memory(caught) or caught
                users = isinstance(error, USERS_ERRORS)
                if users or elsewhere:
                    kind = "" if users else f"{type(error).__name__}: "
                    said = f"error: {kind}{one_line(error)}"
                    _log.error(said, exc_info=elsewhere and (self.trace or not users))
                if not elsewhere and (self.trace or not users):
                    raise
            except (SystemExit, KeyboardInterrupt):
                if not elsewhere:
                    raise
            finally:
                self.ended.append(Job(output.name, settings, result, said, failed))
        return self.ended[-1]

    def _settings(self, values: dict[str, Any]) -> Any:
        if self.command.settings is dict:
            return values
        return typed_settings(self.command.settings, values)

    def _folder(
        self, output: Path, settings: Any, values: dict[str, Any]
    ) -> AbstractContextManager[OutputFolder | None]:
        """The output folder, locked and guarded; None in a training's other processes."""
        if not is_first_process():
            return nullcontext()
        files = self.command.files(settings)
        configuration = tuple(
            f"{_CONFIGURATION}/{name}" for name in ("config.yaml", "hydra.yaml", "overrides.yaml")
        )
        log = f"{HydraConfig.get().job.name}.log"
        files = replace(
            files, writes=(*files.writes, *configuration), growing=(*files.growing, log)
        )
        return OutputFolder(output, files, bool(values.get("overwrite")))

    @contextmanager
    def _records(self, config: Any, output: Path) -> Iterator[None]:
        """The job's configuration is written, and within the block its log."""
        hydra_config = HydraConfig.get()
        if is_first_process():
            contents = {
                "config": config,
                "hydra": {"hydra": hydra_config},
                "overrides": hydra_config.overrides.task,
            }
            for name, content in contents.items():
                with atomic_write(output / _CONFIGURATION / f"{name}.yaml", "w") as handle:
                    handle.write(OmegaConf.to_yaml(content))
        handler = logging.FileHandler(output / f"{hydra_config.job.name}.log", encoding="utf-8")
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.root.addHandler(handler)
        try:
            yield
        finally:
            logging.root.removeHandler(handler)
            handler.close()

    def _as_command(self, values: dict[str, Any]) -> AbstractContextManager[None]:
        if not self.sweep:
            return nullcontext()
        return own_command(self.script, ["resume=auto"] if values.get("resume") == "auto" else [])


def _folder_names(overrides: Sequence[Override]) -> list[str]:
    """The setting by which a job's folder is named by what the sweep changes, and by nothing else."""
    fixed = ",".join(
        o.key_or_group for o in overrides if not o.is_sweep_override() or "/" in o.input_line
    )
    return [f"hydra.job.config.override_dirname.exclude_keys=[{fixed}]"]


def _quieten() -> None:
    """Leave out what Lightning says that its users can neither use nor mend."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r".*treespec, LeafSpec.* is deprecated")
    warnings.filterwarnings("ignore", r".*does not have many workers")  # reading is memory-mapped
    warnings.filterwarnings(
        "ignore", r"torch\.distributed\.nn\.functional\.all_gather is deprecated"
    )
    warnings.filterwarnings(
        "ignore", r"It is recommended to use `self\.log\('validation/.*sync_dist=True"
    )  # they are
    warnings.filterwarnings("ignore", r"Checkpoint directory .* exists and is not empty")
