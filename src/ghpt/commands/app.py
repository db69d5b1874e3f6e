"""What all commands share: compose the configuration, run, and say errors in one line."""

import argparse
import logging
import os
import re
import string
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import hydra
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

import __main__
import ghpt
from ghpt.commands.catalogue import load
from ghpt.commands.display import as_started, name_as_started, until_reader_leaves
from ghpt.commands.jobs import (
    Job,
    Program,
    check_search,
    chosen_launcher,
    first_of_several_ends,
    is_first_process,
    own_command,
    record_jobs,
    take_signals,
)
from ghpt.commands.outputs import Files, OutputFolder, SweepFolder
from ghpt.commands.overrides import (
    Source,
    check_choices,
    check_overrides,
    compose,
    expand_home,
    flags_first,
    parse_options,
    put_options_first,
    rename_settings,
    spread_seeds,
    use_slashes,
)
from ghpt.config import plain
from ghpt.config import settings as typed_settings
from ghpt.errors import GhptConfigError, GhptError, one_line, out_of_memory
from ghpt.files import atomic_write
from ghpt.signals import stop_on_signals

S = TypeVar("S")
R = TypeVar("R")
USERS_ERRORS = (GhptError, HydraException, OmegaConfBaseException, OSError)
"""What a user can cause and correct: said in one line. Anything else is a fault of the program,
with its trace.
"""
_FULL = "HYDRA_FULL_ERROR"
_CONFIGURATION = ".hydra"
"""Where Hydra's users look for a run's configuration, within its output folder."""
_IRRELEVANT = (
    r".*treespec, LeafSpec.* is deprecated",
    r".*does not have many workers",  # reading is memory-mapped
    r"torch\.distributed\.nn\.functional\.all_gather is deprecated",
    r"It is recommended to use `self\.log\('validation/.*sync_dist=True",  # they are
    r"Checkpoint directory .* exists and is not empty",
)
"""Lightning's warnings that its users can neither use nor act on."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Command(Generic[S, R]):
    """What a script such as train.py does.

    ``settings`` is the frozen dataclass of all keys of the yaml, derived from `OutputSettings`;
    `run` makes it once, with `ghpt.config.settings`, and gives it to ``files``, ``task`` and
    ``after``.
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
    objective: Callable[[S, R], float] | None = None
    """The number that a search over settings makes small or great."""


@stop_on_signals()
def run(conf: Path, command: Command[Any, Any] | str) -> None:
    """Compose ``<conf>/<command.name>.yaml`` with ``sys.argv`` and call ``command.task``.

    ``command`` is one of the project's by its name, which is then imported when its job runs: help
    and mistakes are answered without. The output folder is locked and guarded meanwhile, see
    `ghpt.commands.outputs`. A user's error ends the program with one line, ``error: ...``, and exit
    status 1; ``HYDRA_FULL_ERROR=1`` shows the trace. In a sweep the other jobs run on, here or in
    submitit's processes, and the summary of each is printed; a job that finished in an earlier run
    of the sweep is not done again.
    """
    trace = os.environ.get(_FULL) == "1"
    os.environ[_FULL] = "1"  # Hydra then lets errors through, to be said here
    ended: list[Job[Any, Any]] = []
    try:
        with until_reader_leaves():
            _run(conf.resolve(), command, trace, ended)
    except (*USERS_ERRORS, ValueError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if trace or not (isinstance(error, USERS_ERRORS) or isinstance(cause, OSError)):
            raise
        if isinstance(cause, OSError):  # Hydra makes the folder
            error = GhptConfigError("output", one_line(cause), "Name a folder that can be written.")
        sys.exit(as_started(f"error: {one_line(error)}"))
    except KeyboardInterrupt:
        sys.exit(130)
    if any(job.failed for job in ended):
        sys.exit(1)


def _run(
    conf: Path, command: Command[Any, Any] | str, trace: bool, ended: list[Job[Any, Any]]
) -> None:
    """Do what the command line asks for; jobs that end are added to ``ended``."""
    name = command if isinstance(command, str) else command.name
    sys.argv[1:] = flags_first(use_slashes(expand_home(rename_settings(sys.argv[1:]))))
    if name == "reproduce":
        sys.argv[1:] = spread_seeds(sys.argv[1:])
    if "--version" in sys.argv:
        print(f"ghpt {ghpt.__version__}")
        return
    arguments = parse_options(get_args_parser(), sys.argv[1:])
    sys.argv[1:] = put_options_first(sys.argv[1:], arguments.overrides)
    check_search(arguments.overrides, bool(arguments.multirun))
    source = _source(conf, name, arguments)
    sweep = bool(arguments.multirun)
    job = _Job(command, source.folder, _program(), os.getpid(), sweep, trace, ended)
    start = hydra.main(version_base="1.3", config_path=str(source.folder), config_name=source.name)(
        job
    )
    if arguments.hydra_help or arguments.info or arguments.shell_completion:
        _answer(start)
        return
    if _is_single(arguments):
        _run_single(source, job, arguments.overrides)
        return
    if sweep and (arguments.cfg or arguments.help):
        option = "--cfg" if arguments.cfg else "--help"
        hint = "Leave out -m, and give one value of each setting."
        raise GhptConfigError(option, "shows one run, and -m asks for several", hint)
    overrides = check_overrides(source, arguments.overrides, sweep)
    if arguments.help:
        print(_help(source, arguments.overrides))
        return
    launcher = chosen_launcher(overrides, compose_only=bool(arguments.cfg))
    if sweep:
        sys.argv += _folder_names(overrides)
    with SweepFolder.release_after():
        try:
            with record_jobs(ended) if launcher != "basic" else nullcontext():
                start()
        finally:
            if sweep and ended:
                lines = [f"  {job.name}: {job.said}" for job in ended]
                print("\n".join(["", "Jobs of the sweep:", *lines]))
        if sweep and ended:
            after = job.load().after
            if after is not None:
                after(ended)


def _is_single(arguments: argparse.Namespace) -> bool:
    """Return whether the command line asks for one job, and for nothing else."""
    options = (arguments.multirun, arguments.help, arguments.cfg, arguments.experimental_rerun)
    words = arguments.overrides
    return not any(options) and not any(word.startswith("hydra.mode=") for word in words)


def _run_single(source: Source, job: Callable[[Any], object], words: list[str]) -> None:
    """Compose once and run the job.

    `hydra.main` would compose a second time, and `check_overrides` a third; the latter is asked
    when Hydra refuses the words, or where Hydra would take what the project has no use for.
    """
    overrides = check_choices(source, words)
    chosen_launcher(overrides, compose_only=False)
    if any(override.is_add() or override.is_force_add() for override in overrides):
        check_overrides(source, words)
    hydra.version.setbase("1.3")
    search_path = create_config_search_path(str(source.folder))
    if source.more is not None:
        before = SearchPathQuery(provider="schema", path=None)
        search_path.prepend("command-line", f"file://{source.more}", before)
    refused = None
    try:
        Hydra.create_main_hydra2(source.name, search_path).run(source.name, job, list(words))
    except HydraException as error:
        refused = error
    finally:
        GlobalHydra.instance().clear()
    if refused is not None:
        check_overrides(source, words)
        raise refused


def _source(conf: Path, name: str, arguments: argparse.Namespace) -> Source:
    """Return where the configuration is, which the options of Hydra may say."""
    if arguments.config_path is not None:
        conf = Path(arguments.config_path).resolve()
        sys.argv += ["--config-path", str(conf)]  # Hydra takes it as relative to this file
    more = None if arguments.config_dir is None else Path(arguments.config_dir).resolve()
    for folder in (conf, more):
        if folder is not None and not folder.is_dir():
            problem = "there is no such folder of configurations"
            raise GhptConfigError(str(folder), problem, "Check the option --config-*.")
    return Source(conf, arguments.config_name or name, more)


def _program() -> Program:
    """Return how this process was started, so that others can be started alike."""
    module = getattr(__main__.__spec__, "name", "")
    if module.startswith("ghpt."):
        return Program(sys.argv[0], module)
    return Program(os.path.abspath(sys.argv[0]), None)


def _answer(start: Callable[[], object]) -> None:
    """Let Hydra answer what its options ask. Raises GhptConfigError for options that do not fit."""
    try:
        start()
    except ValueError as error:
        if isinstance(error, USERS_ERRORS):
            raise
        raise GhptConfigError("options", one_line(error), "--hydra-help says more.") from None


def _help(source: Source, words: Sequence[str]) -> str:
    """Return a command's help, which its yaml holds, with the configuration.

    Hydra's own help takes seconds to list the groups of every plugin.
    """
    config = compose(source, words, with_hydra=True)
    template = string.Template(config.hydra.help.template)
    with open_dict(config):
        del config["hydra"]
    return as_started(template.safe_substitute(CONFIG=OmegaConf.to_yaml(config)))


@dataclass(frozen=True)
class _Job:
    """What Hydra calls for each job: the task, with its errors and end.

    In another process it is a copy.
    """

    command: Command[Any, Any] | str
    conf: Path
    program: Program
    process: int
    sweep: bool
    trace: bool
    ended: list[Job[Any, Any]]

    def load(self) -> Command[Any, Any]:
        """Return the command, imported if it is given by its name."""
        return load(self.command, self.conf) if isinstance(self.command, str) else self.command

    def __call__(self, config: Any) -> Job[Any, Any]:
        elsewhere = os.getpid() != self.process
        if elsewhere:
            take_signals()
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
                command = self.load()
                quieten()  # not before: the import of Lightning sets its levels anew
                settings = typed_settings(command.settings, values)
                files = command.files(settings)
                folder = stack.enter_context(_output_folder(output, files, values))
                before = folder.read_summary(values) if folder is not None and self.sweep else None
                if before is not None and not values.get("overwrite"):
                    said = f"{before} (finished before)"
                    failed = False
                else:
                    stack.enter_context(_records(config, output))
                    stack.enter_context(self._as_command(values))
                    with stop_on_signals():
                        result = command.task(settings, output)
                    said = command.summary(result) if self.sweep else ""
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
                    said = as_started(f"error: {kind}{one_line(error)}")
                    _log.error(said, exc_info=elsewhere and (self.trace or not users))
                if not elsewhere and (self.trace or not users):
                    raise
            except (SystemExit, KeyboardInterrupt):
                if not elsewhere:
                    raise
            finally:
                objective = None if failed else self._objective(settings, result)
                self.ended.append(Job(output.name, settings, result, said, failed, objective))
        return self.ended[-1]

    def _objective(self, settings: Any, result: Any) -> float | None:
        """Return what a search over settings looks at; None of a job that had finished before."""
        measure = self.load().objective
        return None if measure is None or result is None else measure(settings, result)

    def _as_command(self, values: dict[str, Any]) -> AbstractContextManager[None]:
        if not self.sweep:
            return nullcontext()
        more = ["resume=auto"] if values.get("resume") == "auto" else []
        return own_command(self.program, more)


def _output_folder(
    output: Path, files: Files, values: dict[str, Any]
) -> AbstractContextManager[OutputFolder | None]:
    """Return the output folder, locked and guarded; None in a training's other processes."""
    if not is_first_process():
        return nullcontext()
    names = ("config.yaml", "hydra.yaml", "overrides.yaml")
    configuration = tuple(f"{_CONFIGURATION}/{name}" for name in names)
    log = f"{HydraConfig.get().job.name}.log"
    files = replace(files, writes=(*files.writes, *configuration), growing=(*files.growing, log))
    return OutputFolder(output, files, bool(values.get("overwrite")))


@contextmanager
def _records(config: Any, output: Path) -> Iterator[None]:
    """Write the job's configuration, and within the block its log."""
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
    for each in logging.root.handlers:
        each.addFilter(name_as_started)
    try:
        yield
    finally:
        logging.root.removeHandler(handler)
        handler.close()


def _folder_names(overrides: Sequence[Override]) -> list[str]:
    """Return the setting by which a job's folder is named by what the sweep changes alone."""
    fixed = ",".join(
        str(o.key_or_group)
        for o in overrides
        if not o.is_sweep_override() or re.search(r"[/\\:]", o.input_line or "")
    )
    return [f"hydra.job.config.override_dirname.exclude_keys=[{fixed}]"]


def quieten() -> None:
    """Leave out what Lightning says that its users can neither use nor act on."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in _IRRELEVANT:
        warnings.filterwarnings("ignore", message)
