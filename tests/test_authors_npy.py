"""The authors' arrays: out of the crop, chunk after chunk."""

import json

import numpy as np
import pytest

from ghpt.data.formats.skeletons import SKELETONS
from ghpt.errors import GhptDataError
from single_person import read_person

RNG = np.random.default_rng(0)
PIXELS = RNG.uniform(100, 900, (6, 3, 17, 2)).astype(np.float32)
CORNER = RNG.uniform(0, 50, (6, 3, 2)).astype(np.float32)
HEIGHT = RNG.uniform(300, 900, (6, 3, 1, 1)).astype(np.float32)


def layout(folder, rows=slice(None), number="", **change):
    crop = (PIXELS - CORNER[:, :, None]) / HEIGHT * 384
    boxes = np.stack([CORNER, CORNER + HEIGHT[..., 0]], 2)
    boxes[2, 1, 1] = boxes[2, 1, 0]
    arrays = {"2d_preds": crop[rows], "bboxes": boxes[rows]} | change
    for name, array in arrays.items():
        np.save(folder / f"all_{name}{number}.npy", array)
    return folder


def test_the_crop_is_undone(tmp_path):
    (layout(tmp_path) / "all_cameras.json").write_text(json.dumps(["c", "a", "b"]))
    np.save(tmp_path / "all_frames.npy", np.arange(6) * 5)
    for path in (tmp_path, tmp_path / "all_2d_preds.npy"):
        found = read_person(path)
        assert (found.views, found.joints) == (("c", "a", "b"), SKELETONS["human36m"])
        assert found.frame.tolist() == [0, 5, 10, 15, 20, 25]
        assert not found.valid[2, 1].any()
        assert found.valid.sum() == found.valid.size - 17
        np.testing.assert_allclose(found.key_points[found.valid], PIXELS[found.valid], atol=1e-3)


def test_chunks_follow_one_another_by_number(tmp_path):
    for number, frames in ((0, slice(0, 2)), (1, slice(2, 3)), (2, slice(3, 6))):
        layout(tmp_path, frames, number)
    found = read_person(tmp_path)
    assert found.views == ("cam_0", "cam_1", "cam_2")
    np.testing.assert_allclose(found.key_points[found.valid], PIXELS[found.valid], atol=1e-3)
    (tmp_path / "all_2d_preds1.npy").unlink()
    with pytest.raises(GhptDataError, match=r"all_2d_preds1\.npy: there is no such file"):
        read_person(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"bboxes": np.zeros((5, 3, 2, 2))}, r"all_bboxes\.npy: has shape 5 x 3 x 2 x 2"),
        (
            {"2d_preds": np.zeros((6, 3, 19, 2))},
            "human36m has 17 joints and the key points have 19",
        ),
        ({"2d_preds": np.zeros((6, 3, 17, 3))}, r"all_2d_preds\.npy: has shape 6 x 3 x 17 x 3"),
        ({"2d_preds": np.full((6, 3, 17, 2), 1e30)}, "a number beyond 1e6"),
        ({"2d_preds": np.full((6, 3, 17, 2), np.nan)}, "has no key point"),
        ({"frames": np.array([1, 2, 3, 3, 4, 5])}, r"all_frames\.npy: is empty, or does not rise"),
    ],
)
def test_bad_arrays_are_named(change, says, tmp_path):
    with pytest.raises(GhptDataError, match=says):
        read_person(layout(tmp_path, **change))


def test_predictions_without_boxes_are_refused(tmp_path):
    (layout(tmp_path) / "all_bboxes.npy").unlink()
    with pytest.raises(
        GhptDataError, match=r"all_bboxes\.npy: there is no such file.*pixels of a crop"
    ):
        read_person(tmp_path)
