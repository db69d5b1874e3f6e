"""E6 and B7: a process that is killed, and memory that runs out, end a run in one line, and it can
go on.
"""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import lightning as L
import pytest
import torch
from torch.utils.data import get_worker_info

from ghpt.commands import lost
from ghpt.commands.train import COMMAND
from ghpt.data.datasets.frames import Frames
from ghpt.errors import GhptConfigError
from ghpt.models.checkpoint import read_checkpoint
from ghpt.models.module import StochasticEstimator
from ghpt.paper.engine import pool
from toy_tasks import task

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(os.name == "nt", reason="kills processes with SIGKILL")
SMALL = (
    "data=toy",
    "model.hypotheses=5",
    "model.scorer.layers=[4]",
    "trainer.accelerator=cpu",
    "progress_bar=false",
    "save_every=2",
    "trainer.max_epochs=3",
)


@pytest.fixture
def training(typed, conf, tmp_path):
    """``training(*words)`` runs train.py in this process: (exit status, stdout, stderr)."""
    words = (*SMALL, f"output={tmp_path / 'run'}")
    return lambda *more: typed(conf, COMMAND, [*words, *more])


def in_step(monkeypatch, number, happens):
    """Have this happen before a step of the training."""
    original = StochasticEstimator.training_step

    def step(self, batch, batch_idx):
        if self.trainer.global_step == number:
            happens()
        return original(self, batch, batch_idx)

    monkeypatch.setattr(StochasticEstimator, "training_step", step)


@pytest.fixture
def forks():
    """Processes that load data start as copies of this one, with what a test has changed in it."""
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method("fork", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


def kill_the_next_worker(patch):
    """The worker of the next epoch, a fork of this process, kills itself before it loads anything.

    A worker that is killed from outside may have loaded all that the epoch still needs: the run
    then rightly goes on.
    """
    original = Frames.__getitem__

    def kill_a_worker(self, samples):
        if get_worker_info() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(self, samples)

    patch.setattr(Frames, "__getitem__", kill_a_worker)


def no_memory(_):
    raise MemoryError


def no_memory_in_torch(_):
    torch.empty(1 << 60, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("happens", "says"),
    [
        (kill_the_next_worker, "error: data.workers: a process that loads batches was killed"),
        (
            no_memory,
            "error: memory: there is not enough (an allocation failed). Give smaller batches",
        ),
        (no_memory_in_torch, "error: memory: there is not enough ("),
    ],
)
def test_what_is_lost_in_a_step_is_named_in_a_line_and_the_run_goes_on(
    training, monkeypatch, forks, tmp_path, happens, says
):
    with monkeypatch.context() as patch:
        in_step(patch, 7, lambda: happens(patch))
        status, _, said = training("data.workers=1")
    *_, stopped, how, error = said.splitlines()
    assert "Traceback" not in said
    assert status == 1
    assert re.search(r"last\.ckpt holds training step [1-9]\d*\.$", stopped)
    assert how.endswith("resume=true")
    assert error.startswith(says)
    status, _, said = training("resume=true")
    assert status == 0, said
    assert read_checkpoint(tmp_path / "run" / "last.ckpt")["global_step"] == 15


def test_other_errors_keep_their_trace(training, monkeypatch):
    def fault():
        raise RuntimeError("a fault of the program")

    in_step(monkeypatch, 1, fault)
    with pytest.raises(RuntimeError, match="a fault of the program"):
        training()


def test_a_killed_process_of_a_pool_is_named_with_what_it_made(tmp_path, monkeypatch):
    @contextmanager
    def executor(jobs):
        yield lambda task, tasks: broken()

    def broken():
        future = Future()
        future.set_exception(BrokenProcessPool())
        return future

    monkeypatch.setattr(pool, "_executor", executor)
    tasks = [task(tmp_path / "diary", number) for number in (1, 2)]
    with pytest.raises(GhptConfigError, match=r"^jobs: .* add-1, add-2; .* Give fewer") as caught:
        pool.perform_all(tasks, tmp_path / "tasks", 2, show=False)
    assert isinstance(caught.value.__cause__, BrokenProcessPool)


def trainer_of(*commands: str) -> Mock:
    """What `told` needs of a trainer of two processes that has started these commands."""
    trainer = Mock(spec=L.Trainer, world_size=2)
    trainer.strategy.launcher.procs = [
        subprocess.Popen(["/bin/sh", "-c", command]) for command in commands
    ]
    return trainer


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (
            "kill -9 $$",
            r"^trainer.devices: process 2 of 2 was killed by signal 9; the system does so",
        ),
        ("exit 3", r"^trainer.devices: process 2 of 2 ended with status 3. "),
    ],
)
def test_the_others_name_the_process_that_ended(command, says):
    trainer = trainer_of(command)
    with pytest.raises(GhptConfigError, match=says), lost.report_end(trainer):
        raise RuntimeError(
            "[gloo/transport/tcp/pair.cc:534] Connection closed by peer [127.0.1.1]:21345"
        )


def test_a_process_that_others_started_is_none_of_ours(monkeypatch):
    monkeypatch.setattr(lost, "_WAIT", 0.0)
    started_by_slurm = trainer_of()
    with (
        pytest.raises(GhptConfigError, match="one of the run's 2 processes has ended"),
        lost.report_end(started_by_slurm),
    ):
        raise RuntimeError("NCCL communicator was aborted")


def test_who_is_not_waiting_for_the_killed_process_says_it_too(monkeypatch, capsys):
    """Lightning's thread looks after the processes, and kills this one without a word."""
    processes = trainer_of("sleep 600", "kill -9 $$").strategy.launcher.procs
    processes[1].wait()
    monkeypatch.setattr(lost, "_WAIT", 0.0)
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as stop:
        lost._ChildProcessObserver(os.getpid(), processes, sleep_period=0).run()
    assert stop.value.code == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: trainer.devices: process 3 of 3 was killed by signal 9")
    assert processes[0].wait(60) == -signal.SIGKILL
