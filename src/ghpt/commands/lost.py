"""How a run that ends early tells so: signals by the exit status, lost processes and memory in one
line.
"""

import os
import re
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from subprocess import Popen
from typing import Any

import lightning as L
from lightning.fabric.strategies.launchers.subprocess_script import _ChildProcessObserver
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities.exceptions import SIGTERMException

from ghpt.errors import GhptConfigError
from ghpt.signals import stop, stop_on_signals

_WAIT = 30.0
"""Seconds in which a process that others wait for is seen to have ended, on a slow machine."""
_DEAD_WORKER = re.compile(r"DataLoader worker \(pid")
_DEAD_PEER = re.compile(r"gloo|NCCL|[Cc]onnection (closed|reset) by peer")
_WHY = "the system does so where memory is short"


class OwnSignals(Callback):
    """Puts our handler back in the place of Lightning's, whose loops of test and predict ignore
    SIGTERM.
    """

    def on_test_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._put_back()

    def on_predict_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._put_back()

    def _put_back(self) -> None:
        # Lightning's handler has several processes wait for each other where they are, which may be
        # for ever.
        if signal.getsignal(signal.SIGINT) == stop:
            signal.signal(signal.SIGTERM, stop)


@contextmanager
def report_end(trainer: L.Trainer) -> Iterator[None]:
    """Run the trainer within the block: however it ends, the shell and the user are told in the way
    of all commands.

    An interrupt exits with 130, SIGTERM and SIGHUP with 143 (Lightning's statuses are 1 and 0).
    Raises GhptConfigError where a process that loads data, or another process of the same run, was
    killed.
    """
    with stop_on_signals():
        try:
            yield
        except SIGTERMException as stopped:
            raise SystemExit(143) from stopped
        except SystemExit as stopped:
            if isinstance(stopped.__context__, KeyboardInterrupt):
                raise SystemExit(130) from stopped
            raise
        except RuntimeError as error:
            lost = _lost(trainer, str(error))
            if lost is None:
                raise
            raise lost from error


def _lost(trainer: L.Trainer, text: str) -> GhptConfigError | None:
    if _DEAD_WORKER.search(text):
        problem = f"a process that loads batches was killed; {_WHY}"
        return GhptConfigError("data.workers", problem, "Give fewer (data.workers=0 needs none).")
    processes = getattr(trainer.strategy.launcher, "procs", None) or []
    if trainer.world_size == 1 or not (_DEAD_PEER.search(text) or _first_failure(processes, 0.0)):
        return None
    return _lost_process(_first_failure(processes, _WAIT), trainer.world_size)


def _lost_process(ended: tuple[int, int] | None, count: int) -> GhptConfigError:
    """``ended``: the number of a process, from 0, and its exit status."""
    if ended is None:
        problem = f"one of the run's {count} processes has ended"
    else:
        number, status = ended
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        problem = f"process {number + 1} of {count} {how}"
        problem += f"; {_WHY}" if status == -getattr(signal, "SIGKILL", 9) else ""
    return GhptConfigError("trainer.devices", problem, "Its train_ddp_process log may say why.")


def _first_failure(processes: Sequence[Popen[Any]], patience: float) -> tuple[int, int] | None:
    """Number and exit status of a process beside the first that failed, within ``patience``
    seconds.
    """
    end = time.monotonic() + patience
    while True:
        for number, process in enumerate(processes, start=1):
            if process.poll():
                return number, process.returncode
        if not processes or time.monotonic() >= end:
            return None
        time.sleep(0.05)


def _say_and_end(observer: Any) -> None:
    """What Lightning's thread does when it finds a process dead; its own kills this one without a
    word.
    """
    time.sleep(
        _WAIT
    )  # the main thread may be about to say it, and ends this thread with the process
    processes = observer._child_processes
    error = _lost_process(_first_failure(processes, 0.0), len(processes) + 1)
    for process in processes:
        process.kill()
    print(f"error: {error}", file=sys.stderr, flush=True)
    os._exit(1)


# Lightning makes the observer itself, so its class is the only place to get in between.
_ChildProcessObserver._terminate_all = _say_and_end  # type: ignore[method-assign,assignment]  # above
