"""The jobs of a sweep, where Hydra's launchers leave something open: one that dies, an interrupt,
several processes.
"""

import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, TypeVar

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import open_dict, read_write

import __main__
from ghpt.config import suggest
from ghpt.errors import GhptConfigError, GhptError
from ghpt.extras import NotInstalled

LAUNCHER = "hydra/launcher"
_SEARCH = "hparams_search"
_LAUNCHERS = ("basic", "submitit_local", "submitit_slurm")
_PARENT = os.getppid()
"""The process that started this one, which may be gone by the time that one asks."""
_RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""The variables by which launchers number a run's processes, as Lightning reads them."""
_PATIENCE = 10.0
"""Seconds that interrupted jobs have to save their state."""
_AT_MOST = 60.0
"""Seconds in which the first of several processes comes to the error that another one has met, on a
slow machine."""


S = TypeVar("S")
R = TypeVar("R")


@dataclass(frozen=True)
class Program:
    """How a process of a command is started."""

    path: str
    """The first word of its command line."""
    module: str | None
    """The module that Python runs (``python -m``); None: the script ``path``."""


@dataclass(frozen=True)
class Job(Generic[S, R]):
    """A job of a sweep, ended."""

    name: str
    """The name of its folder, in the sweep's."""
    settings: S | None
    """The settings; None if they could not be made or the job ended without a word."""
    result: R | None
    """What the task returned; None if it failed or had finished in an earlier run."""
    said: str
    """One line: the result's summary, or the error."""
    failed: bool
    objective: float | None = None
    """What a search over settings lessens."""

    def __float__(self) -> float:
        """Return the objective, which Hydra's sweepers ask for; NaN, a failed trial, without."""
        return math.nan if self.objective is None else self.objective


def chosen_launcher(overrides: Sequence[Override], compose_only: bool) -> str:
    """The launcher of Hydra that the command line names, or ``basic``.

    Raises GhptConfigError for one whose jobs are not reported, that is not installed, or, unless
    ``compose_only``, that needs a cluster where there is none.
    """
    name = next((o.value() for o in reversed(overrides) if o.key_or_group == LAUNCHER), "basic")
    if name not in _LAUNCHERS:
        raise GhptConfigError(
            LAUNCHER, f"there is no {str(name)!r}", suggest(str(name), _LAUNCHERS)
        )
    if name != "basic" and find_spec("submitit") is None:
        raise GhptConfigError(
            LAUNCHER, f"{name} needs hydra-submitit-launcher", "Run: pip install -e '.[slurm]'"
        )
    if name == "submitit_slurm" and not (
        compose_only or (shutil.which("sbatch") and shutil.which("srun"))
    ):
        hint = f"Start it on a machine of the cluster, or with {LAUNCHER}=submitit_local."
        raise GhptConfigError(
            LAUNCHER, "submitit_slurm needs Slurm's sbatch and srun, which are not here", hint
        )
    return str(name)


def check_search(words: Sequence[str], sweep: bool) -> None:
    """Raise GhptConfigError if the words ask for a search over settings that cannot be made."""
    if not any(word.startswith(f"{_SEARCH}=") and word != f"{_SEARCH}=null" for word in words):
        return
    if not sweep:
        raise GhptConfigError(_SEARCH, "is of several runs", "Add -m.")
    if find_spec("optuna") is None:
        raise NotInstalled(_SEARCH, "optuna")


@contextmanager
def record_jobs(ended: list[Job[Any, Any]]) -> Iterator[None]:
    """Within the block, every job that submitit's launchers start is added to ``ended`` when it
    ends, however it does.

    Hydra's launcher leaves the others alone when one dies without a result, or when it is
    interrupted; here they are waited for, and stopped.
    """
    import submitit
    from submitit.core.utils import FailedJobError

    submit = submitit.AutoExecutor.map_array

    def map_array(executor: Any, launcher: Any, *columns: Any) -> list[_Awaited]:
        # Interrupts are for this process, which then stops its jobs in order.
        previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            jobs = submit(executor, launcher, *columns)
        finally:
            signal.signal(signal.SIGINT, previous)
        folder = Path(str(launcher.config.hydra.sweep.dir))
        submitted = [
            _Awaited(job, folder, number, ended)
            for job, number in zip(jobs, columns[2], strict=True)
        ]
        for job in submitted:
            job.others = submitted
        return submitted

    # Hydra's launcher makes the executor itself: its class is the only place to get in between.
    submitit.AutoExecutor.map_array = map_array  # type: ignore[method-assign,assignment]  # above
    try:
        yield
    except (FailedJobError, ValueError) as error:  # sbatch refuses, or the executor
        if isinstance(error, ValueError) and (isinstance(error, GhptError) or error.__cause__):
            raise
        raise GhptConfigError(
            "hydra.launcher", str(error).rstrip("."), "--cfg hydra shows its settings."
        ) from None
    finally:
        submitit.AutoExecutor.map_array = submit  # type: ignore[method-assign]  # put back


class _Awaited:
    """A submitit job whose end is noted; what Hydra's launcher asks of it."""

    def __init__(self, job: Any, folder: Path, number: int, ended: list[Job[Any, Any]]) -> None:
        self.job = job
        self.folder = folder
        self.number = number
        self.ended = ended
        self.others: list[_Awaited] = []

    def results(self) -> list[JobReturn]:
        try:
            job = self._end()
        except KeyboardInterrupt:
            remaining = [other for other in self.others if other.number >= self.number]
            _stop([other.job for other in remaining])
            self.ended += [
                other._end() for other in remaining if other.job.paths.result_pickle.exists()
            ]
            raise
        self.ended.append(job)
        return [JobReturn(status=JobStatus.COMPLETED, _return_value=job)]

    def _end(self) -> Job[Any, Any]:
        from submitit.core.utils import FailedJobError, UncompletedJobError

        try:
            return self.job.results()[0].return_value
        except (FailedJobError, UncompletedJobError):
            name = next(
                (path.name for path in self.folder.glob(f"{self.number}_*")), str(self.number)
            )
            said = f"error: it ended without a result; {self.job.paths.stderr} may say why"
            return Job(name, None, None, said, failed=True)


def _stop(jobs: list[Any]) -> None:
    """End the jobs that still run; a training saves its state first."""
    import submitit

    if not isinstance(jobs[0], submitit.LocalJob):
        for job in jobs:
            job.cancel(check=False)
        return
    end = time.monotonic() + _PATIENCE
    grace = end - 0.8 * _PATIENCE
    while time.monotonic() < end and (running := [job for job in jobs if not job.done()]):
        if time.monotonic() > grace:  # it was no Ctrl-C of a terminal, which reaches the jobs too
            grace = end
            for job in running:
                with suppress(ProcessLookupError):
                    os.kill(int(job.job_id), signal.SIGTERM)  # submitit hands it on
        time.sleep(0.05)


def take_signals() -> None:
    """Within a job of a local pool: have an interrupt, or SIGTERM, stop it.

    `record_jobs` and submitit have them ignored.
    """
    if os.environ.get("SUBMITIT_EXECUTOR") == "local":
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.default_int_handler)


@contextmanager
def own_command(program: Program, added: Sequence[str] = ()) -> Iterator[None]:
    """Within the block, the running job of a sweep is a command of its own to Lightning.

    Lightning starts a training's other processes with this process's command, which is the whole
    sweep's; and leaves its variables behind, with which the next job would believe to have been
    started by the one before. ``added`` are further words of the command.
    """
    hydra: Any = HydraConfig.get()  # Any: declared as a dataclass, in truth a DictConfig
    arguments = list(sys.argv)
    spec = __main__.__spec__
    environment = set(os.environ)
    with read_write(hydra), open_dict(hydra):
        hydra.run.dir = hydra.runtime.output_dir
    settings = [word for word in hydra.overrides.task if not word.startswith("output=")]
    output = f"output='{hydra.runtime.output_dir}'"
    sys.argv[:] = [program.path, *settings, *added, output]
    __main__.__spec__ = None if program.module is None else find_spec(program.module)
    try:
        yield
    finally:
        sys.argv[:] = arguments
        __main__.__spec__ = spec
        for name in set(os.environ) - environment:
            del os.environ[name]
        distributed = sys.modules.get("torch.distributed")
        if distributed and distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()


def is_first_process() -> bool:
    """Whether this is the process of a run that writes its files: the only one, or the first of
    several.
    """
    return all(os.environ.get(name, "0") == "0" for name in _RANKS)


def first_of_several_ends() -> bool:
    """Whether this is one of a training's several processes, but the first, and that one ends too:
    it says why.
    """
    if os.environ.get("LOCAL_RANK", "0") == "0":
        return False
    end = time.monotonic() + _AT_MOST
    while os.getppid() == _PARENT and time.monotonic() < end:
        time.sleep(0.05)
    return os.getppid() != _PARENT
