"""What a user can get wrong with data and settings, through `train`: a named error, and nothing
written half.

Single files and arrays have their cases beside their readers: test_labels, test_human36m,
test_panoptic, test_rigs, test_store, test_validate; checkpoints in
reliability/test_checkpoint_code; the command line in test_cli.
"""

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import toys
from composed import compose
from ghpt.config import build
from ghpt.errors import GhptConfigError, GhptDataError, GhptError
from ghpt.files import atomic_write
from toys import train


def config(*overrides: str) -> dict[str, Any]:
    composed = compose("train", "progress_bar=false", *overrides)
    composed["model"]["scorer"]["layers"] = [4]
    composed["trainer"] |= {"accelerator": "cpu", "devices": 1}
    return composed


def toy(**data: Any) -> dict[str, Any]:
    return copy.deepcopy(toys.TRAIN) | {"data": toys.DATA | data}


def check_refused(
    settings: dict[str, Any], folder: Path, kind: type[GhptError], message: str
) -> None:
    """`train` raises this error, and leaves no file in its output and no recording in the cache."""
    settings["data"]["cache"] = str(folder / "cache")
    with pytest.raises(kind, match=message):
        train(settings, folder / "run")
    left = [path for path in folder.rglob("*") if path.is_file() and "tfevents" not in path.name]
    assert not left


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (
            ["data=h36m", "data.cameras=[0]"],
            GhptConfigError,
            r"data\.cameras: is \[0\]\. Triangulation needs at least 2",
        ),
        (
            ["data=cmu1", "data.cameras=[]"],
            GhptConfigError,
            r"data\.cameras: is \[\]\. Triangulation needs at least 2",
        ),
        (["data=cmu1", "data.cameras=[3,7,3]"], GhptDataError, "camera 3 is listed twice"),
        (
            ["data=cmu1", "data.cameras=[3,31]"],
            GhptDataError,
            r"no HD camera 31\. HD cameras are 0 to 30",
        ),
        (
            ["data=h36m", "data.root=/no/such"],
            GhptDataError,
            r"/no/such: data\.root: there is no such folder",
        ),
        (["data=cmu1", "data.name=cmu7"], GhptConfigError, r"is 'cmu7'\. Choose from cmu1"),
    ],
)
def test_cameras_and_folders(tmp_path, words, kind, message):
    check_refused(config(*words), tmp_path, kind, message)


@pytest.mark.parametrize(
    ("data", "missing"), [("h36m", "labels"), ("cmu1", "sequence|calibration|folder")]
)
def test_a_folder_that_is_not_the_data_set(tmp_path, data, missing):
    (tmp_path / "empty").mkdir()
    check_refused(
        config(f"data={data}", f"data.root={tmp_path / 'empty'}"), tmp_path, GhptDataError, missing
    )


def test_a_truncated_labels_file(tmp_path):
    (tmp_path / "root").mkdir()
    name = "human36m-multiview-labels-GTbboxes.npy"
    np.save(tmp_path / "whole.npy", {"a": np.zeros(1000)}, allow_pickle=True)
    with atomic_write(tmp_path / "root" / name) as handle:
        handle.write((tmp_path / "whole.npy").read_bytes()[:500])
    (tmp_path / "whole.npy").unlink()
    settings = config("data=h36m", f"data.root={tmp_path / 'root'}")
    settings["data"]["cache"] = str(tmp_path / "cache")
    with pytest.raises(GhptDataError, match=str(tmp_path / "root")):
        train(settings, tmp_path / "run")
    assert not list((tmp_path / "cache").glob("*"))


def test_an_empty_split(tmp_path, monkeypatch):
    make = toys.ToyData.generate
    monkeypatch.setattr(
        toys.ToyData, "generate", lambda self, split: [] if split == "train" else make(self, split)
    )
    check_refused(
        toy(), tmp_path, GhptDataError, r"synthetic: train: there are no frames to prepare"
    )


def test_no_frame_with_enough_joints(tmp_path):
    settings = toy(missing=0.95, cache=str(tmp_path / "cache"))
    with pytest.raises(
        GhptDataError,
        match=r"toy train: no frame has a true pelvis and 5 joints seen in two views\. Lower",
    ):
        train(settings, tmp_path / "run")
    assert not [path for path in (tmp_path / "run").rglob("*") if "tfevents" not in path.name]


@pytest.mark.parametrize("place", ["key_points", "truth", "K", "R", "t"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_source_that_gives_what_is_not_finite(tmp_path, monkeypatch, place, value):
    make = toys.ToyData.generate

    def broken(self, split):
        for recording in make(self, split):
            array = getattr(recording.cameras if place in "KRt" else recording, place)
            if isinstance(array, torch.Tensor):
                array = array.clone()
                object.__setattr__(recording.cameras, place, array)
            array[(0,) * array.ndim] = value
            yield recording

    monkeypatch.setattr(toys.ToyData, "generate", broken)
    check_refused(toy(), tmp_path, GhptDataError, rf"S0/Walking-1: {place}: .*not finite")


def numbers(node: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    if isinstance(node, dict):
        return [leaf for key, value in node.items() for leaf in numbers(value, (*path, key))]
    return [path] if isinstance(node, int | float) and not isinstance(node, bool) else []


def changed(settings: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    settings = copy.deepcopy(settings)
    node = settings
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    return settings


PARTS = {part: toys.TRAIN[part] for part in ("model", "data", "save_every", "seed")}
NUMBERS = [
    path for path in numbers(PARTS) if path not in (("data", "views"), ("data", "missing"))
]  # the toy's own


def test_there_are_numbers():
    assert ("model", "loss", "beta") in NUMBERS
    assert len(NUMBERS) > 12


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_every_number_has_a_type_and_a_range_and_is_named(tmp_path, path):
    """-1 is right for a seed alone; text and NaN are wrong everywhere."""
    wrong = (
        ["many", math.nan]
        if path[-1] == "seed"
        else ["many", math.nan, -1 if _whole(path) else -1.0]
    )
    for value in wrong:
        name = "model.optimizer" if "optimizer" in path and value == -1 else ".".join(path)
        check_refused(changed(toy(), path, value), tmp_path, GhptConfigError, f"^{name}: ")


def _whole(path: tuple[str, ...]) -> bool:
    node: Any = toys.TRAIN
    for key in path:
        node = node[key]
    return isinstance(node, int)


@pytest.mark.parametrize("baseline", ["ransac", "m_estimator", "lo_ransac", "weighted_linear"])
def test_every_number_of_a_baseline_too(baseline):
    settings = compose("test")["baselines"][baseline]
    for path in numbers(settings):
        if path[-1] != "seed":
            with pytest.raises(GhptConfigError, match=f"^baselines.{baseline}.{path[-1]}: is -1"):
                build(changed(settings, path, type(settings[path[0]])(-1)), f"baselines.{baseline}")
        with pytest.raises(GhptConfigError, match=f"^baselines.{baseline}.{path[-1]}: is 'many'"):
            build(changed(settings, path, "many"), f"baselines.{baseline}")
