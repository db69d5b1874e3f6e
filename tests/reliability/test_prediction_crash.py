"""B3: a prediction that is killed at any instant goes on where it was, to the same bytes."""

import hashlib
import os
import signal
import sys
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest

import sizes
from ghpt.commands import predict as command
from ghpt.commands.prediction import sequences
from ghpt.commands.prediction.shards import MANIFEST
from predicting import config, sequence_of

pytestmark = pytest.mark.usefixtures("blank_figures")

OUTPUTS = ("poses.npz", "poses.csv", "poses.trc", "prediction.json", "report.md")


def predict(output: Path, frames: int, settings: dict) -> None:
    sequences.recording_sequence = lambda _: sequence_of(frames)
    command.predict(settings, output)


def forked(output: Path, frames: int, settings: dict, seconds: float | None = None) -> bool:
    """Predict in a process that is killed after so many seconds; whether it was done before."""
    child = os.fork()
    if child == 0:
        try:
            with (
                open(os.devnull, "w", encoding="utf-8") as nowhere,
                redirect_stdout(nowhere),
                redirect_stderr(nowhere),
            ):
                predict(output, frames, settings)
            os._exit(0)
        except BaseException:
            with open(output.parent / "trace", "a", encoding="utf-8") as handle:
                traceback.print_exc(file=handle)
            os._exit(1)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return False
    assert os.WEXITSTATUS(status) == 0, (output.parent / "trace").read_text()
    return True


def listed(output: Path) -> int:
    manifest = output / command.SHARDS / MANIFEST
    return max(manifest.read_bytes().count(b"\n") - 1, 0) if manifest.exists() else 0


def digests(output: Path) -> dict[str, str]:
    return {name: hashlib.sha256((output / name).read_bytes()).hexdigest() for name in OUTPUTS}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
def test_b3_killed_predictions_end_in_the_same_bytes(tmp_path, record_row, monkeypatch):
    frames = sizes.PREDICTED_FRAMES
    shard = frames // 50
    kills = sizes.KILLED_PREDICTIONS
    monkeypatch.setattr(sys, "argv", ["predict.py"])  # it is in the files
    monkeypatch.setattr(
        command, "provenance", lambda seed: {"ghpt": "0", "commit": "", "seed": seed, "command": ""}
    )
    settings = config(
        "estimator=linear", f"shard_frames={shard}", "batch=100", "formats=[npz,csv,trc]"
    )
    started = time.perf_counter()
    assert forked(tmp_path / "whole", frames, settings)
    took = time.perf_counter() - started
    expected = digests(tmp_path / "whole")
    random = np.random.default_rng(0)
    output, done, redone, rounds = tmp_path / "killed", 0, 0, 0
    for kill in range(kills):
        before = listed(output)
        # half of them early, where shards are written; the others anywhere up to the end
        finished = forked(
            output, frames, settings, float(random.uniform(0.1, 0.5 if kill % 2 else 1.0) * took)
        )
        assert listed(output) >= before  # nothing that was listed is lost
        there = len(list((output / command.SHARDS).glob("[0-9]*.npz")))
        redone = max(redone, there - listed(output))
        done += finished
        if listed(output) == -(-frames // shard):  # from the start once more
            rounds += 1
            for path in (output / command.SHARDS).iterdir():
                path.unlink()
    assert forked(output, frames, settings)
    assert digests(output) == expected
    assert redone <= 1
    assert not list(output.rglob("*.tmp"))
    late = f"{rounds} of them past the last shard"
    figure = f"{kills} kills, {late}, at most {redone} shard unlisted; bytes equal"
    record_row("B3", figure, kills, kills)
