"""Tasks on several processes, in the order of their dependencies, under one progress bar."""

from __future__ import annotations

import contextlib
import io
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from ghpt.errors import GhptConfigError, GhptError
from ghpt.files import sweep_temporaries
from ghpt.paper.engine.tasks import Task, perform, with_dependencies
from ghpt.signals import stop_on_signals

_LOUD = ("ghpt", "lightning.pytorch", "lightning.fabric")
"""The loggers of the commands."""
_COLUMNS = (
    TextColumn("{task.fields[count]}"),
    BarColumn(None),
    TaskProgressColumn(),
    TimeElapsedColumn(),
    TimeRemainingColumn(),
    TextColumn("{task.description}"),
)
_log = logging.getLogger(__name__)


def perform_all(wanted: Iterable[Task], tasks: Path, jobs: int, show: bool) -> int:
    """Run every task that is wanted or depended on and not yet done, ``jobs`` at a time.

    Returns how many that were. A task's result is kept as soon as it is there: after an error or an
    interruption, which end this at once, the same call goes on where it was. Raises what the task
    raised, a GhptError with the task's name before it.
    """
    tasks.mkdir(parents=True, exist_ok=True)
    sweep_temporaries(tasks)
    everything = with_dependencies(wanted)
    queue = _Queue({key: task for key, task in everything.items() if not task.done(tasks)})
    count = len(queue.missing)
    running: dict[Future[None], Task] = {}
    with (
        stop_on_signals(),
        _progress(list(queue.missing.values()), show) as report,
        _executor(min(jobs, count)) as submit,
    ):
        while queue.missing:
            for task in queue.take(jobs - len(running)):
                running[submit(task, tasks)] = task
                report(running.values(), None)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                _check(future, running)
                task = running.pop(future)
                queue.finish(task)
                report(running.values(), task)
    return count


class _Queue:
    """The tasks that are missing, in the order of their dependencies; the longest chain first."""

    def __init__(self, missing: dict[str, Task]) -> None:
        self.missing = missing
        """The tasks that are not finished, by key."""
        self._waiting = dict(missing)
        self._chain = _chain_seconds(missing)

    def take(self, count: int) -> list[Task]:
        """Return at most ``count`` tasks whose dependencies are done, and wait for them no more."""
        ready = [task for task in self._waiting.values() if self._is_ready(task)]
        ready.sort(key=lambda task: -self._chain[task.key])
        taken = ready[:count]
        for task in taken:
            del self._waiting[task.key]
        return taken

    def finish(self, task: Task) -> None:
        del self.missing[task.key]

    def _is_ready(self, task: Task) -> bool:
        return not any(before.key in self.missing for before in task.dependencies.values())


def _check(future: Future[None], running: Mapping[Future[None], Task]) -> None:
    """Raise what the task of a finished future raised."""
    try:
        future.result()
    except GhptError as error:
        error.args = (f"{running[future].name}: {error}",)
        raise
    except BrokenProcessPool as error:
        raise _killed_error(running.values()) from error


def _killed_error(running: Iterable[Task]) -> GhptConfigError:
    names = ", ".join(task.name for task in running)
    problem = (
        f"a process was killed while these were made: {names}; the system does so where memory is "
        "short"
    )
    return GhptConfigError("jobs", problem, "Give fewer (jobs=1, say); the same command goes on.")


def _chain_seconds(tasks: Mapping[str, Task]) -> dict[str, float]:
    """Return the seconds of the longest chain of tasks that begins with each task, by its key.

    ``tasks`` are in an order in which dependencies come before their dependents.
    """
    chain = {key: task.seconds for key, task in tasks.items()}
    for key in reversed(list(tasks)):
        for before in tasks[key].dependencies.values():
            if before.key in chain:
                chain[before.key] = max(chain[before.key], before.seconds + chain[key])
    return chain


@contextlib.contextmanager
def _executor(jobs: int) -> Iterator[Callable[[Task, Path], Future[None]]]:
    """Submit tasks to ``jobs`` processes, or where it is one to this process.

    On the way out nothing is left running.
    """
    if jobs <= 1:
        yield _run_here
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(jobs, context, _start, (threads, os.getpid()))
    try:
        yield lambda task, tasks: executor.submit(_perform_quietly, task, tasks)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()  # what it was writing has a temporary name
        raise
    finally:
        executor.shutdown()


def _run_here(task: Task, tasks: Path) -> Future[None]:
    future: Future[None] = Future()
    try:
        _perform_quietly(task, tasks)
        future.set_result(None)
    except Exception as error:
        future.set_exception(error)
    return future


def _start(threads: int, parent: int) -> None:
    """Give a new process its share of the processors, and end it with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    os.environ["OMP_NUM_THREADS"] = str(threads)  # which torch reads when a task imports it
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(threads)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def _perform_quietly(task: Task, tasks: Path) -> None:
    """Run a task without what the commands would print on the way."""
    loggers = [logging.getLogger(name) for name in _LOUD]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            perform(task, tasks)
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextlib.contextmanager
def _progress(
    tasks: Sequence[Task], show: bool
) -> Iterator[Callable[[Iterable[Task], Task | None], None]]:
    """Show a bar over all tasks, as long as their expected seconds, or log a line for each.

    What it yields takes the tasks that are running, and the one that has been finished.
    """
    console = Console(stderr=True)
    show = show and console.is_terminal and len(tasks) > 0
    bar = Progress(*_COLUMNS, console=console, disable=not show)
    done: list[Task] = []

    def count() -> str:
        return f"{len(done)} of {len(tasks)}"

    with bar:
        seconds = sum(task.seconds for task in tasks)
        whole = bar.add_task("", total=seconds, count=count())

        def report(running: Iterable[Task], finished: Task | None) -> None:
            if finished is not None:
                done.append(finished)
                bar.advance(whole, finished.seconds)
                level = logging.DEBUG if show else logging.INFO
                _log.log(level, "%s: %s", count(), finished.name)
            names = ", ".join(task.name for task in running)
            bar.update(whole, count=count(), description=names)

        yield report
