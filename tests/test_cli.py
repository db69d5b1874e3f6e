"""The command line as a user meets it: what it writes and says, how it fails, how it is stopped and
goes on.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath

import numpy as np
import pytest
import torch
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import children
import ghpt.commands.test as testing
import toys
from ghpt.commands.display import as_started, shell_override
from ghpt.commands.overrides import flags_first, parse_options, use_slashes
from ghpt.commands.train import COMMAND
from ghpt.models import callbacks
from ghpt.models.checkpoint import read_checkpoint
from ghpt.models.module import StochasticEstimator
from toys import train

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "data=toy",
    "model.hypotheses=5",
    "model.scorer.layers=[4]",
    "trainer.accelerator=cpu",
    "progress_bar=false",
)


@pytest.fixture
def command(conf, typed):
    """``command("train", *words)`` runs train.py in this process: (exit status, stdout, stderr)."""
    commands = {"train": COMMAND, "test": testing.COMMAND}
    return lambda name, *words: typed(conf, commands[name], words)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def events(folder):
    (file,) = folder.glob("*tfevents*")
    return EventAccumulator(str(file), size_guidance={"images": 0}).Reload()


def test_train_then_test_as_typed(command, tmp_path):
    output = tmp_path / "a run"
    status, _, said = command("train", *SMALL, f"output='{output}'", "trainer.max_epochs=2")
    assert status == 0
    written = [re.sub(r"tfevents.*", "tfevents", name) for name in files(output)]
    assert written == [
        ".ghpt/finished.json",
        ".ghpt/lock",
        ".ghpt/manifest.json",
        ".hydra/config.yaml",
        ".hydra/hydra.yaml",
        ".hydra/overrides.yaml",
        "best.ckpt",
        "events.out.tfevents",
        "last.ckpt",
        "previous.ckpt",
        "train.log",
    ]
    assert re.search(
        r"Validation on synthetic toy.*\n  weight \d+\.\d mm, average .* mm, random .* mm\n",
        said,
    )
    assert said.replace("\n", "") in re.sub(
        r".* INFO ghpt\.[\w.]+: |\n", "", (output / "train.log").read_text()
    )
    log = events(output)
    shown = set(log.Tags()["scalars"])
    assert {"train/total", "train/entropy", "validation/weight"} <= shown
    assert "epoch" not in shown
    assert "_hparams_/session_start_info" in log.summary_metadata

    next_command = re.search(r"Test it: python test\.py (.*) data=h36m", said)[1]
    assert next_command == f"\"ckpt='{output}/last.ckpt'\""  # quoted for the shell and for Hydra
    tested = tmp_path / "tested"
    status, table, said = command(
        "test",
        next_command.strip('"'),
        "data=toy",
        f"output={tested}",
        "progress_bar=false",
        "trainer.accelerator=cpu",
    )
    assert status == 0
    assert str(tested / "report.md") in said
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in table
    log = events(tested)
    assert {tag.partition("/")[0] for tag in log.Tags()["scalars"]} == {"test"}
    assert log.Tags()["histograms"]
    assert {"visual/skeletons", "visual/pose_prior_S0"} <= set(log.Tags()["images"])
    assert "_hparams_/session_start_info" in log.summary_metadata
    metrics = json.loads((tested / "metrics.json").read_text())
    assert f"{metrics['selections']['weight']['mpjpe_relative']:.1f}" in table


def test_a_frame_with_too_few_views_is_missing_in_the_file_and_never_invented(
    command, blank_figures, tmp_path
):
    few = ("data=toy", "data.missing=0.6", "progress_bar=false", "trainer.accelerator=cpu")
    assert (
        command(
            "train",
            *few,
            "model.hypotheses=5",
            "model.scorer.layers=[4]",
            f"output={tmp_path / 'a'}",
        )[0]
        == 0
    )
    assert (
        command("test", *few, f"ckpt={tmp_path / 'a' / 'last.ckpt'}", f"output={tmp_path / 'b'}")[0]
        == 0
    )
    data = toys.ToyData(
        **{k: v for k, v in (toys.DATA | {"missing": 0.6}).items() if k != "_target_"}
    )
    data.setup("test")
    enough = torch.from_numpy(
        np.concatenate(
            [recording.valid[::3].sum(axis=1) >= 2 for recording in data.frames["test"].recordings]
        )
    ).numpy()
    assert 0.2 < enough.mean() < 0.9
    with np.load(tmp_path / "b" / "predictions.npz") as arrays:
        names = [name.removeprefix("points_") for name in arrays if name.startswith("points_")]
        names.remove("trajectory")  # carries a joint that one view sees
        assert {"weight", "best", "linear", "ransac", "lo_ransac"} <= set(names)
        for name in names:
            assert not arrays[f"estimated_{name}"][~enough].any(), name
            np.testing.assert_array_equal(
                np.isnan(arrays[f"points_{name}"]).all(-1), ~arrays[f"estimated_{name}"]
            )
    metrics = json.loads((tmp_path / "b" / "metrics.json").read_text())
    assert metrics["selections"]["linear"]["coverage"] == pytest.approx(enough.mean(), abs=0.02)


def test_a_sweep_runs_on_after_a_failure_and_says_which(command, tmp_path):
    words = (*SMALL, "model.temperature=-1.0,2.0", "trainer.max_epochs=1", f"output={tmp_path}")
    status, said, _ = command("train", "-m", *words)
    assert status == 1
    failed, done = said.split("Jobs of the sweep:\n")[1].splitlines()
    assert failed.startswith("  0_model.temperature--1.0: error: model.temperature: is -1.0.")
    assert re.fullmatch(r"  1_model\.temperature-2\.0: weight \d.* mm, random \d.* mm", done)
    assert not (tmp_path / "0_model.temperature--1.0" / "last.ckpt").exists()
    assert (
        "error: model.temperature: is -1.0"
        in (tmp_path / "0_model.temperature--1.0" / "train.log").read_text()
    )
    assert read_checkpoint(tmp_path / "1_model.temperature-2.0" / "last.ckpt")


TYPOS = {
    "data=cmu9": r"data: there is no 'cmu9'\. Did you mean 'cmu4'\? Existing: cmu1, cmu2, ",
    "dat=cmu1": r"dat: no such setting\. Did you mean 'data'\? ",
    "data.strid=1": r"data\.strid: .* in data\. Did you mean 'stride'\? ",
    "data.synthetic.detector.nois=1": r".*\.detector\.nois: .* Did you mean 'noise'\? ",
    "model=posee": r"model: there is no 'posee'\. Did you mean 'pose'\? ",
    "model.hypothesis=3": r"model\.hypothesis: .* Did you mean 'hypotheses'\? ",
    "model.scorer.layer=3": r"model\.scorer\.layer: .* Did you mean 'layers'\? ",
    "+model.scorer.layer=3": r"model\.scorer\.layer: Scorer has no .* Did you mean 'layers'\? ",
    "trainer.max_epoch=1": r"trainer\.max_epoch: .* Did you mean 'max_epochs'\? ",
    "+trainer.max_step=1": r"trainer\.max_step: Trainer has no .* Did you mean 'max_steps'\? ",
    "+trainer.callbacks=[]": r"trainer\.callbacks: is not for the configuration: ghpt sets it",
    "experiment=x": r"experiment: there is no 'x'\. Existing: coordinates_only, ",
    "experiment=null": r"experiment: there is no null\. Existing: ",
    "+foo=1": r"foo: no such setting\. Existing: best, callbacks, ",
    "+data.foo=1": r"data\.foo: Panoptic has no such setting\. Existing: batch_size, ",
    "lr=0.1": r"lr: no such setting\. Did you mean 'model\.optimizer\.lr'\? ",
    "cmu2": r"cmu2: is not of the form key=value\. ",
    "model.scorer.layers=[1": r"model\.scorer\.layers=\[1: is not of the form key=value\. ",
    "model.hypotheses=abc": r"model\.hypotheses: is 'abc', not an integer\. ",
    "model.hypotheses=2.5": r"model\.hypotheses: is 2\.5, not an integer\. ",
    "model.gumbel=3": r"model\.gumbel: is 3, not true or false\. ",
    "model.temperature=-1.0": r"model\.temperature: is -1\.0\. ",
    "model.temperature=nan": r"model\.temperature: is nan, not a finite number\. ",
    "model.problem=3": r"model\.problem: is 3, not a ",
    "model.scorer.layers=7": r"model\.scorer\.layers: is 7, not a list \(an integer each\)\. ",
    "model.scorer.layers=[a]": r"model\.scorer\.layers: is \['a'\], not a list ",
    "model.optimizer.lr=abc": r"model\.optimizer\.lr: is 'abc', not a finite number\. ",
    "model.optimizer.lr=-1": r"model\.optimizer: Invalid learning rate: -1\. ",
    "model._target_=ghpt.models.modul.X": r"model\._target_: no class 'ghpt\.models\.modul\.X'\. ",
    "data.batch_size=0": r"data\.batch_size: is 0\. ",
    "data.cameras=3": r"data\.cameras: is 3, not a list \(an integer each\)\. ",
    "data.evaluate=tset": r"data\.evaluate: is 'tset'\. Existing: train, validation, test\.",
    "data.root=/no/such": r"/no/such: data\.root: there is no such folder\. ",
    "seed=abc": r"seed: is 'abc', not an integer\. ",
    "resume=3": r"resume: is 3, not true or false or 'auto'\. ",
    "save_every=0": r"save_every: is 0\. ",
    "trainer.accelerator=gpuu": r"trainer: You selected an invalid accelerator name: ",
    "trainer.max_epochs=x": r"trainer\.max_epochs: is 'x', not an integer or null\. ",
    "resume=true": r".*last\.ckpt: there is no such file\. ",
    "output=/proc/no": r"output: .*'/proc/no'\. Name a folder that can be written\. ?",
}


@pytest.mark.parametrize("typo", TYPOS)
def test_a_mistake_ends_in_one_line_that_names_it(command, tmp_path, typo):
    status, out, said = command("train", f"output={tmp_path}", "progress_bar=false", typo)
    assert status == 1
    assert re.fullmatch(f"error: {TYPOS[typo]}.*\n", said), said
    assert out == ""
    records = (".ghpt/", ".hydra/", "train.log")
    assert not [name for name in files(tmp_path) if not name.startswith(records)]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        (None, "ckpt: is missing. Name one: python test.py ckpt="),
        (
            "ckpt=/no/such.ckpt",
            "/no/such.ckpt: there is no such file. Give the last.ckpt or best.ckpt",
        ),
        ("ckpt=3", "ckpt: is 3, not text or null"),
        ("hypotheses=many", "hypotheses: is 'many', not an integer or null"),
        (
            "baselines.ransac.pair=3",
            "baselines.ransac.pair: no such setting in baselines.ransac. Did you mean 'pairs'?",
        ),
        ("model=pose", "Could not override 'model'."),
    ],
)
def test_a_mistake_in_testing(command, tmp_path, word, message):
    status, _, said = command("test", f"output={tmp_path}", *([word] if word else []))
    assert status == 1
    assert said.startswith(f"error: {message}")
    assert said.count("\n") == 1


def test_a_log_that_is_not_ours_is_left_alone(command, tmp_path):
    (tmp_path / "train.log").write_text("somebody's")
    status, _, said = command("train", *SMALL, f"output={tmp_path}")
    assert status == 1
    assert re.fullmatch(r"error: .*train\.log: was not written by ghpt, .*\n", said)
    assert files(tmp_path) == ["train.log"]
    assert (tmp_path / "train.log").read_text() == "somebody's"


def test_the_trace_is_shown_to_who_asks_for_it(conf, tmp_path):
    words = [sys.executable, str(ROOT / "train.py"), f"output={tmp_path}", "data=cmu9"]
    quiet = subprocess.run(words, capture_output=True, text=True)
    assert (quiet.returncode, quiet.stderr.count("\n"), quiet.stdout) == (1, 1, "")
    loud = children.run(*words[1:], env={"HYDRA_FULL_ERROR": "1"})
    assert loud.status == 1
    assert "Traceback" in loud.errors
    assert "GhptConfigError: data: there is no 'cmu9'" in loud.errors


def test_values_are_typed_as_shell_and_hydra_take_them():
    assert shell_override("ckpt", "runs/1_a-2.0/last.ckpt") == "ckpt=runs/1_a-2.0/last.ckpt"
    assert shell_override("output", "runs/a=b") == "\"output='runs/a=b'\""
    assert shell_override("ckpt", "a b/[1],x=2") == "\"ckpt='a b/[1],x=2'\""
    for value in ("März", "o'brien/$x", 'it\'s "new"', "my data\\", "a\\'b"):
        (word,) = shlex.split(shell_override("output", value))
        assert OverridesParser.create().parse_override(word).value() == value


WINDOWS_PATHS = {
    r"C:\data\pose": "C:/data/pose",
    "'C:\\my data\\'": "C:/my data/",
    r"'D:\März (1)\b'": "D:/März (1)/b",
    r"\\server\share\pose": "//server/share/pose",
    r"..\pose": r"..\pose",
}


@pytest.mark.parametrize("typed", WINDOWS_PATHS)
def test_paths_of_windows_come_through(typed):
    (word,) = use_slashes([f"keypoints={typed}"])
    value = str(OverridesParser.create().parse_override(word).value())
    assert value == WINDOWS_PATHS[typed]
    assert PureWindowsPath(value) == PureWindowsPath(typed.strip("'"))


@contextmanager
def restored(number):
    """Lightning leaves an interrupt ignored."""
    before = signal.getsignal(number)
    try:
        yield
    finally:
        signal.signal(number, before)


STOPPED = {"trainer": {"max_epochs": 12}, "train": {"save_every": 2}}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    train(toys.TRAIN | STOPPED["train"] | {"trainer": toys.TRAINER | STOPPED["trainer"]}, folder)
    return read_checkpoint(folder / "last.ckpt")


@pytest.mark.posix
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_says_how_to_go_on_and_ends_as_if_it_had_not_been(
    tmp_path, uninterrupted, number, status
):
    script = ROOT / "tests" / "reliability" / "run_toy.py"
    child = children.start(script, tmp_path, json.dumps(STOPPED))
    last = tmp_path / "last.ckpt"
    children.wait_until(last.exists, child)
    child.send_signal(number)
    _, said = child.communicate(timeout=children.LIMIT)
    assert child.returncode == status, said
    stopped = read_checkpoint(last)["global_step"]
    assert 0 < stopped < uninterrupted["global_step"]
    assert f"last.ckpt holds training step {stopped}.\n" in said
    assert f"Go on with the same command and output={tmp_path} resume=true" in said
    assert "Traceback" not in said
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".tmp")]
    train(
        toys.TRAIN
        | STOPPED["train"]
        | {"resume": True, "trainer": toys.TRAINER | STOPPED["trainer"]},
        tmp_path,
    )
    resumed = read_checkpoint(last)
    assert resumed["global_step"] == uninterrupted["global_step"]
    for key, value in uninterrupted["state_dict"].items():
        assert torch.equal(resumed["state_dict"][key], value), key


@pytest.mark.posix
def test_a_second_interrupt_takes_effect_at_once(tmp_path, monkeypatch):
    """Sent within a step, of which the first waits for the end."""
    reached = []

    def interrupted_twice(self, batch, batch_idx):
        os.kill(os.getpid(), signal.SIGINT)
        reached.append("between")
        os.kill(os.getpid(), signal.SIGINT)
        reached.append("after")

    monkeypatch.setattr(StochasticEstimator, "training_step", interrupted_twice)
    with restored(signal.SIGINT), pytest.raises(SystemExit) as stop:
        train(toys.TRAIN, tmp_path)
    assert (stop.value.code, reached) == (130, ["between"])
    assert not [name for name in files(tmp_path) if "tfevents" not in name]


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a signal of POSIX")
@pytest.mark.parametrize(
    ("numbers", "reached", "saved"),
    [
        (["SIGHUP"], ["within"], True),
        (
            ["SIGHUP", "SIGHUP"],
            ["within", "within"],
            True,
        ),  # a closed terminal and its shell both send it
        (["SIGHUP", "SIGTERM"], ["within"], False),
        (["SIGTERM", "SIGHUP"], ["within", "within"], True),
    ],
)
def test_a_closed_terminal_stops_a_training_as_sigterm_does(
    tmp_path, monkeypatch, numbers, reached, saved
):
    found = []
    step = StochasticEstimator.training_step

    def signalled(self, batch, batch_idx):
        for name in numbers:
            os.kill(os.getpid(), getattr(signal, name))
            found.append("within")
        return step(self, batch, batch_idx)

    monkeypatch.setattr(StochasticEstimator, "training_step", signalled)
    with restored(signal.SIGTERM), restored(signal.SIGHUP), pytest.raises(SystemExit) as stop:
        train(toys.TRAIN, tmp_path)
    assert (stop.value.code, found) == (143, reached)
    assert (tmp_path / "last.ckpt").exists() == saved


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a signal of POSIX")
def test_under_nohup_a_closed_terminal_is_ignored(tmp_path, monkeypatch):
    step = StochasticEstimator.training_step

    def signalled(self, batch, batch_idx):
        os.kill(os.getpid(), signal.SIGHUP)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(StochasticEstimator, "training_step", signalled)
    with restored(signal.SIGHUP):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        assert train(toys.TRAIN, tmp_path)
    assert read_checkpoint(tmp_path / "last.ckpt")["epoch"] == 1


def test_a_system_without_that_signal_trains(tmp_path, monkeypatch):
    """As Windows is."""
    monkeypatch.setattr(callbacks, "_HANG_UP", None)
    assert train(toys.TRAIN, tmp_path)


@pytest.mark.posix
def test_an_interrupt_while_the_data_are_prepared_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(self, split):
        raise KeyboardInterrupt

    monkeypatch.setattr(toys.ToyData, "generate", interrupted)
    with restored(signal.SIGINT), pytest.raises(SystemExit) as stop:
        train(
            toys.TRAIN | {"data": toys.DATA | {"cache": str(tmp_path / "cache")}}, tmp_path / "run"
        )
    assert stop.value.code == 130
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    ("words", "status"), [(("train", "--help"), 1), (("train", "--info", "config"), 0)]
)
def test_what_nobody_reads_ends_without_a_word(words, status):
    """Help breaks off; lines of a log are lost."""
    reading, writing = os.pipe()
    os.close(reading)
    program = [sys.executable, "-m", "ghpt", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    ended = subprocess.run(program, stdout=writing, stderr=subprocess.PIPE, env=environment)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (status, b"")


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("train.py", "Run python test.py ckpt=x; train.py wrote it, mytrain.py did not"),
        ("ghpt train", "Run ghpt test ckpt=x; ghpt train wrote it, mytrain.py did not"),
    ],
)
def test_commands_are_named_as_the_program_was_started(monkeypatch, program, said):
    monkeypatch.setattr(sys, "argv", [program])
    text = "Run python test.py ckpt=x; train.py wrote it, mytrain.py did not"
    assert as_started(text) == said


def test_the_option_of_a_sweep_may_stand_anywhere():
    words = ["data=cmu1,cmu2", "-m", "seed=1"]
    assert flags_first(words) == ["-m", "data=cmu1,cmu2", "seed=1"]
    arguments = parse_options(get_args_parser(), ["data=cmu1", "--cfg", "job", "seed=1"])
    assert (arguments.overrides, arguments.cfg) == (["data=cmu1", "seed=1"], "job")
