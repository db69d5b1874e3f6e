"""COCO results and MMPose's JSON: who is where, in which view and frame, and what is not right is
named.
"""

import json

import numpy as np
import pytest

from ghpt.data.formats.key_points import FORMATS, read_key_points
from ghpt.data.formats.skeletons import SKELETONS, canonical
from ghpt.errors import GhptConfigError, GhptDataError
from single_person import read_person

RNG = np.random.default_rng(0)
BODY = RNG.uniform(0, 400, (17, 3)).round(3) * [1, 1, 1 / 400]
COCO = SKELETONS["coco_17"]


def result(image, shift=0.0, joints=BODY):
    shifted = joints + np.array([shift, 0, 0])
    return {
        "image_id": image,
        "category_id": 1,
        "keypoints": shifted.ravel().tolist(),
        "score": 0.9,
    }


def mmpose(frames, meta=True, names=COCO):
    people = [
        {
            "frame_id": number,
            "instances": [
                {
                    "keypoints": (BODY[:, :2] + [shift, 0]).tolist(),
                    "keypoint_scores": BODY[:, 2].tolist(),
                    "bbox": [[0]],
                }
                for shift in shifts
            ],
        }
        for number, shifts in frames
    ]
    named = {str(i): name for i, name in enumerate(names)}
    return (
        {"meta_info": {"dataset_name": "coco", "keypoint_id2name": named}, "instance_info": people}
        if meta
        else people
    )


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def test_coco_results_with_a_file_for_each_camera(tmp_path):
    write(tmp_path / "cam1.json", [result(7), result(5, 10), result(5, 500)])
    write(tmp_path / "cam2.json", [result("frame_000005.jpg", 20), result("frame_000009.jpg", 30)])
    found = read_key_points(tmp_path)
    assert found.views == ("cam1", "cam2")
    assert found.joints == COCO
    assert found.frame.tolist() == [5, 7, 9]
    assert found.counts().tolist() == [[2, 1], [1, 0], [0, 1]]
    chosen = found.points.take(found.first())
    np.testing.assert_allclose(chosen.pixels[:, 0, 0, 0] - BODY[0, 0], [10, 0, -BODY[0, 0]])
    np.testing.assert_allclose(chosen.confidence[0, 0], BODY[:, 2])


@pytest.mark.parametrize(
    "form", ["{view}/{frame:06d}.jpg", "{view}_{frame:04d}.png", "x\\{view}\\img{frame}.jpg"]
)
def test_one_coco_file_whose_images_name_the_views(form, tmp_path):
    images = [(view, frame) for view in ("left", "right") for frame in (3, 4, 12)]
    listed = [result(form.format(view=view, frame=frame), frame) for view, frame in images]
    write(tmp_path / "results.json", listed)
    found = read_key_points(tmp_path / "results.json")
    assert found.views == ("left", "right")
    assert found.frame.tolist() == [3, 4, 12]
    assert (found.counts() == 1).all()
    names = [form.format(view=view, frame=frame) for view, frame in [*images, ("left", 2)]]
    listed = [result(i, frame) for i, (_, frame) in enumerate(images)]
    numbered = [{"id": i, "file_name": name} for i, name in enumerate(names)]
    write(tmp_path / "results.json", {"images": numbered, "annotations": listed})
    again = read_key_points(tmp_path / "results.json")
    assert again.views == ("left", "right")
    assert again.frame.tolist() == [2, 3, 4, 12]  # an image without anybody is a frame
    np.testing.assert_array_equal(again.points.pixels, found.points.pixels)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ([], "people: is empty"),
        ([1], "is not a key-point format that is known"),
        ({"annotations": [1]}, "annotations: is not a list of objects"),
        ({"images": 1, "annotations": []}, "images: is not a list"),
        ([{"keypoints": [1, 2, 3]}], "it looks like mmpose's"),
        ([result(None)], "image_id: an image has neither number nor name"),
        ([result("frame.jpg")], "frame.jpg: its name has no frame number"),
        ([result(-1)], "image_id: -1 is no frame number"),
        ([{"image_id": 1}], r"\[0\]: has no key points"),
        ([{"image_id": 1, "keypoints": [1, 2, "3"]}], r"\[0\]\.keypoints: is not a list"),
        ([{"image_id": 1, "keypoints": [1, 2e6, 3]}], "beyond 1e6"),
        ([{"image_id": 1, "keypoints": [10**400, 2, 3]}], "beyond 1e6"),
        ([result(1), result(2, 0, BODY[:3])], "frame 2 has a person of 3 joints, frame 1 of 17"),
        ([result(1, 0, BODY[:3])], r"no known skeleton has 3 joints.*coco_17 \(17\)"),
        ([result(1)] * 65, "65 people are in a frame"),
    ],
)
def test_bad_coco_results_are_named(content, says, tmp_path):
    write(tmp_path / "cam1.json", content)
    with pytest.raises(GhptDataError, match=says):
        read_key_points(tmp_path, format="coco")


@pytest.mark.parametrize("meta", [True, False])
def test_mmpose_s_files_of_each_camera(meta, tmp_path):
    write(tmp_path / "results_cam1.json", mmpose([(1, [0.0, 300.0]), (2, []), (3, [2.0])], meta))
    write(tmp_path / "results_cam2.json", mmpose([(1, [0.0]), (2, [1.0]), (4, [3.0])], meta))
    found = read_key_points(tmp_path, None if meta else "coco_17", rate_hz=50)
    assert (found.views, found.joints, found.rate_hz) == (("cam1", "cam2"), COCO, 50)
    assert found.frame.tolist() == [1, 2, 3, 4]
    assert found.counts().tolist() == [[2, 1], [0, 1], [1, 0], [0, 1]]
    np.testing.assert_allclose(found.points.pixels[found.first()[3, 1]], BODY[:, :2] + [3, 0])


def test_the_joints_are_those_that_mmpose_names(tmp_path):
    names = [name.replace("_", " ").title() for name in COCO]
    order = RNG.permutation(17)
    write(tmp_path / "a.json", mmpose([(1, [0.0])], names=[names[i] for i in order]))
    assert read_key_points(tmp_path).joints == tuple(COCO[i] for i in order)
    h36m = [
        "root",
        "right_hip",
        "right_knee",
        "right_foot",
        "left_hip",
        "left_knee",
        "left_foot",
        "spine",
        "thorax",
        "neck_base",
        "head",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    ]
    write(tmp_path / "a.json", mmpose([(1, [0.0])], names=h36m))
    assert set(read_key_points(tmp_path).joints) == set(SKELETONS["human36m"])
    write(tmp_path / "a.json", mmpose([(1, [0.0])], names=[f"paw {i}" for i in range(17)]))
    paws = read_key_points(tmp_path)
    assert paws.joints == tuple(f"paw_{i}" for i in range(17))
    with pytest.raises(GhptDataError, match=r"joints: lack right_ankle.*right_knee"):
        paws.skeleton.require_joints(paws.path)
    assert read_key_points(tmp_path, "coco_17").joints == COCO


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ([3], "instance_info: is not a list of frames"),
        (
            [{"frame_id": "1", "instances": []}],
            r"instance_info\[0\]\.frame_id: is not a frame number",
        ),
        ([{"frame_id": 1, "instances": 2}], r"\[0\]\.instances: is not a list of people"),
        ([{"frame_id": 1, "instances": []}] * 2, "frame_id: is there twice"),
        (
            [{"frame_id": 1, "instances": [{"keypoints": [1]}]}],
            r"keypoints: is not a list of x, y",
        ),
        (
            [{"frame_id": 1, "instances": [{"keypoints": [[1, 2]]}]}],
            "keypoint_scores: is not a list",
        ),
        ({"meta_info": {"keypoint_id2name": {"0": "nose"}}}, "names 1 joints, and people have 17"),
        ({"meta_info": {"keypoint_id2name": {"1": "nose"}}}, "does not name the joints from 0 on"),
        ({"meta_info": {"keypoint_id2name": ["nose"]}}, "does not name the joints from 0 on"),
    ],
)
def test_bad_mmpose_files_are_named(change, says, tmp_path):
    change = {"instance_info": change} if isinstance(change, list) else change
    write(tmp_path / "a.json", mmpose([(1, [0.0])]) | change)
    with pytest.raises(GhptDataError, match=says):
        read_person(tmp_path, format="mmpose")


def test_views_of_different_joints_are_refused(tmp_path):
    write(tmp_path / "a.json", mmpose([(1, [0.0])]))
    write(tmp_path / "b.json", mmpose([(1, [0.0])], names=COCO[::-1]))
    with pytest.raises(GhptDataError, match=r"b\.json: meta_info: names other joints than a\.json"):
        read_key_points(tmp_path)


def test_joints_are_found_in_other_spellings():
    names = ["Left Elbow", "LElbow", "leftElbow", "elbow_l", "l_elbow", "elbow.left", "LEFT-ELBOW"]
    assert set(canonical(names)) == {"left_elbow"}
    assert canonical(["neck_base"]) == ("neck",)
    assert canonical(["tail tip"]) == ("tail_tip",)


def test_a_format_is_chosen_by_name(tmp_path):
    write(tmp_path / "a.json", mmpose([(1, [0.0])]))
    names = ", ".join(sorted(FORMATS))
    with pytest.raises(GhptDataError, match=f"there is no format 'c3d'.*{names}"):
        read_key_points(tmp_path, format="c3d")
    with pytest.raises(GhptDataError, match="is not of coco: it looks like mmpose's"):
        read_key_points(tmp_path, format="coco")


XY = BODY[:, :2].tolist()
SURE = BODY[:, 2].tolist()
TRIPLES = BODY.tolist()
FLAT = BODY.ravel().tolist()
INSTANCE = {"keypoints": XY, "keypoint_scores": SURE, "bbox": [[0, 0, 9, 9]], "bbox_score": 0.9}


@pytest.mark.parametrize(
    "frame",
    [
        {"version": 1.3, "people": [{"pose_keypoints_2d": FLAT}]},
        {"version": 1.1, "people": [{"pose_keypoints": FLAT}, {}]},
        {"version": "AlphaPose v0.3", "bodies": [{"joints": FLAT}]},
        {"filename": "images/1/000000.jpg", "annots": [{"personID": 0, "keypoints": TRIPLES}]},
        [INSTANCE],
        {"predictions": [[INSTANCE]], "visualization": []},
        {"keypoints": [XY], "scores": [SURE]},
    ],
)
def test_a_file_of_each_image_in_every_detector_s_words(frame, tmp_path):
    for view in ("cam1", "cam2"):
        for number in (0, 1):
            write(tmp_path / view / f"{view}_{number:06d}.json", frame)
        write(tmp_path / view / f"{view}_000002.json", type(frame)())
    if isinstance(frame, dict):
        for view in ("cam1", "cam2"):
            (tmp_path / view / f"{view}_000002.json").unlink()
    found = read_key_points(tmp_path, "coco_17")
    assert found.views == ("cam1", "cam2")
    assert (found.counts()[:2] == 1).all()
    np.testing.assert_array_equal(found.points.pixels, np.broadcast_to(BODY[:, :2], (4, 17, 2)))
    np.testing.assert_array_equal(found.points.confidence, np.broadcast_to(BODY[:, 2], (4, 17)))


@pytest.mark.parametrize(
    "recording",
    [
        [{"frame_id": 5, "instances": [INSTANCE]}, {"frame_id": 6, "instances": [INSTANCE] * 2}],
        {"visualization": [], "predictions": [[INSTANCE], [INSTANCE] * 2]},
        [[INSTANCE], [INSTANCE] * 2],
        [{"predictions": [[INSTANCE]]}, {"predictions": [[INSTANCE] * 2]}],
        [{"keypoints": [XY], "scores": [SURE]}, {"keypoints": [XY] * 2, "scores": [SURE] * 2}],
        {"keypoints": [[XY], [XY] * 2], "scores": [[SURE], [SURE] * 2]},
        {
            "0.jpg": {"people": [{"pose_keypoints_2d": FLAT}]},
            "1.jpg": {"bodies": [{"joints": FLAT}] * 2},
        },
        [{"image_id": f"{t}.jpg", "keypoints": FLAT, "idx": [0.0]} for t in (3, 4, 4)],
    ],
)
@pytest.mark.parametrize("form", ["{}.json", "{}/alphapose-results.json", "{}/predictions/x.json"])
def test_a_file_of_each_video_in_every_detector_s_words(recording, form, tmp_path):
    for view in ("cam1", "cam2"):
        write(tmp_path / form.format(view), recording)
    found = read_key_points(tmp_path, "coco_17")
    assert found.views == ("cam1", "cam2")
    assert found.counts().tolist() == [[1, 1], [2, 2]]
    assert np.diff(found.frame).tolist() == [1]
    np.testing.assert_array_equal(found.points.pixels, np.broadcast_to(BODY[:, :2], (6, 17, 2)))


@pytest.mark.parametrize("name", ["idx", "personID", "track_id"])
def test_what_a_tracker_calls_people_is_read_from_whole_recordings(name, tmp_path):
    """AlphaPose writes 3.0 or [3.0]."""
    called = [[3], [3, 5], [5]]
    rows = [
        {"image_id": t, "keypoints": FLAT, name: [float(i)] if name == "idx" else i}
        for t, ids in enumerate(called)
        for i in ids
    ]
    for view in ("cam1", "cam2"):
        write(tmp_path / f"{view}.json", rows)
    assert read_key_points(tmp_path).identity.tolist() == [3, 3, 5, 5] * 2


def test_nan_and_null_are_missing_key_points(tmp_path):
    for view in ("a", "b"):
        flat = [*FLAT]
        flat[0], flat[4], flat[8] = float("nan"), None, float("nan")
        write(tmp_path / view / "1.json", {"people": [{"pose_keypoints_2d": flat}]})
    found = read_key_points(tmp_path, "coco_17").points
    assert found.valid[:, :4].tolist() == [[False, False, False, True]] * 2
    assert (found.pixels[~found.valid] == 0).all()


def test_calibrations_beside_the_folders_are_no_key_points(tmp_path):
    for view in ("a", "b"):
        write(tmp_path / view / "1.json", [INSTANCE])
    write(tmp_path / "calibration_1.json", {"cameras": [{"name": "a"}]})
    assert read_key_points(tmp_path, "coco_17").views == ("a", "b")


def test_of_several_recordings_one_is_chosen(tmp_path):
    for view in ("cam1", "cam2"):
        for shift, trial in enumerate(("walk", "jump")):
            write(tmp_path / f"{trial}_{view}.json", [result(0, shift), result(1, shift)])
    with pytest.raises(GhptDataError, match=r"several sessions are in it: jump, walk"):
        read_key_points(tmp_path)
    found = read_key_points(tmp_path, session="jump")
    assert found.views == ("cam1", "cam2")
    np.testing.assert_allclose(found.points.pixels[:, 0, 0], BODY[0, 0] + 1)


def test_a_key_point_below_the_least_confidence_is_missing(tmp_path):
    weak = BODY * [1, 1, 0.1]
    for view in ("a", "b"):
        write(tmp_path / f"{view}.json", [result(0), result(0, 300, weak)])
    limit = float(np.sort(BODY[:, 2])[5])
    found = read_key_points(tmp_path, least_confidence=limit)
    assert found.counts().tolist() == [[1, 1]]
    np.testing.assert_array_equal(found.points.valid, np.array([BODY[:, 2] >= limit] * 2))
    with pytest.raises(GhptDataError, match="no key point with a confidence of at least"):
        read_key_points(tmp_path, least_confidence=1)
    with pytest.raises(GhptConfigError, match="least_confidence"):
        read_key_points(tmp_path, least_confidence=1.5)
