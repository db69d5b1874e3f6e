"""From detections to a sequence: whose they are, before which cameras, and out of the lens."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from collections.abc import Sequence as Items
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from ghpt.data.datasets.detections import undistort_key_points
from ghpt.data.formats.names import Name
from ghpt.data.formats.skeletons import map_to_joints
from ghpt.data.people.association import associate
from ghpt.data.people.detections import Detections
from ghpt.data.people.following import follow_views
from ghpt.data.people.matching import match_views
from ghpt.data.people.pixel_checks import check_image_sizes, check_pixels, scale_to_images
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import BONES

_LEAST_SHARE = 0.1
_log = logging.getLogger(__name__)

Chosen = Int[np.ndarray, "T V"]
"""The index of one person's detection in each frame and view, -1 where there is none."""


def person_sequence(
    people: Detections,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None = None,
    views: Items[Name] | None = None,
    person: int | None = 0,
    title: str = "",
    check_sizes: bool = True,
) -> Sequence:
    """Return one person with their cameras, the lens distortion undone, as the 17 joints.

    The arguments are those of `detector_sequence`. Raises GhptDataError, also where the detector
    gives too few of the 17.
    """
    people.skeleton.require_joints(people.path)
    sequence = detector_sequence(people, cameras, match, views, person, title, check_sizes)
    return sequence.as_joints()


def detector_sequence(
    people: Detections,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None = None,
    views: Items[Name] | None = None,
    person: int | None = 0,
    title: str = "",
    check_sizes: bool = True,
) -> Sequence:
    """Return one person with their cameras, the lens distortion undone, and all their key points.

    Views and cameras are matched as `match_views` says. ``person`` chooses as `select_person` says;
    None is whoever shows what the cameras are (`follow_anybody`). ``check_sizes`` refuses key
    points of images of another size. Raises GhptDataError.
    """
    at, ordered = match_views(people.path, people.views, cameras, match, views)
    people = scale_to_images(people, ordered, at)
    ideal = undistort_detections(people, ordered, at)
    told_apart_by = _association_points(people, ideal)
    if person is None:
        chosen = follow_anybody(people, ordered, at, told_apart_by)
    else:
        chosen = select_person(people, ordered, at, told_apart_by, person)
    return _sequence(people, ordered, at, ideal, chosen, title, check_sizes)


def detector_sequences(
    people: Detections,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None = None,
    views: Items[Name] | None = None,
    title: str = "",
) -> list[Sequence]:
    """Return everybody of `tell_apart`, the most visible first, each as `detector_sequence` does.

    All have the same frames. The most visible person tells whether key points are of images of
    another size. Raises GhptDataError.
    """
    at, ordered = match_views(people.path, people.views, cameras, match, views)
    people = scale_to_images(people, ordered, at)
    ideal = undistort_detections(people, ordered, at)
    found = tell_apart(people, ordered, at, _association_points(people, ideal))
    return [
        _sequence(people, ordered, at, ideal, chosen, title, check_sizes=not person)
        for person, chosen in enumerate(found)
    ]


def _sequence(
    people: Detections,
    cameras: CameraSet,
    at: Items[int],
    ideal: KeyPoints,
    chosen: Chosen,
    title: str,
    check_sizes: bool,
) -> Sequence:
    raw = people.points.take(chosen[:, at])
    check_pixels(people.path, raw, cameras)
    if check_sizes:
        check_image_sizes(people.path, raw, cameras)
    return Sequence(
        title=title,
        source=people.path,
        cameras=cameras,
        frame=people.frame.astype(np.int64),
        rate_hz=people.rate_hz,
        points=KeyPointArrays(ideal.take(chosen[:, at]), raw.mask_invalid()),
        skeleton=people.skeleton,
    )


def tracks_of_views(
    people: Detections,
    cameras: CameraSet,
    match: Mapping[Name, Name] | None = None,
    views: Items[Name] | None = None,
    most: int = 4,
) -> list[Sequence]:
    """Return those whom each view follows by itself: of each the most prominent person, then the
    most prominent of the rest, ``most`` times. Those of one rank need not be one person.

    Raises GhptDataError where views and cameras do not match.
    """
    at, ordered = match_views(people.path, people.views, cameras, match, views)
    ideal = undistort_detections(people, ordered, at)
    left = np.arange(len(people))
    tracks: list[Sequence] = []
    while len(left) and len(tracks) < most:
        rest = replace(
            people,
            row=people.row[left],
            view=people.view[left],
            identity=people.identity[left],
            points=people.points[left],
        )
        followed = follow_views(rest)
        chosen = np.where(followed >= 0, left[followed], -1)
        tracks.append(_sequence(people, ordered, at, ideal, chosen, "", False))
        left = np.setdiff1d(left, chosen)
    return tracks


def _association_points(people: Detections, ideal: KeyPoints) -> KeyPoints:
    """Return by what people are told apart: the 17 joints, or all key points without them."""
    if not people.skeleton.has_joints:
        return ideal
    return map_to_joints(ideal, people.skeleton)


def undistort_detections(people: Detections, cameras: CameraSet, at: Items[int]) -> KeyPoints:
    """Return the key points [N K] of all detections in the views ``at``, as pinholes see them.

    ``cameras`` are those of the views. Nothing is valid in the other views.
    """
    pixels = np.zeros(people.points.pixels.shape, np.float32)
    valid = np.zeros(people.points.valid.shape, np.bool_)
    for camera, view in enumerate(at):
        indices = np.flatnonzero(people.view == view)
        points = undistort_view(people.points[indices], cameras, camera)
        pixels[indices] = points.pixels
        valid[indices] = points.valid
    return KeyPoints(pixels, people.points.confidence, valid).mask_invalid()


def with_lenses(sequence: Sequence, cameras: CameraSet) -> Sequence:
    """Return the sequence before the same cameras with other intrinsics and lenses, in memory."""
    detected = sequence.detected()
    views = [undistort_view(detected[:, view], cameras, view) for view in range(len(cameras))]
    return replace(
        sequence, cameras=cameras, points=KeyPointArrays(KeyPoints.stack(views), detected)
    )


def undistort_view(points: KeyPoints, cameras: CameraSet, camera: int) -> KeyPoints:
    """Return one camera's key points [N K] as an ideal pinhole would see them, float32.

    Those that are not finite, or where the lens model cannot be inverted, are not valid.
    """
    K = cameras.K[camera].numpy()
    distortion = cameras.distortion[camera].numpy()
    pixels, valid = undistort_key_points(points.pixels, points.valid, K, distortion)
    return KeyPoints(pixels, points.confidence, valid)


def select_person(
    people: Detections,
    cameras: CameraSet,
    at: Items[int],
    ideal: KeyPoints,
    person: int = 0,
) -> Chosen:
    """Return the detections of one person of `tell_apart`, the most visible (0), the next, ...

    Raises GhptDataError if there is no such person.
    """
    found = tell_apart(people, cameras, at, ideal)
    if not 0 <= person < len(found):
        problem = f"there is no person {person}: {len(found)} can be told apart"
        hint = f"Give a number below {len(found)}; 0 is who is seen most."
        raise GhptDataError(people.path, "person", problem, hint)
    return found[person]


def tell_apart(
    people: Detections, cameras: CameraSet, at: Items[int], ideal: KeyPoints
) -> list[Chosen]:
    """Return the detections of everybody, of the most visible person first.

    ``cameras`` are those of the views ``at``, and ``ideal`` what `undistort_detections` gives.

    1. Persons are those who agree across the views (`associate`). The numbers that trackers gave
       tell who is the same in one view; nothing is made of their being equal in two.
    2. Where nobody is ever beside another, whatever was detected in a frame is of the person who is
       there: in views that do not agree, too. One after another they are several persons if their
       sizes differ.
    3. Without extrinsics, or where no two views agree in half of the frames, there is one person,
       whom each view follows by itself (`follow_views`), in the last case with a warning.
    """
    counts = people.counts()[:, at]
    crowded = bool((counts > 1).any())
    found = _across_views(people, cameras, at, ideal) if cameras.calibrated else []
    if not crowded:
        return _one_by_one(people, found)
    if cameras.calibrated:
        frames_of_two_views = ((counts > 0).sum(1) >= 2).sum()
        together = [(chosen >= 0).any(1) for chosen in found]
        if found and 2 * np.any(together, axis=0).sum() >= frames_of_two_views:
            return found
        _warn_of_disagreement(people, cameras)
    return [follow_views(people)]


def _warn_of_disagreement(people: Detections, cameras: CameraSet) -> None:
    _log.warning(
        "%s: the views agree on nobody: check the extrinsics of %s, and that frames have the "
        "same numbers in all views. Each view follows the person that it tracks best.",
        people.path,
        cameras.path,
    )


def follow_anybody(
    people: Detections, cameras: CameraSet, at: Items[int], ideal: KeyPoints
) -> Chosen:
    """Return the detections of one person in each frame, by whom the cameras can be judged.

    The arguments are those of `tell_apart`.

    1. It is the most visible of the persons on whom two views agree in this frame.
    2. A view that agrees in less than half of the frames in which it has anybody may be off: it
       follows the person whom it tracks best (`follow_views`), as all views do without extrinsics
       and where nobody is ever beside another; and, with a warning, where no two views agree in
       half of the frames.
    """
    own = follow_views(people)
    counts = people.counts()[:, at]
    if not cameras.calibrated or not (counts > 1).any():
        return own
    chosen = np.full_like(own, -1)
    for person in _across_views(people, cameras, at, ideal):
        free = (chosen < 0).all(1)
        chosen[free] = person[free]
    together = (chosen >= 0).any(1)
    if 2 * together.sum() < ((counts > 0).sum(1) >= 2).sum():
        _warn_of_disagreement(people, cameras)
        return own
    for place, view in enumerate(at):
        there = together & (counts[:, place] > 0)
        if 2 * (chosen[there, view] >= 0).sum() < there.sum():
            chosen[:, view] = own[:, view]
    return chosen


def _one_by_one(people: Detections, found: Items[Chosen]) -> list[Chosen]:
    """Return the detections of each person where no view ever has two.

    Each frame is that of the person who was found nearest in time. Whoever was found in less than
    ``_LEAST_SHARE`` of the frames is not thought another.
    """
    everything = people.first()
    there = np.array([(chosen >= 0).any(1) for chosen in found])
    if len(found) > 1 and (there.sum(0) > 1).any():
        return list(found)
    if len(found) > 1:
        there = there[there.sum(1) >= _LEAST_SHARE * there.sum()]
    if len(there) < 2:
        return [everything]
    known = np.flatnonzero(there.any(0))
    frames = np.arange(len(everything))
    after = np.searchsorted(known, frames).clip(0, len(known) - 1)
    before = (after - 1).clip(0)
    later = known[after] - frames < frames - known[before]
    owner = there.argmax(0)[np.where(later, known[after], known[before])]
    return [np.where((owner == person)[:, None], everything, -1) for person in range(len(there))]


def _across_views(
    people: Detections, cameras: CameraSet, at: Items[int], ideal: KeyPoints
) -> list[Chosen]:
    """Return the detections of everybody who can be told apart across the views ``at``."""
    indices = [np.flatnonzero(people.view == view) for view in at]
    index = np.concatenate(indices)
    camera = np.repeat(np.arange(len(at)), [len(each) for each in indices])
    rows = people.row[index]
    frames = len(people.frame)
    numbers = people.identity[index]
    skeleton = people.skeleton
    bones = BONES if skeleton.has_joints else skeleton.bones
    found = associate(cameras.cameras, frames, rows, camera, ideal[index], numbers, bones)
    persons = []
    for members in found:
        chosen = np.full((len(people.frame), len(people.views)), -1)
        chosen[:, at] = np.where(members >= 0, index[members], -1)
        persons.append(chosen)
    return persons
