"""B1 and B4: checkpoints survive kills at any instant and a failure of any system call."""

import errno
import json
import os
import random
import time
from pathlib import Path

import pytest
import torch

import children
import sizes
from ghpt import files
from ghpt.files import sweep_temporaries
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO, read_checkpoint

SCRIPT = Path(__file__).with_name("run_toy.py")

SAVER = """
import os, sys, torch
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO
for number in range(int(sys.argv[2]), 10**9):
    state = {"x": torch.full((6_000_000,), float(number)), "y": torch.tensor(number)}
    checkpoint = {"state_dict": state, FIELD: {"format_version": FORMAT_VERSION}}
    AtomicCheckpointIO().save_checkpoint(checkpoint, sys.argv[1])
    os.write(1, f"{number}\\n".encode())  # a whole line: a kill must not cut one
"""


def kill_while_saving(path, number, delay):
    """Save on and on from this number in a child, and kill it ``delay`` seconds after its first
    save. Returns the last number that it saved.
    """
    saver = children.start("-c", SAVER, path, number)
    saved = saver.stdout.readline()
    time.sleep(delay)
    saver.kill()
    return int([saved, *saver.stdout.readlines()][-1])


def test_b1_kill_while_saving(tmp_path, monkeypatch, record_row):
    """24 MB checkpoints, saved without a pause, the system's temporary folder on another file
    system.
    """
    if Path("/dev/shm").is_dir():
        monkeypatch.setenv("TMPDIR", "/dev/shm")
    path = tmp_path / "last.ckpt"
    kills = sizes.KILLED_SAVES
    number = 0
    rng = random.Random(0)
    bad = left_over = 0
    for _ in range(kills):
        saved = kill_while_saving(path, number, rng.uniform(0, 0.2))
        try:
            state = read_checkpoint(path)["state_dict"]
            bad += not (state["y"] >= saved and (state["x"] == state["y"]).all())
        except ValueError:
            bad += 1
        sweep_temporaries(tmp_path)
        left_over += len(list(tmp_path.iterdir())) - 1
        number = saved + 1
    record_row(
        "B1",
        f"{kills} kills while saving: {bad} unreadable or lost, {left_over} left over",
        kills - bad,
        kills,
    )
    assert (bad, left_over) == (0, 0)


def test_b1_and_b2_kill_training_and_resume(tmp_path, record_row):
    """A real training run, killed, resumed by the same command, ends with the same weights."""
    changes = {"trainer": {"max_epochs": 10}, "train": {"save_every": 2}}
    rng = random.Random(1)

    def start(folder, resume):
        wanted = {**changes, "train": changes["train"] | {"resume": resume}}
        return children.start(SCRIPT, folder, json.dumps(wanted))

    assert start(tmp_path / "whole", False).wait(timeout=children.LIMIT) == 0
    expected = read_checkpoint(tmp_path / "whole" / "last.ckpt")["state_dict"]
    runs = sizes.KILLED_TRAININGS
    same = 0
    for number in range(runs):
        folder = tmp_path / str(number)
        child = start(folder, False)
        children.wait_until((folder / "last.ckpt").exists, child)
        time.sleep(rng.uniform(0, 0.8))
        child.kill()
        child.wait()
        assert start(folder, True).wait(timeout=children.LIMIT) == 0
        found = read_checkpoint(folder / "last.ckpt")["state_dict"]
        same += all(torch.equal(found[k], v) for k, v in expected.items())
        assert not [p for p in folder.iterdir() if p.name.endswith(".tmp")]
    record_row(
        "B2",
        f"{runs} killed and resumed training runs: {same} end with identical weights",
        same,
        runs,
    )
    assert same == runs


class Failing:
    """Stands for the ``os`` module and for ``open`` in ghpt.files; the ``fail``-th call of interest
    raises.
    """

    def __init__(self, fail, code):
        self.calls, self.fail, self.code = [], fail, code

    def __getattr__(self, name):
        original = getattr(os, name)
        return self.counted(name, original) if name in ("fsync", "replace", "open") else original

    def counted(self, name, function):
        def call(*args, **kwargs):
            self.calls.append(name)
            if len(self.calls) == self.fail:
                raise OSError(self.code, os.strerror(self.code))
            return function(*args, **kwargs)

        return call

    def open_file(self, path, mode="r", **kwargs):
        handle = self.counted("create", open)(path, mode, **kwargs)
        outer = self

        class Handle:
            def __getattr__(self, name):
                method = getattr(handle, name)
                return outer.counted(name, method) if name in ("write", "flush") else method

            def __enter__(self):
                return self

            def __exit__(self, *args):
                handle.close()

        return Handle()


def failure(call):
    try:
        call()
    except OSError as error:
        return error


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EACCES, errno.EROFS, errno.EINTR])
def test_b4_any_call_of_a_save_may_fail(tmp_path, monkeypatch, code, record_row):
    path = tmp_path / "last.ckpt"

    def save(number):
        state = {"x": torch.full((2000,), float(number))}
        AtomicCheckpointIO().save_checkpoint(
            {"state_dict": state, FIELD: {"format_version": FORMAT_VERSION}}, path
        )

    save(1)
    fail = done = 0
    while True:
        fail += 1
        failing = Failing(fail, code)
        with monkeypatch.context() as patch:
            patch.setattr(files, "os", failing)
            patch.setattr(files, "open", failing.open_file, raising=False)
            error = failure(lambda: save(2))
        if error is None:
            break
        assert error.errno == code
        assert str(tmp_path) in str(error)
        value = read_checkpoint(path)["state_dict"]["x"][0].item()
        replaced = "replace" in failing.calls[: fail - 1]
        assert value == (2 if replaced else 1)
        assert os.listdir(tmp_path) == ["last.ckpt"]
        save(1)
        done += 1
    kinds = set(failing.calls)
    assert {"create", "write", "flush", "fsync", "replace", "open"} <= kinds
    record_row(
        "B4", f"{os.strerror(code)}: each of the {done} calls of a save failed in turn", done, done
    )
