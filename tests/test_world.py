"""A world with a floor, from the people who stand in it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.commands.prediction.world import choose_world
from ghpt.errors import GhptConfigError
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import ANKLES, centre_of_mass, upright
from ghpt.skeleton import JOINT, JOINTS
from predicting import walk
from reconstructions import in_parts, random_reconstruction, rig

TURNED = Similarity(
    torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 2]).as_matrix()),
    1.0,
    torch.tensor([3000.0, -500.0, 7000.0], dtype=torch.float64),
)
"""From a world with z up to one like a first camera's."""


def leaning_walk(degrees: float, metres: float):
    """The walk along x with the trunk leaning forward, the feet as they were."""
    points = walk(120).clone()
    along = torch.linspace(0, 1000 * metres, 120, dtype=torch.float64)
    start = points[:1, JOINT["pelvis"], :2]
    points[..., :2] -= points[:, JOINT["pelvis"], :2][:, None] - start[:, None]
    points[..., 0] += along[:, None]
    lean = np.tan(np.radians(degrees))
    upper = [JOINT[name] for name in ("spine", "thorax", "head_top", "nose")]
    height = points[:, upper, 2] - points[:, JOINT["pelvis"], 2][:, None]
    points[:, upper, 0] += lean * height
    return points


def tilt_deg(points, gauge):
    """The angle between the world's z and that of the walk."""
    z = gauge.R @ TURNED.R @ torch.tensor([0.0, 0, 1], dtype=torch.float64)
    return float(torch.rad2deg(torch.arccos(z[2].clamp(-1, 1))))


def world_of(points):
    valid = torch.ones(points.shape[:2], dtype=torch.bool)
    return upright(TURNED.points(points), valid, TURNED.cameras(rig(3)))


def test_the_floor_says_what_is_up_where_people_lean():
    """8 degrees forward over 6 m: the trunk alone would be off by as much."""
    points = leaning_walk(8.0, 6.0)
    assert tilt_deg(points, world_of(points)) < 2.5


def test_who_bends_forward_on_one_spot_stands_over_their_feet():
    """The trunk leans by 35 degrees, and the hips are as far behind as the balance asks."""
    points = walk(120)[:1].double()
    points[:, list(ANKLES), 2] = points[:, list(ANKLES), 2].mean()
    aside = (points[0, JOINT["left_hip"]] - points[0, JOINT["right_hip"]])[:2]
    ahead = torch.tensor([aside[1], -aside[0], 0.0]) / aside.norm()
    legs = [JOINT[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee")]
    upper = [j for j in range(len(JOINTS)) if j not in (*legs, *ANKLES, JOINT["pelvis"])]
    height = points[:, upper, 2] - points[:, JOINT["pelvis"], 2, None]
    points[:, upper] += np.tan(np.radians(35)) * height[..., None] * ahead
    rest = [j for j in range(len(JOINTS)) if j not in ANKLES]
    valid = torch.ones(1, len(JOINTS), dtype=torch.bool)
    for _ in range(20):
        centre, _ = centre_of_mass(points, valid)
        points[:, rest] -= (centre - points[:, list(ANKLES)].mean(1) - 30 * ahead) @ ahead * ahead
    assert tilt_deg(points, world_of(points)) < 3


def test_feet_on_one_spot_do_not_turn_a_person_who_stands_straight():
    points = walk(120).clone()
    upper = [JOINT[name] for name in ("spine", "thorax")]
    points[:, upper, :2] = points[:, JOINT["pelvis"], None, :2]
    assert tilt_deg(points, world_of(points)) < 2.5


def test_the_floor_is_at_zero_along_the_whole_path():
    points = leaning_walk(8.0, 6.0)
    ankles = world_of(points).points(TURNED.points(points))[:, list(ANKLES), 2]
    lowest = [float(part.min()) for part in ankles.chunk(4)]
    assert max(lowest) - min(lowest) < 60
    assert abs(float(ankles.quantile(0.05))) < 1


def prediction(joints=JOINTS):
    made = random_reconstruction(40, joints=len(joints), missing=0.0)
    points = TURNED.points(walk(40))
    if len(joints) > 17:
        toes = points[:, list(ANKLES)] - 60 * TURNED.R[:, 2]
        points = torch.cat([points, toes], dim=1)
    return replace(made, points=points, state=torch.zeros_like(made.state))


def chosen(name, floor=None, joints=JOINTS):
    made = prediction(joints)
    cameras = TURNED.cameras(rig(3))
    return made, choose_world(name, floor, cameras, joints, in_parts(made), len(made))


def test_the_cameras_own_world_changes_nothing():
    made, world = chosen("cameras")
    assert world.reconstruction(made) is made


def test_the_first_camera_is_the_zero_of_its_world():
    _, world = chosen("first")
    moved = world.cameras(TURNED.cameras(rig(3)))
    torch.testing.assert_close(moved.R[0], torch.eye(3).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(moved.t[0], torch.zeros(3).double(), atol=1e-6, rtol=0)


def test_toes_are_the_floor_where_there_are_any():
    joints = (*JOINTS, "left_big_toe", "right_big_toe")
    made, world = chosen("people", joints=joints)
    height = world.reconstruction(made).points[..., 2]
    assert abs(float(height[:, 17:].quantile(0.05))) < 1e-6
    named, by_name = chosen("people", ["left_ankle", "right_ankle"], joints)
    ankles = by_name.reconstruction(named).points[:, list(ANKLES), 2]
    assert abs(float(ankles.quantile(0.05))) < 10


def test_a_covariance_turns_with_the_axes():
    made, world = chosen("people")
    moved = world.reconstruction(made)
    full = made.covariance[0, 0][[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3).double()
    turned = world.change.R @ full @ world.change.R.T
    expected = turned.flatten()[[0, 1, 2, 4, 5, 8]].float()
    torch.testing.assert_close(moved.covariance[0, 0], expected, atol=1e-3, rtol=1e-4)


def test_a_floor_of_unknown_joints_is_named():
    with pytest.raises(GhptConfigError, match=r"floor: 'left_hoof' is no joint"):
        chosen("people", ["left_hoof"])
