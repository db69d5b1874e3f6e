"""What is said of two calibrations: exact where the scene is, blind to the gauge, and of the view
that is left out.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.calibration.comparison import (
    align,
    bone_variation,
    held_out_errors,
    rig_difference,
    triangulate_recording,
)
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.models.estimators.classical import Linear
from ghpt.observations import LabelledRecording
from ghpt.skeleton import BONES, JOINT, JOINTS
from scenes import random_scene
from toys import recording

SIMILARITY = Similarity(
    torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 2]).as_matrix()),
    1.7,
    torch.tensor([300.0, -20, 5000]).double(),
)


def take(frames: int = 12, views: int = 4) -> LabelledRecording:
    """Exact key points."""
    made = recording("x", "S", frames, views, 0.0, np.random.default_rng(2))
    pixels, _ = project(made.cameras, torch.from_numpy(made.truth).double())
    return replace(made, key_points=pixels.float().numpy())


def test_a_similarity_changes_no_image_and_is_found_again():
    scene = random_scene(0, frames=1, views=5)
    cameras, points = scene.cameras.index(0), scene.points[0]
    moved = SIMILARITY.cameras(cameras)
    torch.testing.assert_close(project(moved, SIMILARITY.points(points))[0], scene.key_points[0])
    torch.testing.assert_close(moved.centre, SIMILARITY.points(cameras.centre))
    found = align(cameras, moved)
    torch.testing.assert_close(found.R, SIMILARITY.R)
    torch.testing.assert_close(found.t, SIMILARITY.t)
    assert found.scale == pytest.approx(1.7)
    apart = rig_difference(cameras, moved)
    assert float(apart.rotation_deg.max()) < 1e-6
    assert float(apart.centre_mm.max()) < 1e-6
    assert align(cameras, moved, rigid=True).scale == 1


@pytest.mark.parametrize("views", [2, 3])
def test_few_cameras_have_a_gauge_too(views):
    """Two centres leave a turn about their line open; the cameras' own rotations do not."""
    cameras = random_scene(1, frames=1, views=views).cameras.index(0)
    apart = rig_difference(cameras, SIMILARITY.cameras(cameras))
    assert float(apart.rotation_deg.max()) < 1e-6
    assert float(apart.centre_mm.max()) < 1e-6


def test_a_camera_that_was_moved_is_the_one_that_differs():
    cameras = random_scene(3, frames=1, views=8).cameras.index(0)
    turn = torch.from_numpy(Rotation.from_rotvec([0, np.deg2rad(4), 0]).as_matrix())
    R, t = cameras.R.clone(), cameras.t.clone()
    R[5], t[5] = turn @ R[5], turn @ t[5]
    apart = rig_difference(Cameras(cameras.K, R, t), cameras)
    assert int(apart.rotation_deg.argmax()) == 5
    assert float(apart.rotation_deg[5]) == pytest.approx(4, rel=0.01)
    others = [view for view in range(8) if view != 5]
    assert float(apart.rotation_deg[others].max()) < 0.01
    assert float(apart.centre_mm.max()) < 1


def test_covariances_turn_with_the_world():
    """Against the covariance of cameras drawn in one world and moved to the other."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * [1e-3, 2e-3, 1e-3, 5, 9, 2]
    covariance = torch.from_numpy(A.T @ A)[None]
    draws = torch.from_numpy(rng.multivariate_normal(np.zeros(6), covariance[0].numpy(), 20_000))
    moved = torch.cat((draws[:, :3] @ SIMILARITY.R.T, 1.7 * draws[:, 3:] @ SIMILARITY.R.T), -1)
    found = SIMILARITY.covariance(covariance)[0]
    sizes = found.diagonal().sqrt()
    assert ((found - torch.cov(moved.T)).abs() / (sizes * sizes[:, None])).max() < 0.05


def test_the_view_that_is_left_out_does_not_help_itself():
    """Its key points may be anything: its own errors are what they are off by, and the others' do
    not see them.
    """
    made = take()
    key_points = made.key_points.copy()
    key_points[:, 2] += [30, 40]
    errors, measured = held_out_errors(replace(made, key_points=key_points), Linear())
    assert measured.all()
    torch.testing.assert_close(
        errors[:, 2], torch.full_like(errors[:, 2], 50), rtol=1e-3, atol=1e-2
    )
    exact, _ = held_out_errors(made, Linear())
    assert float(exact.max()) < 0.05


def test_two_views_have_no_held_out_view():
    errors, measured = held_out_errors(take(views=2), Linear())
    assert not measured.any()
    assert (errors == 0).all()


def test_unseen_joints_are_not_measured():
    made = take()
    valid = made.valid.copy()
    valid[:, 1, 4] = False
    valid[3, [0, 1, 3], 6] = False
    _, measured = held_out_errors(replace(made, valid=valid), Linear())
    assert not measured[:, 1, 4].any()
    assert measured[:, 0, 4].all()
    assert not measured[3, :, 6].any()


def test_segments_of_a_rigid_body_do_not_vary():
    body = torch.from_numpy(np.random.default_rng(0).normal(0, 400, (17, 3)))
    turns = torch.from_numpy(Rotation.random(20, 1).as_matrix())
    points, estimated = body @ turns.mT, torch.ones(20, 17, dtype=torch.bool)
    variation, known = bone_variation(points, estimated)
    assert known.all()
    assert float(variation.max()) < 1e-12
    breathing = 1 + 0.05 * torch.linspace(-1, 1, 20).double()
    variation, _ = bone_variation(points * breathing[:, None, None], estimated)
    torch.testing.assert_close(
        variation, torch.full_like(variation, 1.4826 * 0.025), rtol=0.1, atol=0
    )
    estimated[:, JOINT["nose"]] = False
    _, known = bone_variation(points, estimated)
    assert [JOINTS[a] for (a, b), k in zip(BONES, known, strict=True) if not k] == ["head_top"]


def test_chunks_of_frames_change_nothing():
    made = take(frames=300)
    whole, _ = triangulate_recording(made, Linear())
    last, _ = triangulate_recording(made.frames(np.arange(280, 300)), Linear())
    torch.testing.assert_close(whole[280:], last)


def test_up_is_up_in_any_world():
    scene = random_scene(5, frames=6, views=3)
    valid = torch.ones(6, 17, dtype=torch.bool)
    cameras = scene.cameras.index(0)
    for world in (SIMILARITY, Similarity(torch.eye(3).double(), 1.0, torch.zeros(3).double())):
        gauge = upright(world.points(scene.points), valid, world.cameras(cameras))
        there = gauge.points(world.points(scene.points)) / world.scale
        assert float((gauge.R @ world.R)[2, 2]) > 0.998
        assert abs(float(there[:, [0, 5], 2].min())) < 60
        looks = gauge.cameras(world.cameras(cameras)).R[0, 2]
        assert abs(float(looks[1])) < 1e-9
        assert float(looks[0]) > 0
