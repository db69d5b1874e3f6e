"""DeepLabCut, SLEAP and LightningPose through the package movement, where it is installed."""

import sys
import types

import numpy as np
import pytest

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.errors import GhptDataError
from single_person import read_person

NAMES = (
    "Nose",
    *(
        f"{side}_{part}"
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in "LR"
    ),
)
POINTS = np.random.default_rng(0).uniform(1, 500, (5, len(NAMES), 2)).round(2)


def csv(path, likelihood=0.9, rows=range(5)):
    head = [
        ["scorer", "bodyparts", "coords"],
        *([*("model", n, c)] for n in NAMES for c in ("x", "y", "likelihood")),
    ]
    lines = [",".join(column[i] for column in head) for i in range(3)]
    for t in rows:
        lines.append(
            ",".join(
                map(
                    str, [t, *np.column_stack([POINTS[t], np.full(len(NAMES), likelihood)]).ravel()]
                )
            )
        )
    path.write_text("\n".join(lines) + "\n")


def test_without_movement_the_command_that_installs_it_is_told(tmp_path, monkeypatch):
    csv(tmp_path / "cam1.csv")
    monkeypatch.setitem(sys.modules, "movement", None)
    monkeypatch.setitem(sys.modules, "movement.io", None)
    for form in (None, "deeplabcut", "lightningpose"):
        with pytest.raises(GhptDataError, match=r"need the package movement.*pip install movement"):
            read_person(tmp_path, format=form)


class Data(dict):
    """What movement returns, as far as it is used: arrays with named dimensions."""


class Array:
    def __init__(self, values, dims):
        self.values, self.dims = values, dims

    def transpose(self, *dims):
        return self.values.transpose([self.dims.index(dim) for dim in dims])


def movement_s(read):
    """A package movement whose every loader is ``read``."""
    package, io, poses = (
        types.ModuleType(name) for name in ("movement", "movement.io", "movement.io.load_poses")
    )
    poses.from_dlc_file = poses.from_lp_file = poses.from_sleap_file = read
    io.load_poses, package.io = poses, io
    return {"movement": package, "movement.io": io, "movement.io.load_poses": poses}


def test_what_movement_reads_is_taken_by_name(tmp_path, monkeypatch):
    """Two individuals, one of whom is not there in a frame; scores that are not there count as
    1."""
    position = np.stack([POINTS, POINTS + 600], axis=-1).transpose(0, 2, 1, 3).copy()
    position[3, :, :, 1] = np.nan
    confidence = np.full(position[:, 0].shape, 0.7)
    confidence[:, 2] = np.nan
    dims = ("time", "space", "keypoints", "individuals")
    data = Data(
        position=Array(position, dims),
        keypoints=Array(np.array(NAMES), ("keypoints",)),
        confidence=Array(confidence, ("time", "keypoints", "individuals")),
    )
    for name, module in movement_s(lambda file: data).items():
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("cam1DLC_resnet50_trial.csv", "cam2DLC_resnet50_trial.csv"):
        csv(tmp_path / name)
    found = read_key_points(tmp_path)
    assert found.views == ("cam1", "cam2")
    assert set(found.joints) < set(SKELETONS["coco_17"])
    assert found.counts().tolist() == [[2, 2]] * 3 + [[1, 1]] + [[2, 2]]
    np.testing.assert_array_equal(found.points.pixels[:2], np.stack([POINTS[0], POINTS[0] + 600]))
    assert found.points.confidence[0, 1:4].tolist() == [0.7, 1, 0.7]


def test_what_movement_cannot_read_is_named(tmp_path, monkeypatch):
    def fail(file):
        raise KeyError("bodyparts")

    for name, module in movement_s(fail).items():
        monkeypatch.setitem(sys.modules, name, module)
    csv(tmp_path / "cam1.csv")
    with pytest.raises(
        GhptDataError, match=r"cam1\.csv: is damaged, or not DeepLabCut's \('bodyparts'\)"
    ):
        read_key_points(tmp_path)


def test_a_real_file_by_the_real_package(tmp_path):
    pytest.importorskip("movement")
    for name in ("cam1", "cam2"):
        csv(tmp_path / f"{name}.csv")
    found = read_person(tmp_path)
    np.testing.assert_array_equal(found.key_points, np.stack([POINTS, POINTS], axis=1))
    assert (found.confidence == 0.9).all()
