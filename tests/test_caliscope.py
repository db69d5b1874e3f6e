"""caliscope's table of landmarks: long to dense, the face left out, gaps left gaps."""

import numpy as np
import pytest

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.errors import GhptDataError
from single_person import read_person

HEADER = "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"


def table(tmp_path, *rows, header=HEADER):
    path = tmp_path / "xy_HOLISTIC.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_rows_become_an_array_whatever_their_order(tmp_path):
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1000, (4, 3, 33, 2))
    there = rng.random((4, 3, 33)) < 0.7
    there[[0, 3], 0, 0] = there[1:3, 0, 0] = True
    frames, ports = [5, 6, 9, 12], [0, 2, 10]
    rows = []
    for t, v, k in zip(*np.nonzero(there), strict=True):
        x, y = pixels[t, v, k].tolist()
        rows.append(f"{frames[t]},{ports[v]},{t},1.5,{k},{x!r},{y!r},,")
    rows += ["5,0,0,1.5,400,1,2,,", "5,2,0,1.5,500,1,2,,"]
    found = read_person(table(tmp_path, *rng.permutation(rows)))
    assert found.views == ("cam_0", "cam_2", "cam_10")
    assert found.frame.tolist() == frames
    assert found.joints == SKELETONS["mediapipe_33"]
    np.testing.assert_array_equal(found.valid, there)
    np.testing.assert_array_equal(found.key_points[there], pixels[there])
    assert (found.confidence == there).all()


def test_the_columns_of_today_and_several_people(tmp_path):
    header = "sync_index,cam_id,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
    pixels = np.random.default_rng(0).uniform(0, 1000, (2, 3, 2, 17, 2))
    rows = []
    for t, v, person, k in np.ndindex(pixels.shape[:-1]):
        if (t, v, person) != (1, 1, 0):
            x, y = pixels[t, v, person, k].tolist()
            rows.append(f"{t},{v},{person + 3},{k},{x!r},{y!r},,")
    rng = np.random.default_rng(1)
    found = read_key_points(table(tmp_path, *rng.permutation(rows), header=header), "coco_17")
    assert found.view.tolist() == [0] * 4 + [1] * 3 + [2] * 4
    assert found.row.tolist() == [0, 0, 1, 1, 0, 0, 1, 0, 0, 1, 1]
    assert found.identity.tolist() == [0, 1, 0, 1, 0, 1, 1, 0, 1, 0, 1]
    expected = pixels[found.row, found.view, found.identity]
    np.testing.assert_array_equal(found.points.pixels, expected)


def test_an_empty_cell_is_a_point_that_was_not_found(tmp_path):
    rows = ("0,0,0,1.5,0,10,20,,", "0,1,0,1.5,0,,,,", "0,1,0,1.5,1,3,4,,")
    found = read_person(table(tmp_path, *rows), "coco_17")
    assert found.joints == SKELETONS["coco_17"]
    assert found.valid[0, :, :2].tolist() == [[True, False], [False, True]]
    assert (found.key_points[~found.valid] == 0).all()


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ([], "none of a body"),
        (["0,0,0,1,0,1,2,,"] * 2, "a point is there twice"),
        (["0,0,0,1,0,1"], "is damaged"),
        (["0,0,0,1,x,1,2,,"], "is damaged"),
        (["0,0.5,0,1,0,1,2,,"], "an index that is not whole"),
        (["0,0,0,1,0,1e300,2,,"], "a number beyond"),
        (["0,0,0,1,100,1,2,,"], "none of a body"),
    ],
)
def test_a_bad_table_is_named(rows, says, tmp_path):
    with pytest.raises(GhptDataError, match=says):
        read_person(table(tmp_path, *rows), "coco_17" if "twice" in says else None)


def upright(joints, shift):
    """A person seen from the front, in a skeleton's order."""
    heights = {
        "ankle": 0,
        "heel": 0,
        "toe": 0,
        "knee": 50,
        "hip": 95,
        "shoulder": 143,
        "neck": 146,
        "elbow": 115,
        "wrist": 95,
        "hand": 85,
        "thumb": 85,
        "finger": 85,
        "pinky": 85,
        "index": 85,
        "head_top": 175,
    }
    aside = [20 if "left" in name else -20 if "right" in name else 0 for name in joints]
    up = [next((h for part, h in heights.items() if part in name), 160) for name in joints]
    return np.stack([np.array(aside) + 500 + shift, 600 - np.array(up)], -1)


@pytest.mark.parametrize("name", ["halpe_26", "coco_17", "coco_133", "mediapipe_33", "body_25"])
@pytest.mark.parametrize("camera", ["port", "cam_id"])
def test_a_tracker_s_points_are_told_by_their_number_and_bones(name, camera, tmp_path):
    rng = np.random.default_rng(0)
    rows = []
    for t in range(20):
        for v in (0, 1):
            body = upright(SKELETONS[name], 3 * t) + rng.normal(0, 2, (len(SKELETONS[name]), 2))
            rows += [f"{t},{v},{t},0.1,{k},{x:.3f},{y:.3f},," for k, (x, y) in enumerate(body)]
    path = table(tmp_path, *rows, header=HEADER.replace("port", camera))
    assert read_person(path).joints == SKELETONS[name]
    with pytest.raises(GhptDataError, match=r"has a point of number \d+, and mpi_15 has 15"):
        read_person(path, "mpi_15")


def test_hands_come_behind_the_body_the_right_one_first(tmp_path, caplog):
    caplog.set_level("INFO")
    face = "0,0,0,0,300,1,2,,"
    rows = ["0,0,0,0,0,1,2,,", face, "0,0,0,0,100,3,4,,", "0,0,0,0,220,5,6,,", "0,1,0,0,0,1,2,,"]
    found = read_person(table(tmp_path, *rows))
    assert found.joints == SKELETONS["mediapipe_75"]
    assert found.key_points[0, 0, found.joints.index("right_hand_root")].tolist() == [3, 4]
    assert found.key_points[0, 0, found.joints.index("left_pinky_finger4")].tolist() == [5, 6]
    assert found.valid.sum() == 4
    assert "1 points of face" in caplog.text


def test_another_csv_is_not_taken_for_it(tmp_path):
    with pytest.raises(GhptDataError, match=r"not a key-point format that is known.*OpenPose"):
        read_person(table(tmp_path, "0,1", header="a,b"))


def test_the_real_recording(shared_data):
    """Every landmark of body and hands is at its place, found by an independent count."""
    path = shared_data / "caliscope" / "xy_HOLISTIC.csv"
    found = read_person(path)
    assert found.views == ("cam_0", "cam_1", "cam_2", "cam_3")
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    body = [row for row in rows if int(row[4]) < 221]
    assert found.valid.sum() == len(body)
    for row in body[:: len(body) // 50]:
        ids = [*range(33), *range(100, 121), *range(200, 221)]
        t, v, k = found.frame.tolist().index(int(row[0])), int(row[1]), ids.index(int(row[4]))
        assert found.key_points[t, v, k].tolist() == [float(row[5]), float(row[6])]
