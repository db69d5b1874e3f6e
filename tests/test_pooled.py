"""One recording as several detectors saw it."""

import numpy as np
import pytest
import torch

from ghpt.commands.time import calibrate_people
from ghpt.data.people.pooled import pool_detectors
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.metrics.relative_pose import rotation_deg
from rigs_with_people import calibration, people

RIG = human36m_rig("S8")


def seen(seed: int, views: tuple[int, ...] = (0, 1, 2, 3), first: int = 0) -> Sequence:
    """What a detector whose errors are those of a seed sees of one walk."""
    scene = people(frames=30, noise=0.0)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(scene.key_points.shape, generator=generator, dtype=torch.float64)
    pixels = (scene.key_points + 3 * noise).float().numpy()[first:, views]
    valid = scene.valid.numpy()[first:, views]
    points = KeyPoints(pixels, valid.astype(np.float32), valid)
    return Sequence(
        title="walk",
        source="synthetic",
        cameras=RIG.select(views).without_extrinsics(),
        frame=np.arange(first, 30),
        rate_hz=50.0,
        points=KeyPointArrays(points, points),
    )


@pytest.fixture(scope="module")
def pooled():
    return pool_detectors([[seen(0)], [seen(1, views=(3, 1), first=10)]])


def test_each_detector_has_key_points_of_its_own(pooled):
    own = [sequence.undistorted().valid for sequence in pooled]
    assert [valid.shape for valid in own] == [(30, 4, 34)] * 2
    assert not own[0][..., 17:].any()
    assert not own[1][..., :17].any()


def test_frames_and_cameras_are_found_by_number_and_name(pooled):
    other = seen(1, views=(3, 1), first=10)
    found = pooled[1].undistorted()
    assert not found.valid[:10].any()
    assert not found.valid[:, [0, 2]].any()
    np.testing.assert_array_equal(found.pixels[10:, 3, 17:], other.undistorted().pixels[:, 0])


def test_the_joints_are_the_first_detectors(pooled):
    joints = [sequence.as_joints().undistorted().valid for sequence in pooled]
    assert joints[0].any()
    assert not joints[1].any()


def test_two_detectors_know_a_rig_better_than_one():
    both = [seen(0), seen(1)]

    def error(sequences):
        found = calibrate_people(calibration(), sequences, 0)
        R = found.cameras.R @ found.cameras.R[0].T
        true = RIG.cameras.R @ RIG.cameras.R[0].T
        return float(rotation_deg(R, true).square().mean())

    of_each = [error([sequence]) for sequence in both]
    assert error(pool_detectors([[one] for one in both])) < 0.8 * np.mean(of_each)
