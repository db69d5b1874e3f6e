"""Tasks on several processes, in the order of their dependencies, under one progress bar."""

from __future__ import annotations

import contextlib
import io
import logging
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import torch
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
from ghpt.signals import stopped_by_signals

_log = logging.getLogger(__name__)


def perform_all(wanted: Iterable[Task], tasks: Path, jobs: int, show: bool) -> int:
    """Do every task that is wanted or needed and is not yet done, ``jobs`` at a time; returns how
    many that were.

    A task's result is kept as soon as it is there: after an error or an interruption, which end
    this at once, the same call goes on where it was. Raises what the task raised, a GhptError with
    the task's name before it.
    """
    tasks.mkdir(parents=True, exist_ok=True)
    sweep_temporaries(tasks)
    missing = {key: task for key, task in with_dependencies(wanted).items() if not task.done(tasks)}
    number = len(missing)
    chain = _chains(missing)
    with (
        stopped_by_signals(),
        _progress(list(missing.values()), show) as tell,
        _executor(min(jobs, len(missing))) as submit,
    ):
        waiting = dict(missing)
        running = {}
        while waiting or running:
            ready = [
                c
                for c in waiting.values()
                if not any(b.key in missing for b in c.dependencies.values())
            ]
            for task in sorted(ready, key=lambda c: -chain[c.key])[: jobs - len(running)]:
                running[submit(task, tasks)] = waiting.pop(task.key)
                tell(running.values(), None)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                try:
                    future.result()
                except GhptError as error:
                    error.args = (f"{running[future].name}: {error}",)
                    raise
                except BrokenProcessPool as error:
                    raise _killed(running.values()) from error
                task = running.pop(future)
                del missing[task.key]
                tell(running.values(), task)
    return number


def _killed(running: Iterable[Task]) -> GhptConfigError:
    made = ", ".join(task.name for task in running)
    problem = f"a process was killed while these were made: {made}; the system does so where memory is short"
    return GhptConfigError("jobs", problem, "Give fewer (jobs=1, say); the same command goes on.")


def _chains(tasks: dict[str, Task]) -> dict[str, float]:
    """Seconds of the longest chain of tasks that begins with each: what is first in a long one is
    done first.
    """
    chain = {key: task.seconds for key, task in tasks.items()}
    for key, task in reversed(tasks.items()):  # dependencies come before their dependents
        for before in task.dependencies.values():
            if before.key in chain:
                chain[before.key] = max(chain[before.key], before.seconds + chain[key])
    return chain


@contextlib.contextmanager
def _executor(jobs: int) -> Iterator[Callable[[Task, Path], Future[None]]]:
    """Submit tasks to ``jobs`` processes, or with one to this process; on the way out nothing is
    left running.
    """
    if jobs <= 1:
        yield _here
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    executor = ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), _start, (threads, os.getpid())
    )
    try:
        yield lambda task, tasks: executor.submit(_quietly, task, tasks)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()  # what it was writing has a temporary name
        raise
    finally:
        executor.shutdown()


def _here(task: Task, tasks: Path) -> Future[None]:
    future: Future[None] = Future()
    try:
        _quietly(task, tasks)
        future.set_result(None)
    except Exception as error:
        future.set_exception(error)
    return future


def _start(threads: int, parent: int) -> None:
    """In a new process: its share of the processors, and an end when the parent's comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def _quietly(task: Task, tasks: Path) -> None:
    """`perform` without what the commands would say on the way."""
    loggers = [
        logging.getLogger(name) for name in ("ghpt", "lightning.pytorch", "lightning.fabric")
    ]
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
    """A bar over all tasks, as long as their expected seconds; without it, or a terminal, a line
    for each.

    What it yields is told which tasks are being made, and which one has been finished.
    """
    columns = (
        TextColumn("{task.fields[count]}"),
        BarColumn(None),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    console = Console(stderr=True)
    show = show and console.is_terminal and len(tasks) > 0
    bar = Progress(*columns, console=console, disable=not show)
    done: list[Task] = []

    def count() -> str:
        return f"{len(done)} of {len(tasks)}"

    with bar:
        task = bar.add_task("", total=sum(task.seconds for task in tasks), count=count())

        def tell(running: Iterable[Task], finished: Task | None) -> None:
            if finished is not None:
                done.append(finished)
                bar.advance(task, finished.seconds)
                (_log.debug if show else _log.info)("%s: %s", count(), finished.name)
            bar.update(task, count=count(), description=", ".join(task.name for task in running))

        yield tell
