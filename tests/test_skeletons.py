"""Detectors' skeletons as the 17 joints: by name, with left and right checked on real people in
real cameras.
"""

import numpy as np
import pytest
import torch
import yaml

from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.skeletons import (
    SKELETONS,
    find_skeleton,
    joints17,
    joints_of,
    recognise,
    skeleton_of,
)
from ghpt.data.people.persons import person_sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.triangulation import triangulate
from ghpt.skeleton import BONES, HUMAN36M, JOINT, JOINTS, MIRROR, PELVIS, THORAX
from single_person import read_person

REAL = {
    "pose2sim_single": ("pose", "Calib_qualisys.toml"),
    "caliscope": ("xy_HOLISTIC.csv", "camera_array.toml"),
}


WITHOUT_NOSE = ("mpii_16", "mpi_15")


@pytest.mark.parametrize("name", SKELETONS)
def test_every_joint_comes_from_its_own_parts(name):
    """A point at (k, -k) for the k-th joint: each of the 17 must be the mean of the right k."""
    joints = SKELETONS[name]
    k = np.arange(len(joints), dtype=np.float64)
    given = KeyPoints(
        pixels=np.stack([k, -k], -1)[None, None],
        confidence=k[None, None] / 100,
        valid=np.ones((1, 1, len(k)), bool),
    )
    found = joints17("x", joints, given)
    points, sure, valid = found.pixels, found.confidence, found.valid
    missing = find_skeleton("x", name).missing_joints
    assert {JOINTS[j] for j in np.flatnonzero(~valid[0, 0])} == set(missing)
    assert missing == (("nose",) if name in WITHOUT_NOSE else ())
    value = dict(zip(JOINTS, points[0, 0, :, 0], strict=True))
    for joint in set(JOINTS) & set(joints):
        assert value[joint] == joints.index(joint)
    if name != "human36m":
        mean = {
            j: np.mean([joints.index(f"{side}_{j}") for side in ("left", "right")])
            for j in ("hip", "shoulder")
        }
        first = {"pelvis": ("pelvis", "mid_hip"), "thorax": ("thorax", "neck")}
        for joint, part in (("pelvis", "hip"), ("thorax", "shoulder")):
            own = [joints.index(word) for word in first[joint] if word in joints]
            assert value[joint] == (own[0] if own else mean[part])
        if "spine" not in joints:
            assert value["spine"] == (value["pelvis"] + value["thorax"]) / 2
    np.testing.assert_array_equal(points[..., 0], -points[..., 1])
    assert sure[0, 0, JOINT["right_knee"]] == np.float32(joints.index("right_knee") / 100)


def test_a_mean_is_seen_where_all_of_its_parts_are():
    joints = SKELETONS["coco_17"]
    valid = np.ones((1, 1, 17), bool)
    valid[..., joints.index("left_hip")] = False
    given = KeyPoints(np.ones((1, 1, 17, 2)), np.ones((1, 1, 17)), valid)
    found = joints17("x", joints, given)
    missing = ~found.valid
    assert {JOINTS[i] for i in np.flatnonzero(missing[0, 0])} == {"left_hip", "pelvis", "spine"}
    assert (found.pixels[missing] == 0).all()
    assert (found.confidence[missing] == 0).all()


def test_a_joint_that_the_detector_lacks_is_never_seen():
    joints = tuple(j for j in SKELETONS["coco_17"] if j not in ("nose", "left_ear"))
    shape = (2, 3, 15)
    given = KeyPoints(np.ones((*shape, 2)), np.ones(shape), np.ones(shape, bool))
    found = joints17("x", joints, given).valid
    assert {JOINTS[i] for i in np.flatnonzero(~found.any((0, 1)))} == {"nose", "head_top"}


def test_bad_skeletons_are_named():
    with pytest.raises(GhptDataError, match=r"no skeleton 'body_26'.*body_25b"):
        joints_of("file", "body_26")
    with pytest.raises(GhptDataError, match="nose is there twice"):
        skeleton_of("file", ("nose", "nose"))
    with pytest.raises(GhptDataError, match="joints: lack right_ankle"):
        skeleton_of("file", ("head", "tail")).require_joints("file")
    with pytest.raises(GhptDataError, match=r"no known skeleton has 5 joints.*coco_17"):
        recognise("file", np.ones((3, 5, 2)), np.ones((3, 5), bool))
    with pytest.raises(GhptDataError, match=r"it may be .*skeleton="):
        recognise("file", np.ones((3, 25, 2)), np.zeros((3, 25), bool))


@pytest.mark.parametrize("name", SKELETONS)
def test_skeletons_with_as_many_joints_are_told_apart(name):
    """From one upright person, in the detector's order."""
    rng = np.random.default_rng(0)
    height = {
        "ankle": 0,
        "heel": 0,
        "toe": 0,
        "knee": 50,
        "hip": 95,
        "pelvis": 95,
        "spine": 120,
        "thorax": 145,
        "neck": 145,
        "shoulder": 143,
        "elbow": 115,
        "wrist": 95,
        "head_top": 175,
    }
    side = [20 if "left" in joint else -20 if "right" in joint else 0 for joint in SKELETONS[name]]
    up = [
        next((h for part, h in height.items() if part in joint), 160) for joint in SKELETONS[name]
    ]
    body = np.stack([side, up], -1) * [1, -1]
    people = body + rng.normal(0, 2, (50, *body.shape))
    assert recognise("file", people, np.ones(people.shape[:2], bool)) == name


@pytest.mark.parametrize("data", REAL)
def test_left_is_left_on_real_people(data, shared_data):
    """In the cameras' own calibration: a person's left is up x forward, forward being from heels to
    toes.
    """
    raw = read_person(shared_data / data / REAL[data][0])
    cameras = read_cameras(shared_data / data / REAL[data][1])
    sequence = person_sequence(raw.detections, cameras)
    views = sequence.undistorted()
    points, ok = world(sequence.cameras.cameras, views.pixels, views.valid)
    # the feet are not among the 17: put them where the ankles are
    feet = [
        raw.joints.index(f"{side}_{part}")
        for side in ("left", "right")
        for part in ("big_toe", "heel")
    ]
    foot, foot_ok = world(
        sequence.cameras.cameras,
        raw.key_points[:, :, feet].astype(np.float32),
        raw.valid[:, :, feet],
    )
    forward = (foot[:, [0, 2]] - foot[:, [1, 3]]).mean(1)
    up = (
        points[:, THORAX] - points[:, PELVIS]
        if data != "caliscope"
        else points[:, JOINT["head_top"]] - points[:, THORAX]
    )
    if data == "caliscope":  # seated, feet hardly seen: forward is where the nose is of the ears
        forward, foot_ok = points[:, JOINT["nose"]] - points[:, JOINT["head_top"]], ok
    good = ok[:, [JOINT["left_shoulder"], JOINT["right_shoulder"], THORAX]].all(-1) & foot_ok.all(
        -1
    )
    side = points[:, JOINT["left_shoulder"]] - points[:, JOINT["right_shoulder"]]
    agrees = (torch.linalg.cross(up, forward) * side).sum(-1)[good] > 0
    assert good.sum() > 50
    assert agrees.double().mean() > 0.95


@pytest.mark.parametrize("data", REAL)
def test_the_views_agree_on_left_and_right(data, shared_data):
    """Swapping left and right in one view makes its reprojection errors larger."""
    raw = read_person(shared_data / data / REAL[data][0])
    cameras = read_cameras(shared_data / data / REAL[data][1])
    sequence = person_sequence(raw.detections, cameras)
    views = sequence.undistorted()
    straight = median_error(sequence.cameras.cameras, views.pixels, views.valid)
    for view in range(4):
        flipped, valid = views.pixels.copy(), views.valid.copy()
        flipped[:, view], valid[:, view] = flipped[:, view][:, MIRROR], valid[:, view][:, MIRROR]
        assert median_error(sequence.cameras.cameras, flipped, valid) > 1.2 * straight


def world(cameras, key_points, valid):
    rig = Cameras(
        *(x[None].expand(len(valid), *x.shape) for x in (cameras.K, cameras.R, cameras.t))
    )
    result = triangulate(
        rig, torch.from_numpy(key_points).double(), torch.from_numpy(valid).double()
    )
    return result.points, result.ok


def median_error(cameras, key_points, valid):
    points, ok = world(cameras, key_points, valid)
    rig = Cameras(
        *(x[None].expand(len(valid), *x.shape) for x in (cameras.K, cameras.R, cameras.t))
    )
    error = reprojection_error(rig, torch.from_numpy(key_points), points)
    return float(error[torch.from_numpy(valid) & ok[:, None]].median())


def write_skeleton(folder, **changed):
    content = {
        "key_points": ["snout", "left_paw", "right_paw", "tail"],
        "bones": [["snout", "tail"]],
    }
    (folder / "mouse.yaml").write_text(yaml.safe_dump(content | changed), encoding="utf-8")
    return str(folder / "mouse.yaml")


def test_a_skeleton_of_one_s_own_is_a_yaml(tmp_path):
    mouse = find_skeleton("x", write_skeleton(tmp_path))
    assert mouse.key_points == ("snout", "left_paw", "right_paw", "tail")
    assert mouse.bones == ((0, 3),)
    assert mouse.mirror == (0, 2, 1, 3)
    assert not mouse.has_joints


def test_a_yaml_says_how_the_17_are_made(tmp_path):
    weights = {"snout": 3.0, "tail": 1}
    mouse = find_skeleton("x", write_skeleton(tmp_path, joints={"nose": weights}))
    assert mouse.joints[JOINT["nose"]] == (0.75, 0.0, 0.0, 0.25)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"key_points": ["snout", "tail", "snout"]}, "key_points: snout is there twice"),
        ({"bones": [["snout", "wing"]]}, "bones: wing is no key point"),
        ({"bones": [["snout", "snout"]]}, "bones: snout, snout names one twice"),
        ({"pairs": [["snout", "left_paw"]]}, "pairs: are no pairs of different key points"),
        ({"pairs": [["snout"]]}, "pairs: are no pairs"),
        ({"joints": {"beak": {"snout": 1}}}, "joints: beak is none of the 17"),
        ({"joints": {"nose": {"beak": 1}}}, "joints.nose: beak is no key point"),
        ({"joints": {"nose": {"snout": -1}}}, "joints.nose: is no weighted mean"),
        ({"key_points": "snout"}, "key_points"),
        ({"eyes": 2}, "eyes: no such setting"),
    ],
)
def test_a_yaml_that_is_no_skeleton_is_named(changed, named, tmp_path):
    path = write_skeleton(tmp_path, **changed)
    with pytest.raises(GhptDataError) as error:
        find_skeleton("x", path)
    assert str(error.value).startswith(f"{path}: {named}")


def test_a_yaml_that_is_missing_or_damaged_is_named(tmp_path):
    with pytest.raises(GhptConfigError, match=r"none\.yaml cannot be read"):
        find_skeleton("x", str(tmp_path / "none.yaml"))
    (tmp_path / "bad.yaml").write_text("key_points: [a, b")
    with pytest.raises(GhptConfigError, match=r"bad\.yaml cannot be read"):
        find_skeleton("x", str(tmp_path / "bad.yaml"))


def test_the_17_are_a_skeleton_as_every_other():
    assert find_skeleton("x", "human36m") == HUMAN36M
    assert HUMAN36M.mirror == MIRROR
    assert HUMAN36M.bones == BONES


@pytest.mark.parametrize("name", SKELETONS)
def test_the_sides_of_a_known_skeleton_are_named_alike(name):
    skeleton = find_skeleton("x", name)
    for left, right in skeleton.pairs:
        names = (skeleton.key_points[left], skeleton.key_points[right])
        assert all("face" in one for one in names) or names[0].replace("left", "right") == names[1]
    sided = sum("left" in one or "right" in one for one in skeleton.key_points)
    assert sum("face" not in skeleton.key_points[a] for a, _ in skeleton.pairs) == sided // 2


def test_some_key_points_are_a_skeleton_with_the_joints_that_they_give():
    coco = find_skeleton("x", "coco_17")
    part = coco.select([coco.key_points.index(name) for name in ("right_hip", "left_hip", "nose")])
    assert part.pairs == ((1, 0),)
    assert part.joints[PELVIS] == (0.5, 0.5, 0.0)
    assert part.missing_joints == tuple(
        name for name in JOINTS if name not in ("right_hip", "left_hip", "pelvis", "nose")
    )
