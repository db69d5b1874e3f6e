"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest
import torch

WORKER = "PYTEST_XDIST_WORKER" in os.environ
if WORKER:  # each of several test processes has its own core, and so have the commands that it runs
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real calibrations, motion and detections that developers have beside the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the developers' real data is not at {folder}")
    return folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prepared recordings go to a folder of the test session, shared by its tests, never to the user's cache."""
    base = tmp_path_factory.getbasetemp()
    monkeypatch.setenv("GHPT_CACHE", str((base.parent if WORKER else base) / "cache"))
