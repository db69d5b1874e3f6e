"""The algebra of estimated extrinsics in place of the true ones."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import toys
from ghpt.data.datasets.frames import Frames
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.observations import RelativePoseEstimate
from ghpt.paper.camera.extrinsics import (
    RigDraws,
    StoredExtrinsics,
    poses_of_pairs,
    relative_poses,
    replace_part,
    through_draws,
    with_true_scale,
)
from scenes import labelled_pairs

TRUTH = human36m_rig("S9").cameras


def wrong() -> tuple[torch.Tensor, torch.Tensor]:
    """True relative poses turned by some degrees and moved by some centimetres, but for the
    first."""
    R, t = relative_poses(TRUTH)
    turn = torch.from_numpy(
        Rotation.from_euler("xyz", [[0, 0, 0], [3, 0, 1], [0, 2, 0], [1, 1, 1]], True).as_matrix()
    )
    return turn @ R, t + torch.tensor([[0.0], [40.0], [-70.0], [25.0]])


@pytest.mark.parametrize("part", ["R", "t", "both"])
def test_true_relative_poses_give_back_the_true_cameras(part):
    found = replace_part(TRUTH, relative_poses(TRUTH), part)
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-8)
    assert found.K is TRUTH.K


@pytest.mark.parametrize(
    ("part", "use_R", "use_t"), [("R", True, False), ("t", False, True), ("both", True, True)]
)
def test_only_the_wanted_part_of_the_relative_pose_is_estimated(part, use_R, use_t):
    estimate = wrong()
    found = replace_part(TRUTH, estimate, part)
    R, t = relative_poses(found)
    true_R, true_t = relative_poses(TRUTH)
    torch.testing.assert_close(R, estimate[0] if use_R else true_R, rtol=0, atol=1e-12)
    torch.testing.assert_close(t, estimate[1] if use_t else true_t, rtol=0, atol=1e-8)
    is_turned = bool((found.R[1:] - TRUTH.R[1:]).abs().amax() > 1e-3)
    assert is_turned == use_R
    assert (
        found.t[1:] - TRUTH.t[1:]
    ).abs().amax() > 1  # a turn about the reference moves the others too
    torch.testing.assert_close(found.R[0], TRUTH.R[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t[0], TRUTH.t[0], rtol=0, atol=1e-8)


def test_rig_in_any_frame_and_unit_gives_back_the_true_cameras():
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix())
    R = TRUTH.R @ turn
    moved = Cameras(
        TRUTH.K,
        R,
        0.002 * (TRUTH.t + R @ torch.tensor([100.0, -2000.0, 700.0], dtype=torch.float64)),
    )
    found = replace_part(TRUTH, with_true_scale(moved, TRUTH), "both")
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-7)


def test_pairs_with_the_first_camera_are_taken_in_its_order():
    pair = torch.tensor([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    rig = Cameras(*(x.expand(len(pair), *x.shape) for x in (TRUTH.K, TRUTH.R, TRUTH.t)))
    labelled = labelled_pairs(rig, pair, torch.zeros(len(pair), 4, 1, 17, 2))
    batch = labelled.observations
    R, t = labelled.truth.relative_pose()
    estimate = RelativePoseEstimate(R, t, torch.ones(len(pair), dtype=torch.bool))
    found = replace_part(TRUTH, poses_of_pairs(estimate, batch, "truth"), "both")
    torch.testing.assert_close(found.R, TRUTH.R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t, TRUTH.t, rtol=0, atol=1e-8)
    missing = RelativePoseEstimate(R, t, torch.arange(len(pair)) != 1)
    with pytest.raises(GhptDataError, match="a pair has no estimate"):
        poses_of_pairs(missing, batch, "truth")


def test_draws_take_turns_over_the_frames_of_their_rigs():
    rng = np.random.default_rng(0)
    recordings = [toys.recording(f"S{i}", f"S{i}", 6, 4, 0.0, rng) for i in range(2)]
    frames = Frames(recordings, np.array([0, 2, 4, 7, 9, 11]))
    R, t = relative_poses(recordings[0].cameras)
    shifts = [[0, 10, 20], [30, 40, 50]]  # of a rig's cameras in its draws, mm
    rigs = [
        RigDraws([i], [StoredExtrinsics.from_extrinsics((R, t + shift)) for shift in shifts[i]])
        for i in range(2)
    ]
    batch = through_draws(frames, rigs, "t")[range(6)].observations
    true = frames[range(6)].observations
    torch.testing.assert_close(batch.key_points, true.key_points, rtol=0, atol=0)
    moved = (batch.cameras.t - true.cameras.t)[:, 1:]
    expected = torch.tensor([0.0, 10, 20, 30, 40, 50])[:, None, None].expand(6, 3, 3).double()
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(batch.cameras.R, true.cameras.R, rtol=0, atol=1e-12)
