"""Detectors' skeletons as the 17 joints: by name, with left and right checked on real people in
real cameras.
"""

import numpy as np
import pytest
import torch

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
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.triangulation import triangulate
from ghpt.skeleton import JOINT, JOINTS, MIRROR, PELVIS, THORAX
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
