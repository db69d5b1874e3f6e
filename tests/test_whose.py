"""People told apart before the cameras are calibrated, and in a view that comes later."""

from dataclasses import replace

import numpy as np
import pytest

from ghpt.calibration.whose import attach_views, combine, same_people
from ghpt.data.people.pooled import among_cameras
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.rigs import human36m_rig
from rigs_with_people import calibration, people

RIG = human36m_rig("S8")


def walker(seed: int) -> Sequence:
    scene = people(frames=30, noise=0.003, seed=seed)
    valid = scene.valid.numpy()
    points = KeyPoints(scene.key_points.float().numpy(), valid.astype(np.float32), valid)
    return Sequence(
        title="walk",
        source="synthetic",
        cameras=RIG.without_extrinsics(),
        frame=np.arange(30),
        rate_hz=50.0,
        points=KeyPointArrays(points, points),
    )


@pytest.fixture(scope="module")
def walkers():
    return [walker(seed) for seed in range(2)]


def three_views(sequence: Sequence) -> Sequence:
    """Return the sequence without its last view, among all cameras."""
    seen = sequence.undistorted()[:, :3]
    points = KeyPointArrays(seen, seen)
    cameras = sequence.cameras.select([0, 1, 2])
    return among_cameras(replace(sequence, cameras=cameras, points=points), sequence)


def test_a_view_is_attached_to_the_person_whom_it_shows(walkers):
    found = [three_views(each) for each in walkers]
    assert not found[0].undistorted().valid[:, 3].any()
    calibrate = calibration()
    tracks = [walkers[1], walkers[0]]
    attached = attach_views(found, tracks, [3], calibrate.pairs, calibrate.noise, 0)
    own = [each.undistorted() for each in attached]
    shown = [points.valid[:, 3].any() for points in own]
    assert sum(shown) == 1
    person = shown.index(True)
    true = walkers[person].undistorted()
    np.testing.assert_array_equal(own[person].valid[:, 3], true.valid[:, 3])
    seen = true.valid[:, 3]
    np.testing.assert_array_equal(own[person].pixels[:, 3][seen], true.pixels[:, 3][seen])


def test_people_are_the_same_in_all_views_whoever_each_view_puts_first(walkers):
    calibrate = calibration()
    tracks = [combine(walkers, choice) for choice in ((0, 1, 1, 0), (1, 0, 0, 1))]
    found = same_people(tracks, calibrate.pairs, calibrate.noise, 0)
    own = [person.undistorted().pixels for person in found]
    order = np.argsort([abs(pixels - walkers[0].undistorted().pixels).max() for pixels in own])
    assert len(found) == 2
    for person, walker in zip(order, walkers, strict=True):
        np.testing.assert_array_equal(own[person], walker.undistorted().pixels)
