"""Training and testing on two processes, as typed: the numbers of one, everything written and said
once.
"""

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import children
import toys
from composed import compose
from ghpt.models.checkpoint import read_checkpoint
from toys import train

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "data=toy",
    "data.train_samples=77",
    "progress_bar=false",
    "trainer.accelerator=cpu",
)
MODELS = {
    "pose": ("model=pose", "model.hypotheses=5", "model.scorer.layers=[8]"),
    "camera": (
        "model=camera",
        "model.hypotheses=5",
        "model.scorer.layers=[8]",
        "trainer.max_epochs=2",
        "model.problem.frames=6",
        "model.problem.draws=3",
        "model.problem.sample=30",
        "model.problem.points=20",
    ),
}
TWO = ("trainer.devices=2", "trainer.strategy=ddp")


SCRIPT = """
from pathlib import Path
from ghpt.commands.app import run

if __name__ == "__main__":
    run(Path({conf!r}), {name!r})
"""


@pytest.fixture(scope="module")
def typed_for_two(conf, tmp_path_factory):
    """``typed_for_two("train", *words)`` starts train.py on two processes, the second one as
    Lightning does only with ``env={}``.
    """

    folder = tmp_path_factory.mktemp("scripts")
    for name in ("train", "test"):
        (folder / f"{name}.py").write_text(SCRIPT.format(conf=str(conf), name=name))

    def start(name, *words, env=children.RANKS):
        return children.start(folder / f"{name}.py", *SMALL, *TWO, *words, env=env)

    return start


@pytest.fixture(scope="module")
def composed(conf):
    return lambda name, *words: compose(name, *SMALL, *words, conf=conf)


@pytest.fixture(scope="module", params=MODELS)
def trained(request, composed, typed_for_two, tmp_path_factory):
    """(folder of one process, folder of two, stdout and stderr of two)."""
    one, two = (tmp_path_factory.mktemp(f"{request.param}{n}") for n in (1, 2))
    ranks = {} if request.param == "pose" else children.RANKS
    child = typed_for_two("train", *MODELS[request.param], f"output={two}", env=ranks)
    train(composed("train", *MODELS[request.param]), one)
    out, errors = child.communicate(timeout=children.LIMIT)
    assert child.returncode == 0, errors
    return one, two, out, errors


def scalars(folder):
    (file,) = folder.glob("*tfevents*")
    log = EventAccumulator(str(file)).Reload()
    return {tag: [event.value for event in log.Scalars(tag)] for tag in log.Tags()["scalars"]}


def others_of(pid):
    """The processes that belong to a run whose first process is this one, without it."""
    listed = subprocess.run(["pgrep", "-g", str(os.getpgid(pid))], capture_output=True, text=True)
    return {int(word) for word in listed.stdout.split()} - {pid}


def alive(pid):
    status = Path(f"/proc/{pid}/status")
    return status.exists() and "State:\tZ" not in status.read_text(encoding="utf-8")


def until_saved(child, folder):
    children.wait_until((folder / "last.ckpt").exists, child)


def written(folder):
    return sorted(
        re.sub(r"tfevents.*", "tfevents", path.name) for path in folder.iterdir() if path.is_file()
    )


def test_training_on_two_processes(trained):
    folder, other, out, errors = trained
    one, two = scalars(folder), scalars(other)
    assert one.keys() == two.keys() >= {"train/total", "validation/weight"}
    assert len(one["train/total"]) in (5, 10)
    for tag, values in one.items():
        assert values == pytest.approx(two[tag], rel=1e-5), tag
    process, *ours = sorted(written(other), key=lambda name: "process" not in name)
    assert sorted(ours) == sorted([*written(folder), "train.log"])
    assert (other / process).read_text() == ""
    assert out == ""
    assert [line.split()[0] for line in errors.splitlines()] == [
        "Validation",
        "weight",
        "Checkpoint:",
        "Test",
    ]


def test_testing_on_two_processes(composed, typed_for_two, tmp_path, capsys):
    checkpoint = tmp_path / "train" / "best.ckpt"
    train(composed("train", *MODELS["pose"]), checkpoint.parent)
    one, two = tmp_path / "one", tmp_path / "two"
    child = typed_for_two("test", f"ckpt={checkpoint}", f"output={two}")
    toys.run_test(composed("test", f"ckpt={checkpoint}"), one)
    out, errors = child.communicate(timeout=children.LIMIT)
    assert child.returncode == 0, errors
    assert out == capsys.readouterr().out
    assert [line.split()[0] for line in errors.splitlines()] == ["Report:", "Figures:"]
    assert written(two) == sorted([*written(one), "test.log", "train_ddp_process_1.log"])
    with np.load(one / "predictions.npz") as first, np.load(two / "predictions.npz") as second:
        assert first.files == second.files
        for name in set(first.files) - {"meta"}:
            exact = (
                name.startswith("points_")
                and name.removeprefix("points_") in composed("test")["baselines"]
            )
            if exact or first[name].dtype.kind != "f":
                np.testing.assert_array_equal(first[name], second[name], err_msg=name)
            else:
                np.testing.assert_allclose(
                    first[name], second[name], rtol=1e-5, atol=1e-3, err_msg=name
                )
    first, second = (
        json.loads((folder / "metrics.json").read_text())["selections"] for folder in (one, two)
    )
    for name, numbers in first.items():
        assert numbers["mpjpe_relative"] == pytest.approx(
            second[name]["mpjpe_relative"], rel=1e-6
        ), name


def test_an_error_in_both_processes_is_said_once(typed_for_two, tmp_path):
    child = typed_for_two("train", "data.missing=1.0", f"output={tmp_path}", env={})
    out, errors = child.communicate(timeout=children.LIMIT)
    assert (child.returncode, out) == (1, "")
    lines = [line for line in errors.splitlines() if not line.startswith("Preparing ")]
    assert len(lines) == 1
    assert lines[0].startswith("error: synthetic: toy train: no frame has a true pelvis")


@pytest.mark.posix
def test_an_interrupt_of_the_first_stops_both(typed_for_two, tmp_path):
    child = typed_for_two(
        "train", *MODELS["pose"], "trainer.max_epochs=5000", "save_every=2", f"output={tmp_path}"
    )
    until_saved(child, tmp_path)
    others = others_of(child.pid)
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=children.LIMIT)
    assert child.returncode == 130
    assert re.match(
        r"Stopped\. .*last\.ckpt holds training step \d+\.\nGo on with the same command and", errors
    )
    assert errors.count("\n") == 2
    assert others
    assert not any(alive(pid) for pid in others)


@pytest.mark.posix
@pytest.mark.parametrize("dies", ["the second", "the first"])
def test_a_killed_process_ends_both_in_a_line_and_the_training_goes_on(
    typed_for_two, tmp_path, dies
):
    """E6: not in a hang."""
    words = (*MODELS["pose"], "save_every=2", f"output={tmp_path}")
    child = typed_for_two("train", *words, "trainer.max_epochs=5000")
    until_saved(child, tmp_path)
    (second,) = others_of(child.pid)
    os.kill(second if dies == "the second" else child.pid, signal.SIGKILL)
    _, errors = child.communicate(timeout=children.LIMIT)
    children.wait_until(lambda: not alive(second))
    if dies == "the second":
        *how, error = errors.splitlines()
        assert child.returncode == 1
        assert [line.split()[0] for line in how] == ["Stopped.", "Go"]
        assert error.startswith("error: trainer.devices: process 2 of 2 was killed by signal 9")
    else:
        assert (child.returncode, errors) == (-signal.SIGKILL, "")
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] > 0
