"""What a recording is worth: known correlations, turns and neighbours are found."""

import math
from dataclasses import replace

import pytest
import torch

from ghpt.calibration.independence import Evidence, persistence, turning
from ghpt.calibration.observations import joints_of, observe, spread_key_points
from ghpt.calibration.resection import PlacedRig
from ghpt.skeleton import HUMAN36M, JOINT, make_skeleton
from rigs_with_people import people


def noisy_rig(frames: int, forget: float):
    """A true rig, and key points with autoregressive errors of correlation ``forget`` a frame."""
    scene = people(frames=frames, noise=0.0)
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(scene.key_points.shape, dtype=torch.float64, generator=generator)
    error = white.clone()
    for frame in range(1, frames):
        error[frame] = forget * error[frame - 1] + math.sqrt(1 - forget**2) * white[frame]
    valid = torch.ones_like(scene.valid)
    observed = observe(scene.K, scene.key_points + 4 * error, valid, 0.01)
    placed = torch.ones(4, dtype=torch.bool)
    points = scene.points.flatten(0, 1)
    return observed, PlacedRig(scene.cameras.R, scene.cameras.t, placed, points, observed.valid)


@pytest.mark.parametrize("forget", [0.0, 0.8])
def test_errors_that_last_are_worth_fewer_frames(forget):
    found = persistence(*noisy_rig(120, forget))
    expected = (1 + forget) / (1 - forget)
    assert found.time == pytest.approx(expected, rel=0.25)
    assert found.independent == pytest.approx(120 / found.time)


def facing(degrees: torch.Tensor) -> torch.Tensor:
    """People whose shoulders and hips face so, [R 17 3]."""
    angle = torch.deg2rad(degrees.double())
    left = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
    points = torch.zeros(len(angle), 17, 3, dtype=torch.float64)
    for joint in ("shoulder", "hip"):
        points[:, JOINT[f"left_{joint}"]] = 200 * left
        points[:, JOINT[f"right_{joint}"]] = -200 * left
    return points


@pytest.mark.parametrize("turn", [20.0, 350.0])
def test_turns_are_measured(turn):
    points = facing(torch.linspace(0, turn, 200))
    found = turning(points, torch.ones(200, 17, dtype=torch.bool))
    assert found.degrees == pytest.approx(turn, rel=0.15)
    torch.testing.assert_close(found.axes.mT @ found.axes, torch.eye(3).double().expand(200, 3, 3))


def test_who_has_no_sides_faces_where_they_did_before():
    points = facing(torch.linspace(0, 350, 200))
    known = torch.ones(200, 17, dtype=torch.bool)
    known[100:110] = False
    found = turning(points, known).axes
    assert (found[100:110] == found[99]).all()
    assert turning(points, torch.zeros_like(known)).degrees == 0


def test_what_does_not_last_falls_with_the_number_of_frames():
    evidence = Evidence(100, 100, 8.0, 30.0, rotation_sd_deg=1.0, lasting=0.0)
    assert evidence.frames_for(0.5) == 400
    assert replace(evidence, lasting=0.2).frames_for(0.5) == 1600
    assert replace(evidence, lasting=0.25).frames_for(0.5) is None


def test_of_key_points_that_lie_together_one_is_taken():
    scene = people(frames=10)
    generator = torch.Generator().manual_seed(0)
    face = scene.key_points[:, :, [JOINT["nose"]]].expand(-1, -1, 5, -1)
    face = face + torch.randn(face.shape, dtype=torch.float64, generator=generator)
    key_points = torch.cat((scene.key_points, face), dim=2)
    valid = torch.ones(key_points.shape[:3], dtype=torch.bool)
    chosen = set(spread_key_points(key_points, valid, 0.03).tolist())
    assert len(chosen & {JOINT["nose"], *range(17, 22)}) == 1
    assert {JOINT["left_wrist"], JOINT["right_ankle"]} <= chosen


def test_the_17_joints_are_means_of_the_detectors_own():
    skeleton = make_skeleton("test", "two", ("left_hip", "right_hip", "nose"))
    key_points = torch.tensor([[[[0.0, 0.0], [2.0, 4.0], [5.0, 5.0]]]])
    valid = torch.tensor([[[True, True, False]]])
    joints, known = joints_of(skeleton, key_points, valid)
    assert joints[0, 0, JOINT["pelvis"]].tolist() == [1.0, 2.0]
    assert known[0, 0, JOINT["pelvis"]]
    assert not known[0, 0, JOINT["nose"]]
    scene = people(frames=3)
    same, seen = joints_of(HUMAN36M, scene.key_points, scene.valid)
    torch.testing.assert_close(same[seen], scene.key_points[scene.valid])
