"""freemocap's array of all cameras: the body's points, in the order of the cameras."""

import numpy as np
import pytest

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.errors import GhptDataError

NAME = "mediapipe_2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy"


def data(points: int = 553, coordinates: int = 3) -> np.ndarray:
    array = np.random.default_rng(0).uniform(0, 900, (3, 4, points, coordinates))
    array[1, 2, 5] = np.nan
    return array.astype(np.float32)


@pytest.mark.parametrize("points", [33, 543, 553])
@pytest.mark.parametrize("inside", ["", "session/output_data/raw_data"])
def test_the_body_of_each_camera_is_read(points, inside, tmp_path, caplog):
    caplog.set_level("INFO")
    folder = tmp_path / inside
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / NAME, data(points))
    np.save(folder / "mediapipe_3dData_numFrames_numTrackedPoints_spatialXYZ.npy", np.zeros(3))
    found = read_key_points(tmp_path)
    assert found.views == ("cam_0", "cam_1", "cam_2")
    assert found.joints == SKELETONS["mediapipe_33"]
    rows = found.points.take(found.first())
    np.testing.assert_array_equal(rows.pixels[0, 2], data(points)[2, 0, :33, :2])
    assert np.argwhere(~rows.valid).tolist() == [[2, 1, 5]]
    assert (f"of {points} points" in caplog.text) == (points > 33)


def test_what_is_none_of_it_is_named(tmp_path):
    np.save(tmp_path / NAME, data(17, 2))
    assert read_key_points(tmp_path / NAME, "coco_17").joints == SKELETONS["coco_17"]
    with pytest.raises(GhptDataError, match="coco_17 has 17 joints and the key points have 33"):
        np.save(tmp_path / NAME, data(33))
        read_key_points(tmp_path, "coco_17")
    np.save(tmp_path / NAME, data(33, 5))
    with pytest.raises(GhptDataError, match="has shape 3 x 4 x 33 x 5"):
        read_key_points(tmp_path)
    np.save(tmp_path / f"yolo_{NAME}", data(33))
    with pytest.raises(GhptDataError, match=rf"holds {NAME}, yolo_{NAME}.*Name one"):
        read_key_points(tmp_path)
