"""Several people in the views of calibrated cameras: the right one is followed, whoever the lists
put first.
"""

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
    follow_anybody,
    person_sequence,
    select_person,
    tell_apart,
    undistort_detections,
)
from ghpt.data.people.tracks import Bodies, join_tracks, track_bodies
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.people import PeopleRecording, Scene, Stay, record_people
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import BONES

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


def test_numbers_of_trackers_mean_nothing_in_another_view(detector):
    """Each view's tracker counts anew, and so each calls another person its first."""
    rig = rig_of(4)
    people, owner = scene(detector, rig)
    numbered = replace(people, identity=np.where(people.view % 2, 1 - owner, owner))
    for person in (0, 1):
        chosen = person_of(numbered, camera_file(rig), range(4), person)
        assert len(set(owner[chosen[chosen >= 0]])) == 1


def test_numbers_of_trackers_tell_who_came_back_in_a_view():
    """A body far from both tracks is whom the views call by the old number."""
    body = np.random.default_rng(0).uniform(-1, 1, (17, 3)) * [300, 300, 900]
    place = np.array([0, 500, 250])
    bodies = Bodies(
        frame=np.array([0, 0, 1]),
        points=body + place[:, None, None] * np.array([1.0, 0, 0]),
        valid=np.ones((3, 17), bool),
        identity=np.array([[4, 9], [7, 2], [7, 2]]),
        bones=BONES,
    )
    assert track_bodies(bodies).tolist() == [0, 1, 1]


@pytest.mark.parametrize(("size", "count"), [(1.0, 1), (0.8, 2)])
def test_one_after_another_are_two_if_their_sizes_differ(size, count, detector):
    """Who comes after another has gone is another if smaller by a fifth, and the same otherwise."""
    rig = rig_of(4)
    motion = draw_motion(0, "one", "one", "Walking", FRAMES, 50.0)
    second = motion[::-1] * size
    points = np.concatenate([motion[:120], second[120:]])
    found = detector(points, rig, 50.0, 0, "one", "one")
    valid = found.valid.copy()
    valid[100:140] = False
    key_points = KeyPoints(found.key_points.astype(float), found.confidence.astype(float), valid)
    frame = np.arange(FRAMES)
    people = Detections.of_person("", rig.names, SKELETONS["human36m"], frame, key_points)
    ideal = undistort_detections(people, camera_file(rig), range(4))
    persons = tell_apart(people, camera_file(rig), range(4), ideal)
    spans = [np.flatnonzero((chosen >= 0).any(1))[[0, -1]].tolist() for chosen in persons]
    assert sorted(spans) == {1: [[0, 239]], 2: [[0, 99], [140, 239]]}[count]


def test_everybody_counts_where_nobody_is_there_for_half_of_the_time(detector):
    """Three people, each there for 40 % of the time: all are found in all of their frames."""
    stays = [
        Stay("Walking", (0, 0), ((0.0, 0.4),), stature=1850.0),
        Stay("Walking", (0, 700), ((0.3, 0.7),)),
        Stay("Walking", (0, 0), ((0.6, 1.0),), stature=1550.0),
    ]
    recording = record_people("turns", Scene([3, 12, 23], stays, 60, 30.0), detector, 0)
    persons = everybody(recording)
    found = np.zeros(recording.present.shape, bool)
    for chosen in persons:
        row, view = np.nonzero(chosen >= 0)
        found[row, recording.owner[chosen[row, view]]] = True
    assert len(persons) == 3
    assert found[recording.detected_views() >= 2].mean() > 0.98


def test_detections_of_nobody_make_nobody(detector):
    """Twenty in every view of every frame, beside two people."""
    stays = [Stay("Walking", (0, 0)), Stay("Walking", (600, 300))]
    scene = Scene([3, 8, 12, 18, 23], stays, 20, 30.0, false_detections=20)
    recording = record_people("false", scene, detector, 0)
    owners = [recording.owner[chosen[chosen >= 0]] for chosen in everybody(recording)]
    assert sorted(np.bincount(owner + 1).argmax() - 1 for owner in owners) == [0, 1]
    assert all((owner >= 0).mean() > 0.97 for owner in owners)


@pytest.mark.parametrize(("straight", "count"), [(True, 1), (False, 0)])
def test_who_walks_on_is_somebody_and_what_jumps_as_far_is_nobody(straight, count):
    """Two views see a body that moves a quarter of a metre from frame to frame."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-1, 1, (17, 3)) * [300, 300, 900]
    heading = np.zeros(20) if straight else rng.uniform(0, 2 * np.pi, 20)
    step = 250 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], -1)
    points = body + step.cumsum(0)[:, None] + rng.normal(0, 20, (20, 17, 3))
    members = np.arange(40).reshape(20, 2)
    bodies = Bodies(np.arange(20), points, np.ones((20, 17), bool), 0 * members - 1, BONES)
    track = np.zeros(20, np.int64)
    assert len(join_tracks(20, bodies, track, np.ones(20), members)) == count


@pytest.fixture(scope="module")
def crossing(detector) -> PeopleRecording:
    """Two people of whom each view shows another one larger for a while."""
    stays = [Stay("Walking", (0, 0)), Stay("Walking", (500, 300))]
    return record_people("crossing", Scene([3, 8, 12, 18], stays, 60, 30.0), detector, 0)


def owners_of(recording: PeopleRecording, cameras: CameraSet) -> np.ndarray:
    """Whom the cameras are judged by, in each frame and view; -1 where by nobody."""
    people = recording.detections
    chosen = follow_anybody(people, cameras, range(len(people.views)), people.points)
    return np.where(chosen >= 0, recording.owner[chosen], -1)


def test_cameras_are_judged_by_one_person_in_all_views(crossing):
    owners = owners_of(crossing, crossing.cameras)
    assert (owners >= 0).mean() > 0.95
    mixed = [len(set(row[row >= 0])) > 1 for row in owners]
    assert np.mean(mixed) < 0.02


def test_a_camera_that_is_off_is_not_left_out_of_its_judgement(crossing):
    """Turned by 15 degrees it agrees with nobody, and goes on with whom it tracks best."""
    rig = crossing.cameras
    angle = np.deg2rad(15)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    R = rig.cameras.R.clone()
    t = rig.cameras.t.clone()
    R[1] = R.new_tensor(turn) @ R[1]
    t[1] = t.new_tensor(turn) @ t[1]
    owners = owners_of(crossing, replace(rig, R=R, t=t))
    assert (owners[:, 1] >= 0).mean() > 0.95
    others = owners[:, [0, 2, 3]]
    mixed = [len(set(row[row >= 0])) > 1 for row in others]
    assert np.mean(mixed) < 0.02


def everybody(recording: PeopleRecording) -> list[np.ndarray]:
    people = recording.detections
    return tell_apart(people, recording.cameras, range(len(people.views)), people.points)


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
    bodies = Bodies(frame, points, np.ones((7, 17), bool), np.full((7, 2), -1), BONES)
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
