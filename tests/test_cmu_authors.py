"""The authors' flat CMU folder: what it does not say is told by the truth on the key points."""

from pathlib import Path

import numpy as np
import pytest

import real_layout as layout
from composed import calibrate_settings
from damage import damage
from ghpt.config import build
from ghpt.data.datasets.labels import read_label_cameras
from ghpt.data.datasets.panoptic import panoptic_files, panoptic_recordings
from ghpt.data.synthetic.rigs import panoptic_rig
from ghpt.errors import GhptDataError

RIG = panoptic_rig(range(31))
NUMBERS = (12, 16, 30)
FRAMES = 10


def standing(frames: int = FRAMES) -> np.ndarray:
    """A person [T 19 3], mm, who stands and walks a little, upright in a world of y down."""
    rng = np.random.default_rng(0)
    place = np.cumsum(rng.normal(0, 60, (frames, 1, 3)) * (1, 0, 1), axis=0)
    person = layout.upright19() * 10 + rng.normal(0, 15, (frames, 19, 3))
    return person + place


def read(root: Path, split: str = "train"):
    (recording,) = panoptic_recordings(root, NUMBERS, split)
    return recording


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"truth_mm": 10.0, "camera_mm": 10.0},
        {"truth_mm": 1.0, "camera_mm": 1.0, "flat_boxes": True},
        {"lens": False},
        {"mirrored": True},
        {"truth_mm": 1000.0, "lens": False, "mirrored": True},
    ],
    ids=str,
)
def test_the_truth_tells_unit_lens_and_sides(tmp_path, form):
    truth = layout.write_cmu_layout(tmp_path / "cmu", RIG, standing(), **form)
    recording = read(tmp_path / "cmu")
    rig = RIG.select(NUMBERS)
    assert recording.camera_names == ("00_12", "00_16", "00_30")
    assert recording.frame.tolist() == list(range(6))
    assert recording.valid.all()
    assert recording.truth_valid.all()
    assert np.abs(recording.truth - truth[:6]).max() < 0.01
    assert np.abs(recording.cameras.t.numpy() - rig.cameras.t.numpy()).max() < 0.01
    ideal = layout.ideal(rig, truth[:6].astype(np.float64))
    assert np.abs(recording.key_points - ideal).max() < 0.05


def test_the_splits_are_parts_in_time(tmp_path):
    layout.write_cmu_layout(tmp_path, RIG, standing())
    frames = {split: read(tmp_path, split).frame.tolist() for split in ("validation", "test")}
    assert frames == {"validation": [6, 7], "test": [8, 9]}
    assert {file.name for file in panoptic_files(tmp_path, NUMBERS)} == {
        "all_2d_preds.npy",
        "all_bboxes.npy",
        "all_3d_gt.npy",
        "cmu-multiview-labels-MRCNNbboxes.npy",
    }


def test_what_is_missing_in_a_frame_stays_missing(tmp_path):
    poses = standing()
    layout.write_cmu_layout(tmp_path, RIG, poses)
    poses[1, 5] = np.nan
    np.save(tmp_path / "all_3d_gt.npy", poses.astype(np.float32))
    boxes = np.load(tmp_path / "all_bboxes.npy")
    boxes[2, 16] = 0
    np.save(tmp_path / "all_bboxes.npy", boxes)
    recording = read(tmp_path)
    assert np.argwhere(~recording.truth_valid).tolist() == [[1, 15]]
    assert np.argwhere(~recording.valid.any(-1)).tolist() == [[2, 1]]


def exchange_cameras(root: Path) -> None:
    labels = layout.cmu_labels(RIG, 10.0)
    labels["cameras"] = labels["cameras"][:, ::-1]
    layout.write_pickle(root / "cmu-multiview-labels-MRCNNbboxes.npy", labels)


def giant(root: Path) -> None:
    np.save(root / "all_3d_gt.npy", (standing() * 50).astype(np.float32))


def shorter(root: Path) -> None:
    np.save(root / "all_3d_gt.npy", standing(4).astype(np.float32))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (exchange_cameras, r"all_3d_gt\.npy: the truth lies .* px from the key points"),
        (giant, "which is none in mm, cm or m"),
        (shorter, r"all_3d_gt\.npy: has shape 4 x 19 x 3 instead of 10"),
        (lambda root: (root / "all_bboxes.npy").unlink(), r"all_bboxes\.npy: there is no such"),
        (
            lambda root: (root / "cmu-multiview-labels-MRCNNbboxes.npy").unlink(),
            "there is no cmu-multiview-labels-MRCNNbboxes.npy",
        ),
    ],
)
def test_files_that_do_not_fit_together_are_named(tmp_path, spoil, says):
    layout.write_cmu_layout(tmp_path, RIG, standing())
    spoil(tmp_path)
    with pytest.raises(GhptDataError, match=says):
        read(tmp_path)


def test_a_damaged_file_of_labels_is_read_or_named(tmp_path):
    path = tmp_path / "l.npy"
    layout.write_pickle(path, layout.cmu_labels(RIG.select([0, 1]), 10.0))
    assert damage(path, read_label_cameras, 150) == {"read", "named"}


def test_the_arrangement_takes_the_folder(tmp_path):
    layout.write_cmu_layout(tmp_path / "cmu", RIG, standing())
    words = ["data=cmu2", f"data.root={tmp_path / 'cmu'}", f"data.cache={tmp_path / 'cache'}"]
    data = build(calibrate_settings(*words).data, "data")
    recordings = data.recordings("test")
    assert [recording.name for recording in recordings] == ["cmu"]
    assert recordings[0].key_points.shape == (2, 7, 17, 2)
