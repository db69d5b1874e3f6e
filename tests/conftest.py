"""Fixtures shared by all tests."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

import children
import quick

if TYPE_CHECKING:  # the process that only hands out tests to others does not import torch
    from ghpt.commands.app import Command

ROOT = Path(__file__).resolve().parents[1]
WORKER = "PYTEST_XDIST_WORKER" in os.environ
if WORKER:  # each of several test processes has its own core, and so have the commands that it runs
    import torch

    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)

quick.make_quick()

FIRST = (
    "test_docs.py",
    "test_calibrate.py",
    "test_camera_check.py",
    "test_predict.py",
    "test_cli.py",
    "test_verdict.py",
    "test_commands_agree.py",
    "test_ddp.py",
    "test_reproduce.py",
)
"""The files that take longest: begun first, so that no test process waits for another's last."""
CACHE = pytest.StashKey[tempfile.TemporaryDirectory[str]]()
SERVER = pytest.StashKey[children.Server]()


def pytest_configure(config: pytest.Config) -> None:
    """Set up what all test processes share: a cache of prepared recordings, in place of the user's,
    and the server of child processes.
    """
    if WORKER:
        return
    config.stash[CACHE] = tempfile.TemporaryDirectory(prefix="ghpt-cache-")
    os.environ["GHPT_CACHE"] = config.stash[CACHE].name
    if sys.platform == "linux":
        config.stash[SERVER] = children.Server()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Clear it away."""
    if SERVER in config.stash:
        config.stash[SERVER].close()
    if CACHE in config.stash:
        config.stash[CACHE].cleanup()


@pytest.fixture(autouse=True)
def own_children() -> Iterator[None]:
    """Children that a test has left running end with it."""
    yield
    children.close_all()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Have one of several test processes run all tests of a file, in the order of the files: what
    the tests of a file share is then made once.
    """
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


def _place(item: pytest.Item) -> int:
    return FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files of ``FIRST`` first; skip on Windows what is marked ``posix``."""
    items.sort(key=_place)
    if os.name != "nt":
        return
    for item in items:
        if item.get_closest_marker("posix"):
            item.add_marker(
                pytest.mark.skip(reason="needs forks, signals or programs that Windows lacks")
            )


if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # so a script's background job starts, and all that it starts
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real calibrations, motion and detections that developers have beside the
    project.
    """
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the developers' real data is not at {folder}")
    return folder


@pytest.fixture
def little_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Synthetic data sets of one subject a split, a few actions and some frames, in a cache of
    their own, which all tests share.
    """
    from ghpt.data.synthetic import recordings as synthetic

    frames = {"train": 16, "validation": 16, "test": 80}
    subjects = {"train": ("S1",), "validation": ("S8",), "test": ("S9",)}
    monkeypatch.setattr(synthetic, "HUMAN36M_FRAMES", frames)
    monkeypatch.setattr(synthetic, "HUMAN36M_SUBJECTS", subjects)
    monkeypatch.setattr(synthetic, "action_names", lambda: ("Eating", "Sitting", "Walking"))
    monkeypatch.setattr(synthetic, "PANOPTIC_FRAMES", 400)
    monkeypatch.setattr(synthetic, "PANOPTIC_SUBJECTS", ("P1",))
    monkeypatch.setenv("GHPT_CACHE", os.path.join(os.environ["GHPT_CACHE"], "little"))


@pytest.fixture
def blank_figures() -> Iterator[None]:
    """Figures stay blank, see `blank`."""
    import blank

    with blank.blank_figures():
        yield


@pytest.fixture(scope="session")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's configuration with one more data set, ``toy``, which is made at once."""
    import toys

    folder = tmp_path_factory.mktemp("conf") / "conf"
    shutil.copytree(ROOT / "conf", folder)
    (folder / "data" / "toy.yaml").write_text(yaml.safe_dump(toys.DATA))
    return folder


@pytest.fixture
def typed(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """``typed(conf, command, words)`` runs train.py in this process: (exit status, stdout,
    stderr)."""
    from ghpt.commands.app import run

    handlers, level = list(logging.root.handlers), logging.root.level
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")

    def call(conf: Path, command: Command, words: Any) -> tuple[int, str, str]:
        os.environ["HYDRA_FULL_ERROR"] = "0"
        monkeypatch.setattr(sys, "argv", [f"{command.name}.py", *map(str, words)])
        status = 0
        capfd.readouterr()
        try:
            run(conf, command)
        except SystemExit as stop:
            status = stop.code
            if isinstance(status, str):  # what Python itself would do with it
                print(status, file=sys.stderr)
                status = 1
        finally:
            for handler in set(logging.root.handlers) - set(handlers):
                handler.close()
            logging.root.handlers[:] = handlers
            logging.root.setLevel(level)
        return (status, *capfd.readouterr())

    return call
