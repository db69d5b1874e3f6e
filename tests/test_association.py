"""Several people in the views of calibrated cameras: the right one is followed, whoever the lists
put first.
"""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import yaml

from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.people.association import associate
from ghpt.data.people.detections import Detections
from ghpt.data.people.persons import (
    person_sequence,
    select_person,
    undistort_detections,
)
from ghpt.data.people.tracks import Bodies, track_bodies
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

FRAMES = 240


@pytest.fixture(scope="module")
def detector(pytestconfig) -> Detector:
    return Detector(
        **yaml.safe_load(
            (pytestconfig.rootpath / "conf" / "detector" / "human36m.yaml").read_text()
        )
    )


def rig_of(views: int) -> CameraSet:
    rig = human36m_rig("S9")
    at = list(range(views))
    return CameraSet.from_cameras(
        tuple(rig.names[i] for i in at), rig.cameras.index(at), rig.distortion[at], rig.size[at]
    )


def camera_file(rig: CameraSet, calibrated: bool = True) -> CameraSet:
    lens = rig.distortion * 0  # the detector's key points are out of the lens
    if not calibrated:
        return CameraSet(rig.names, rig.K, lens, path="Calib.toml")
    return CameraSet.from_cameras(rig.names, rig.cameras, lens, path="Calib.toml")


def scene(detector: Detector, rig: CameraSet, seed: int = 1) -> tuple[Detections, np.ndarray]:
    """One who walks and one who greets, each out of each view for a while, listed in any order;
    whose each is.
    """
    rng = np.random.default_rng(seed)
    parts, owner = [], []
    for person, action in enumerate(("Walking", "Greeting")):
        name = f"{person}-{seed}"
        points = draw_motion(seed, name, name, action, FRAMES, 50.0)
        found = detector(points, rig, 50.0, seed, name, name)
        there = found.valid.any(-1)
        for view in range(len(rig)):
            start = rng.integers(0, FRAMES)
            there[start : start + 40, view] = False
        row, view = np.nonzero(there)
        parts.append(
            (row, view, *(x[row, view] for x in (found.key_points, found.confidence, found.valid)))
        )
        owner.append(np.full(len(row), person))
    row, view, points, sure, valid = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((rng.random(len(row)), row, view))
    people = Detections(
        path="pose",
        views=rig.names,
        joints=SKELETONS["human36m"],
        frame=np.arange(FRAMES),
        row=row[order],
        view=view[order],
        identity=np.full(len(row), -1),
        points=KeyPoints(points.astype(float), sure.astype(float), valid)[order],
        rate_hz=50.0,
    )
    return people, np.concatenate(owner)[order]


def person_of(people: Detections, cameras: CameraSet, at, person: int = 0) -> np.ndarray:
    ideal = undistort_detections(people, cameras, at)
    return select_person(people, cameras, at, ideal, person)


@pytest.mark.parametrize(("views", "seed"), [(4, 1), (4, 2), (3, 1)])
def test_each_of_two_people_is_followed_in_all_views(views, seed, detector):
    """In more than 99 % of the frames in which two views see them, and never mixed with the
    other."""
    rig = rig_of(views)
    people, owner = scene(detector, rig, seed)
    assert ((people.counts() > 1).sum(1) >= 2).mean() > 0.5
    followed = [person_of(people, camera_file(rig), range(views), person) for person in (0, 1)]
    labels = [np.where(chosen >= 0, owner[chosen], -1) for chosen in followed]
    assert {np.bincount(label[label >= 0]).argmax() for label in labels} == {0, 1}
    for label in labels:
        person = np.bincount(label[label >= 0]).argmax()
        table = np.zeros((FRAMES, views), bool)
        table[people.row[owner == person], people.view[owner == person]] = True
        possible = table.sum(1) >= 2
        right = ((label == person).sum(1) >= 2) & (label != 1 - person).all(1)
        assert right[possible].mean() > 0.99
        assert (label == person).sum() > 0.95 * table[possible].sum()


def test_the_order_of_the_detections_does_not_matter(detector):
    rig = rig_of(4)
    people, _ = scene(detector, rig)
    order = np.random.default_rng(5).permutation(len(people.row))
    order = order[np.argsort(people.view[order] * FRAMES + people.row[order], kind="stable")]
    fields = ("row", "view", "identity", "points")
    other = replace(people, **{name: getattr(people, name)[order] for name in fields})
    one, again = (person_sequence(p, camera_file(rig)).undistorted() for p in (people, other))
    np.testing.assert_array_equal(one.pixels, again.pixels)
    np.testing.assert_array_equal(one.valid, again.valid)


def test_millimetres_or_metres_do_not_matter(detector):
    rig = rig_of(3)
    people, _ = scene(detector, rig)
    cameras = replace(rig.cameras, t=rig.cameras.t / 1000)
    small = person_of(
        people,
        camera_file(CameraSet.from_cameras(rig.names, cameras, rig.distortion, rig.size)),
        range(3),
    )
    np.testing.assert_array_equal(small, person_of(people, camera_file(rig), range(3)))


def test_without_extrinsics_each_view_follows_its_own(detector, caplog):
    """As it does, with a warning, where the extrinsics are another rig's."""
    rig = rig_of(4)
    people, _ = scene(detector, rig)
    alone = person_of(people, camera_file(rig, calibrated=False), range(4))
    turned = replace(rig.cameras, R=rig.cameras.R.mT.contiguous())
    with caplog.at_level(logging.WARNING):
        wrong = person_of(
            people,
            camera_file(CameraSet.from_cameras(rig.names, turned, rig.distortion, rig.size)),
            range(4),
        )
    assert "the views agree on nobody: check the extrinsics" in caplog.text
    np.testing.assert_array_equal(alone, wrong)
    with pytest.raises(GhptDataError, match="there is no person 1: 1 can be told apart"):
        person_of(people, camera_file(rig, calibrated=False), range(4), 1)


def test_whoever_is_alone_is_taken_as_they_are(detector):
    rig = rig_of(4)
    people, owner = scene(detector, rig)
    chosen = people.first_of(np.flatnonzero(owner == 0))
    points = people.points.take(chosen)
    alone = Detections.of_person("", people.views, people.joints, people.frame, points)
    one = person_sequence(alone, camera_file(rig)).undistorted()
    other = undistort_detections(people, camera_file(rig), range(4)).take(chosen)
    np.testing.assert_array_equal(one.pixels, other.pixels)


def test_identities_in_the_files_are_taken_as_they_are(tmp_path):
    rng = np.random.default_rng(0)
    bodies = {
        number: np.column_stack([rng.uniform(0, 400, (25, 2)), np.full(25, 0.5)])
        for number in (3, 7)
    }
    for view in ("a", "b"):
        (tmp_path / view).mkdir()
        for frame in range(4):
            there = [
                number for number in rng.permutation([3, 7]).tolist() if number == 7 or frame != 2
            ]
            listed = [
                {"person_id": [n], "pose_keypoints_2d": (bodies[n] + frame).ravel().tolist()}
                for n in there
            ]
            (tmp_path / view / f"{frame}.json").write_text(json.dumps({"people": listed}))
    people = read_key_points(tmp_path, "body_25b")
    cameras = camera_file(
        CameraSet.from_cameras(("a", "b"), rig_of(2).cameras, rig_of(2).distortion, rig_of(2).size)
    )
    for person, number in enumerate((7, 3)):
        points = people.points.take(person_of(people, cameras, (0, 1), person))
        there = np.array([number == 7 or frame != 2 for frame in range(4)])
        assert (points.valid.any(-1) == there[:, None]).all()
        expected = np.broadcast_to(
            (bodies[number][:, 0] + np.arange(4)[:, None])[:, None], (4, 2, 25)
        )
        np.testing.assert_allclose(points.pixels[..., 0][there], expected[there])
    with pytest.raises(GhptDataError, match="there is no person 2: 2 can be told apart"):
        person_of(people, cameras, (0, 1), 2)


def test_nobody_is_no_error():
    rig = rig_of(3)
    none = np.zeros((0, 17, 2), np.float32)
    empty = np.zeros(0, np.int64)
    points = KeyPoints(none, np.zeros((0, 17), np.float32), np.zeros((0, 17), bool))
    assert associate(rig.cameras, 5, empty, empty, points) == []


def test_who_was_seen_beside_another_is_not_that_one():
    """Two stand apart; one leaves and another comes far away: a third track, not the second's."""
    body = np.random.default_rng(0).uniform(-1, 1, (17, 3)) * [300, 300, 900]
    frame, place = np.array([0, 0, 1, 1, 2, 2, 3]), np.array([0, 4000, 30, 4020, 60, 9000, 9020])
    points = body + place[:, None, None] * np.array([1.0, 0, 0])
    bodies = Bodies(frame, points, np.ones((7, 17), bool))
    assert track_bodies(bodies).tolist() == [0, 1, 0, 1, 0, 2, 2]


def test_the_real_recording_keeps_its_person(shared_data):
    """Two or three people in two views, of whom one is in all: every frame of every view is that
    one's.
    """
    from ghpt.data.formats.camera_files import read_cameras

    folder = shared_data / "pose2sim_single"
    people = read_key_points(folder / "pose")
    cameras = read_cameras(folder / "Calib_qualisys.toml")
    chosen = person_of(people, cameras, range(4))
    assert (chosen >= 0).all()
    other = person_of(people, cameras, range(4), 1)
    assert (other[:, 2:] < 0).all()
