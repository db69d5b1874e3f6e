"""Every command and every piece of code in the documentation runs."""

import argparse
import importlib.util
import os
import re
import runpy
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import documented
import ghpt.commands.test as testing
import sizes
from documented import PAGES, ROOT, Block, Command
from ghpt.calibration.check.breakages import BREAKAGES
from ghpt.commands import calibrate, predict, train
from ghpt.commands import cameras as camera_check
from ghpt.commands.overrides import Source, check_overrides

MAINS = {
    "train.py": (train.COMMAND, {"last.ckpt", "best.ckpt"}),
    "test.py": (testing.COMMAND, {"predictions.npz", "metrics.json", "report.md"}),
    "predict.py": (predict.COMMAND, {"poses.npz", "report.html", "prediction.json"}),
    "cameras.py": (camera_check.COMMAND, {"cameras.json", "report.html"}),
    "calibrate.py": (calibrate.COMMAND, {"rig.toml", "calibration.json", "report.html"}),
}
"""What a script runs, and what its output folder then holds."""

QUICK = ("trainer.accelerator=cpu", "progress_bar=false")
SMALL = {
    "train.py": (
        *QUICK,
        "data.train_samples=16",
        "model.hypotheses=8",
        "model.scorer.layers=[8]",
        "trainer.max_epochs=1",
    ),
    "test.py": (*QUICK, "data.stride=40", "trajectory=null"),
    "predict.py": (*QUICK, "evaluated_frames=8", "fitted_frames=40", "camera_check.clean=1.0"),
    "cameras.py": ("camera_check.frames=16", "camera_check.shift=2"),
    "calibrate.py": (
        "evaluated_frames=8",
        "calibration.frames=40",
        "camera_check.frames=16",
        "camera_check.shift=2",
    ),
}
"""What makes a command quick, where it does not say otherwise itself."""
SMALL_PAIRS = ("model.problem.draws=1", "model.problem.frames=20")

OF_THE_TRAJECTORY = PAGES if sizes.NIGHTLY else PAGES[:1]
"""Pages on which predict.py estimates the trajectory where nothing else is said: by day README.md
alone, since a trajectory costs a second and tests of its own try it.
"""
LAID_OUT = ("runs/cmu2", "runs/camera")
"""Trained models that every page may start from."""
PLACEHOLDERS = {
    "/path/to/human36m": "human36m",
    "/path/to/cmu": "cmu",
    "image_size=[1920,1080]": "image_size=[1000,1002]",  # of the pages' recording
    "keypoints=openpose/": "keypoints=pose/",
    "[blazepose.npz]": "[points.npz]",
    "ckpt=...": "ckpt=runs/cmu2/last.ckpt",
    "[cam01,cam02,3000]": "[cam01,cam02,10053]",  # mm between the cameras of the pages' recording
}


OWN_SCORERS = {"model=attending", "scorer@model.scorer=residual"}
"""Models whose scorer has no layers to be made small."""
SLOW = {"data=people", "data=random"}
"""Data sets that no override makes small; tests of their own run a part of them."""


class Accepted(Exception):
    """A script has understood its arguments."""


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """The files that the pages name; each page works in a copy."""
    return documented.workplace(tmp_path_factory.mktemp("workplace"))


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A folder in which the models of ``LAID_OUT`` will lie."""
    return tmp_path_factory.mktemp("models")


class Page:
    """Runs what a page holds, in a folder that has what the page speaks of."""

    def __init__(
        self, folder: Path, typed: Callable[..., tuple[int, str, str]], monkeypatch: Any
    ) -> None:
        self.folder, self.typed, self.monkeypatch = folder, typed, monkeypatch
        self.conf = documented.own_conf(folder)
        self.names: dict[str, Any] = {"detect": documented.detected}
        self.laid_out: set[str] = set()
        """Trained models that lie here although the page has not trained them."""

    def execute(self, block: Block) -> None:
        """Write the file that the first line names, or run the code."""
        named = re.match(r"# (\S+\.(?:py|yaml))\n", block.text)
        where = f"{block.page.relative_to(ROOT)}:{block.line}"
        if block.language == "yaml":
            assert named, f"{where}: say in the first line which file this is"
            assert named[1].startswith("conf/"), where
            self.write(self.conf.parent / named[1], block.text)
        elif named:
            path = self.folder / named[1]
            self.write(path, block.text)
        else:
            exec(compile("\n" * (block.line - 1) + block.text, where, "exec"), self.names)

    def write(self, path: Path, text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def run(self, command: Command) -> None:
        """Run a command, made small, and look at what it leaves behind."""
        words = list(command.words[2:])
        for old, new in PLACEHOLDERS.items():
            words = [word.replace(old, new) for word in words]
        if SLOW & set(words):
            return
        given = {word.split("=")[0] for word in words}
        if OWN_SCORERS & set(words):
            given.add("model.scorer.layers")
        more = SMALL[command.script] + (SMALL_PAIRS if "model=camera" in words else ())
        is_alone = command.page not in OF_THE_TRAJECTORY and "ckpt" not in given
        if command.script == "predict.py" and is_alone:
            more += ("estimator=frame",)
        words += [word for word in more if word.split("=")[0] not in given]
        main, files = MAINS[command.script]
        output = next(
            (word.split("=")[1].rstrip("/") for word in words if word.startswith("output=")), None
        )
        if command.script == "train.py" and output in self.laid_out:
            shutil.rmtree(self.folder / output)  # the page's reader has no such folder yet
            self.laid_out.discard(output)
        if "resume=true" in words:  # what was stopped was begun by the same command
            self.typed(self.conf, main, [word for word in words if word != "resume=true"])
        if "-m" in words:  # the first two values of each that is swept
            words = [re.sub(r"^([\w.]+=[\w./]+,[\w./]+),.*", r"\1", word) for word in words]
        status, said, errors = self.typed(self.conf, main, words)
        spoilt = next((word.split("=")[1] for word in words if word.startswith("spoil=")), None)
        if spoilt:
            code = BREAKAGES[spoilt].code
            assert (status, code in errors) == (1, True), f"{command.where}\n{said}{errors}"
        else:
            assert status == 0, f"{command.where}\n{said}{errors}"
        if output and "-m" not in words:
            assert {path.name for path in (self.folder / output).iterdir()} >= files, command.where


def check_pip(command: Command) -> None:
    """What it installs is there to be installed: the file of pins, the extras."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    words = command.words[2:]
    assert command.words[1] == "install"
    for option, value in zip(words, [*words[1:], ""], strict=True):
        if option == "-c":
            assert (ROOT / value).is_file()
    named = re.findall(r"\[([\w,]+)\]", " ".join(words))
    assert set(",".join(named).split(",")) - {""} <= set(extras)
    packages = {re.split(r"[>=\[]", line)[0] for group in extras.values() for line in group}
    assert set(words) <= {"-q", "-c", "constraints.txt", "-e", "."} | packages | {
        word for word in words if re.fullmatch(r"(ghpt|\.)\[[\w,]+\]", word)
    }


def check_program(command: Command) -> None:
    """The program is installed, and its folders are there."""
    assert importlib.util.find_spec(command.words[0]), command.where
    paths = [word for word in command.words[1:] if not word.startswith("-") and not word.isdigit()]
    assert all(
        (ROOT / path).exists() for path in paths if path not in ("check", "format", "serve")
    ), command.where


def check_tensorboard(command: Command) -> None:
    """There are events where it looks."""
    assert command.words[1] == "--logdir"
    assert list(Path(command.words[2]).rglob("events.out.tfevents*"))


SHELL = {
    ("python3", "-m", "venv", ".venv"): lambda command: None,  # Python's own
    (".", ".venv/bin/activate"): lambda command: None,
    ("pip",): check_pip,
    ("ruff",): check_program,
    ("mypy",): check_program,
    ("pytest",): check_program,
    ("mkdocs", "serve"): check_program,
    ("tensorboard",): check_tensorboard,
}
"""Commands that need a shell, or that this test suite is part of: how they are checked instead, by
how they begin.
"""


def check_arguments(command: Command, monkeypatch: Any) -> None:
    """Scripts and benchmarks of many minutes: started, and stopped when they have understood their
    arguments.
    """

    def stop(function: Callable[..., Any]) -> Callable[..., Any]:
        def stopping(*args: Any, **kwargs: Any) -> None:
            raise Accepted(function(*args, **kwargs))

        return stopping

    path = ROOT / command.script
    assert path.is_file(), command.where
    with monkeypatch.context() as patch:
        patch.setattr(sys, "path", [str(path.parent), str(ROOT / "benchmarks"), *sys.path])
        import measure

        patch.setattr(measure, "settings", stop(measure.settings))
        patch.setattr(
            argparse.ArgumentParser, "parse_args", stop(argparse.ArgumentParser.parse_args)
        )
        patch.setattr(sys, "argv", list(command.words[1:]))
        with pytest.raises(Accepted):
            runpy.run_path(str(path), run_name="__main__")


def settings_of(command: Command, first: int = 2) -> list[str]:
    """The words of a command, from ``first`` on, that are no options."""
    return [word for word in command.words[first:] if not word.startswith("-")]


def composed(name: str, command: Command, first: int = 2) -> None:
    """A script whose words are settings of a configuration."""
    check_overrides(Source(ROOT / "conf", name), settings_of(command, first))


SCRIPTS = {
    "scripts/real_recordings.py": lambda command: composed("predict", command, 3),
    "tests/test_memory.py": lambda command: (
        None
    ),  # run by test_memory.py itself, with a folder and a number
    "reproduce.py": lambda command: None,  # below; tests/test_reproduce.py runs it
}
"""Scripts without a parser of their own."""


def commands(page: Path) -> list[Command]:
    fenced = [
        c
        for block in documented.blocks(page)
        if block.language == "bash"
        for c in documented.commands_of(block)
    ]
    return [*fenced, *documented.inline_commands(page)]


def has_own_code(page: Path) -> bool:
    """Whether a page writes files of Python or yaml: what it runs then is its own."""
    return any(re.match(r"# \S+\.(py|yaml)\n", block.text) for block in documented.blocks(page))


OTHER_WORK = {
    "camera_check.clean",
    "ckpt",
    "compare",
    "data.root",
    "estimator",
    "fill",
    "image_size",
    "keypoints",
    "logger",
    "more_keypoints",
    "resume",
    "spoil",
    "time",
}
"""Settings with which a command does other work; what others change is tested elsewhere."""


def sort_of(command: Command) -> tuple[object, ...]:
    """Return what commands that do alike share: script, sweep and which of `OTHER_WORK` is named.

    At night every command is of a sort of its own, and so are those of pages with code.
    """
    if sizes.NIGHTLY or command.script not in MAINS or has_own_code(command.page):
        return command.words
    if "-m" in command.words:
        return (command.script, "-m")
    named = {word.split("=")[0] for word in command.words[2:]} & OTHER_WORK
    return (command.script, frozenset(named), "model=camera" in command.words)


FIRST: dict[tuple[object, ...], Command] = {}
for _page in PAGES:
    for _command in commands(_page):
        FIRST.setdefault(sort_of(_command), _command)


def wanted(command: Command, page: Path) -> bool:
    """Whether it is to be run: it is the first of its sort, or a command of this page that is run
    goes on from its output.
    """
    output = next(
        (word.split("=")[1].rstrip("/") for word in command.words if word.startswith("output=")),
        None,
    )
    if documented.is_notebook(page):  # its cells follow from each other
        return output not in LAID_OUT
    again = output and any(
        any(f"={output}/" in word for word in later.words if not word.startswith("output="))
        and wanted(later, page)
        for later in commands(page)
        if later.line > command.line
    )
    return FIRST[sort_of(command)] == command or bool(again and output not in LAID_OUT)


def lay_out(runner: Page, models: Path) -> None:
    """Put the trained models there; the first page trains them."""
    for output in LAID_OUT:
        if not (models / output).exists():
            kind = "camera" if output == "runs/camera" else "pose"
            data = "h36m" if output == "runs/camera" else "cmu2"
            words = ("python", "train.py", f"data={data}", f"model={kind}", f"output={output}")
            runner.run(Command(PAGES[0], 0, words))
            shutil.copytree(runner.folder / output, models / output)
            runner.laid_out.add(output)
        elif not (runner.folder / output).exists():
            shutil.copytree(models / output, runner.folder / output)
            runner.laid_out.add(output)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_commands_and_the_code_of_a_page_run(
    page, tmp_path, workplace, models, little_data, blank_figures, typed, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copytree(workplace, tmp_path, copy_function=os.link, dirs_exist_ok=True)
    runner = Page(tmp_path, typed, monkeypatch)
    if documented.is_notebook(page):
        lay_out(runner, models)
    for block in documented.blocks(page):
        if not block.language:
            commands_in_it = re.findall(r"^python ", block.text, re.MULTILINE)
            assert commands_in_it == [], f"{page}:{block.line}: bash?"
        if block.language in ("python", "yaml"):
            if any(output in block.text for output in LAID_OUT):
                lay_out(runner, models)
            runner.execute(block)
        elif block.language == "bash":
            for command in documented.commands_of(block):
                attempt(runner, command, page, models)
        elif block.language == "console":  # of a cluster, several processes or minutes
            for command in documented.commands_of(block):
                name = Path(command.script).stem
                if (ROOT / "conf" / f"{name}.yaml").is_file():
                    check_overrides(Source(runner.conf, name), settings_of(command))
                else:
                    check_arguments(command, monkeypatch)
    for command in documented.inline_commands(page):
        attempt(runner, command, page, models)
    assert Path.cwd() == tmp_path


def attempt(runner: Page, command: Command, page: Path, models: Path) -> None:
    if not wanted(command, page):
        if command.script in MAINS and "--cfg" not in command.words:
            name = Path(command.script).stem
            check_overrides(Source(runner.conf, name), settings_of(command))
        return
    if command.script in MAINS:
        lay_out(runner, models)
        runner.run(command)
    elif command.script in SCRIPTS:
        SCRIPTS[command.script](command)
    elif command.script and re.match(r"(scripts|benchmarks)/", command.script):
        check_arguments(command, runner.monkeypatch)
    else:
        known = [how for begins, how in SHELL.items() if command.words[: len(begins)] == begins]
        assert known, f"{command.where}: no test knows how to run this"
        known[0](command)


REPRODUCE = [
    command for page in PAGES for command in commands(page) if command.script == "reproduce.py"
]


@pytest.mark.parametrize("command", REPRODUCE, ids=lambda command: command.where)
def test_the_settings_of_reproduce_exist(command):
    words = settings_of(command)
    assert len(check_overrides(Source(ROOT / "conf", "reproduce"), words)) == len(words)
