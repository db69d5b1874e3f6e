"""B7: a signal stops every command in order, with the status that shells expect."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import children
import ghpt
import toys
from ghpt import provenance as origin
from ghpt.commands import predict as prediction
from ghpt.commands.app import Command
from ghpt.commands.cameras import CamerasSettings
from ghpt.commands.outputs import Files
from ghpt.commands.prediction import sequences
from ghpt.commands.prediction.shards import MANIFEST, Shards
from ghpt.data.people.sequence import Sequence
from ghpt.models.estimators.classical import Linear
from ghpt.signals import stop as handler
from ghpt.signals import stop_on_signals
from predicting import config, sequence_of
from toys import train

CONF = Path(__file__).resolve().parents[1] / "conf"
STATUS = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 143}
pytestmark = pytest.mark.skipif(os.name == "nt", reason="sends itself signals")


def send(name: str) -> None:
    os.kill(os.getpid(), getattr(signal, name))


@pytest.fixture(autouse=True)
def same_handlers():
    """A block leaves the handlers as it found them."""
    numbers = [getattr(signal, name) for name in STATUS]
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.mark.parametrize("name", STATUS)
def test_a_signal_ends_a_command_with_its_status_and_no_word(typed, tmp_path, name):
    def task(settings, output):
        send(name)
        time.sleep(60)

    status, said, errors = typed(
        CONF,
        Command(
            name="cameras",
            settings=CamerasSettings,
            task=task,
            summary=str,
            files=lambda settings: Files(),
        ),
        [f"output={tmp_path}"],
    )
    assert (status, said, errors) == (STATUS[name], "", "")


@pytest.mark.parametrize("name", STATUS)
@pytest.mark.parametrize("error", [ValueError, SystemExit, OSError])
def test_the_status_is_the_signal_s_whatever_the_interrupted_code_makes_of_it(name, error):
    with pytest.raises(SystemExit) as stop, stop_on_signals():
        try:
            send(name)
        finally:
            raise error(1)
    assert stop.value.code == STATUS[name]


@pytest.mark.parametrize("name", STATUS)
def test_an_ignored_signal_stays_ignored(name):
    """So `nohup` has it, and a script's background job."""
    before = signal.signal(getattr(signal, name), signal.SIG_IGN)
    try:
        with stop_on_signals():
            send(name)
            assert signal.getsignal(getattr(signal, name)) is signal.SIG_IGN
    finally:
        signal.signal(getattr(signal, name), before)


def test_an_error_after_a_command_that_was_stopped_is_an_error():
    with pytest.raises(SystemExit), stop_on_signals():
        send("SIGTERM")
    with pytest.raises(ValueError, match="own"), stop_on_signals():
        raise ValueError("own")


@pytest.mark.parametrize(
    ("first", "second", "ended"),
    [
        ("SIGTERM", "SIGTERM", -signal.SIGTERM),
        ("SIGINT", "SIGINT", -signal.SIGINT),
        ("SIGHUP", "SIGHUP", 143),
    ],
)
def test_a_second_signal_ends_the_process_at_once(first, second, ended):
    """But for SIGHUP, which a closed terminal and its shell both send."""
    child = os.fork()
    if child == 0:
        try:
            with stop_on_signals():
                try:
                    send(first)
                finally:
                    send(second)
        except SystemExit as stop:
            os._exit(stop.code)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == ended


def test_pycolmap_s_handler_of_sigterm_is_not_there():
    program = (
        "import os, signal\nfrom ghpt.colmap import pycolmap\nos.kill(os.getpid(), signal.SIGTERM)"
    )
    ended = children.run("-c", program)
    assert (ended.status, ended.errors) == (-signal.SIGTERM, "")


def test_pycolmap_is_imported_in_one_place():
    package = Path(ghpt.__file__).parent
    importing = re.compile(r"^\s*(import|from) pycolmap\b", re.MULTILINE)
    found = [
        path.name
        for path in package.rglob("*.py")
        if importing.search(path.read_text(encoding="utf-8"))
    ]
    assert found == ["colmap.py"]


def predict_to(folder, patch):
    """Predict 250 frames in 5 shards into the folder."""
    patch.setattr(sys, "argv", ["predict.py"])
    patch.setattr(sequences, "recording_sequence", lambda _: sequence_of(250))
    origin_of = {"ghpt": "0", "commit": "", "command": ""}
    patch.setattr(prediction, "provenance", lambda seed: origin_of | {"seed": seed})
    settings = config("estimator=linear", "shard_frames=50", "batch=25", "formats=[npz,csv]")
    prediction.predict(settings, folder)


@pytest.fixture
def predict(tmp_path, monkeypatch):
    """``predict(folder)`` predicts into that folder of the test's."""
    return lambda folder: predict_to(tmp_path / folder, monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of a prediction that nobody has stopped."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        predict_to(folder, patch)
    return outputs(folder)


def outputs(folder: Path) -> dict[str, bytes]:
    names = ("poses.npz", "poses.csv", "prediction.json", "report.md")
    return {name: (folder / name).read_bytes() for name in names}


WHERE = {
    "between the frames": (Sequence, "read", 4, 1),
    "before a shard is written": (Shards, "write", 3, 2),
    "while a format is written": (Shards, "read", 3, 5),
    "while another is written": (Shards, "read", 8, 5),
    "while it is evaluated": (prediction, "evaluate", 1, 5),
}
"""What the signal interrupts: an object's function, at which call of it, and how many shards there
are then.
"""


@pytest.mark.parametrize("where", WHERE)
def test_a_stopped_prediction_goes_on_to_the_same_bytes(
    predict, whole, tmp_path, monkeypatch, caplog, where
):
    owner, function, at, shards = WHERE[where]
    original, calls = getattr(owner, function), []

    def interrupted(*args, **kwargs):
        calls.append(function)
        if len(calls) == at:
            send("SIGTERM")
        return original(*args, **kwargs)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(owner, function, interrupted)
        with stop_on_signals():
            predict("stopped")
    assert (stop.value.code, len(calls)) == (143, at)
    manifest = tmp_path / "stopped" / prediction.SHARDS / MANIFEST
    assert manifest.read_bytes().count(b"\n") == 1 + shards
    assert not list((tmp_path / "stopped").rglob("*.tmp"))
    predict("stopped")
    assert outputs(tmp_path / "stopped") == whole


def test_a_prediction_has_our_handler(predict, monkeypatch):
    """Lightning's would have several processes wait for each other."""
    write, handlers = Shards.write, set()

    def noted(*args):
        handlers.add(signal.getsignal(signal.SIGTERM))
        write(*args)

    monkeypatch.setattr(Shards, "write", noted)
    predict("out")
    assert handlers == {handler}


def test_a_stopped_test_leaves_no_rows(tmp_path, monkeypatch):
    train(toys.TRAIN, tmp_path / "model")
    baselines = {"linear": {"_target_": "ghpt.models.estimators.classical.Linear"}}
    settings = toys.TRAIN | {
        "ckpt": str(tmp_path / "model" / "last.ckpt"),
        "hypotheses": None,
        "baselines": baselines,
    }
    handlers = []

    def stopped(self, batch):
        handlers.append(signal.getsignal(signal.SIGTERM))
        send("SIGTERM")

    monkeypatch.setattr(Linear, "__call__", stopped)
    with pytest.raises(SystemExit) as stop:
        toys.run_test(settings, tmp_path / "test")
    assert stop.value.code == 143
    assert handlers == [handler]  # Lightning's would have several processes wait for each other
    assert not {".predictions", "predictions.npz", "metrics.json"} & set(
        os.listdir(tmp_path / "test")
    )


def test_git_is_asked_without_its_lock(monkeypatch):
    """A command that is stopped kills git, and the lock would stay in the user's repository."""
    asked = []

    def run(command, **options):
        asked.append(command)
        return subprocess.CompletedProcess(command, 0, "abc\n", "")

    monkeypatch.setattr(origin.subprocess, "run", run)
    origin.commit.cache_clear()
    origin.provenance(0)
    origin.commit.cache_clear()
    statuses = [command for command in asked if "status" in command]
    assert statuses
    assert all("--no-optional-locks" in command for command in statuses)
