"""A sequence: one person before a rig, whose key points are read as they are asked for."""

import numpy as np
import pytest
import torch

from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import CameraSet
from predicting import sequence_of
from scenes import random_scene

FRAMES = 7


@pytest.fixture
def sequence() -> Sequence:
    rng = np.random.default_rng(0)
    rig = random_scene(0, frames=1, views=3).cameras.index(0)
    shape = (FRAMES, 3, 17)
    valid = rng.random(shape) < 0.8
    undistorted = KeyPoints(rng.random((*shape, 2)).astype(np.float32), np.ones(shape), valid)
    detected = KeyPoints(undistorted.pixels + 1, undistorted.confidence, valid)
    cameras = CameraSet.from_cameras(("a", "b", "c"), rig)
    frame = np.arange(FRAMES) * 2 + 5
    arrays = KeyPointArrays(undistorted, detected)
    return Sequence("walk", "synthetic", cameras, frame, 50.0, arrays)


def test_observations_have_the_numbers_of_their_frames(sequence):
    rows = np.array([1, 4])
    found = sequence.read(rows)
    assert found.index.tolist() == [7, 13]
    assert found.cameras.t.shape == (2, 3, 3)
    np.testing.assert_array_equal(found.key_points, sequence.undistorted().pixels[rows])


def test_some_views_are_a_sequence_of_their_own(sequence):
    part = sequence.select_views([2, 0])
    assert part.cameras.names == ("c", "a")
    whole = sequence.detected()
    np.testing.assert_array_equal(part.detected().pixels, whole.pixels[:, [2, 0]])
    np.testing.assert_array_equal(part.undistorted().valid, whole.valid[:, [2, 0]])


@pytest.mark.parametrize(("most", "rows"), [(3, [0, 3, 6]), (100, list(range(FRAMES)))])
def test_rows_are_spread_evenly(sequence, most, rows):
    assert sequence.spread(most).tolist() == rows


def test_the_digest_follows_the_key_points_and_the_cameras(sequence):
    other = sequence.select_views([0, 1, 2])
    assert other.digest() == sequence.digest()
    assert sequence.select_views([0, 2, 1]).digest() != sequence.digest()
    points = sequence.undistorted()
    points.pixels[3, 1, 4] += 1
    changed = KeyPointArrays(points, points)
    moved = Sequence("", "", sequence.cameras, sequence.frame, 50.0, changed)
    assert moved.digest() != sequence.digest()


def test_what_is_made_as_it_is_read_is_the_same_in_any_part():
    endless = sequence_of(1000)
    whole = endless.read(np.arange(10, 20))
    part = endless.read(np.array([13, 17]))
    assert torch.equal(part.key_points, whole.key_points[[3, 7]])
