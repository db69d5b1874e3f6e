"""The bodies of successive frames as people.

What stays near is a track; tracks that can be one person's are joined.
"""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

_NEAR = 0.35
"""A body is the next frame's if the median distance of their joints is below this part of its
height.
"""
_SURELY_NEAR = 0.3
"""Parts of the reach within which a body is a track's before farther ones are thought of."""
_SPEED = 0.05
"""Parts of the height that a body can move further in each frame in which it was not seen."""
_GAP = 4
"""Frames after which a track that was not seen has ended."""
_COASTING = 3
"""Frames for which a body that is not seen is taken to go on as it went."""
_SAME_IDENTITY = 0.2
"""What it is worth, in parts of the reach, that the trackers of the views call a body the same."""
_LEAST_JOINTS = 4
"""Joints that two bodies must share to be compared."""
_SIZE_SPREAD = 0.02
"""Deviation of the logarithmic size between two tracks of one person, however long they are: a
detector errs alike as long as a body is seen from one side.
"""
_STEADY = 10
"""Frames in which a detector's error of a bone is one and the same."""
_UNKNOWN_SPREAD = 0.15
"""That of one frame's bones, where no track is long enough to tell."""
_OTHER_SIZE = 2.5
"""Tracks are two people's if their sizes differ by more deviations."""
_LEAST_BONES = 4
_SURE_VIEWS = 2.5
"""Mean number of views from which a track is no chance."""
_JUMP = 0.1
"""Heights by which no person moves from frame to frame on average."""
_LEAST_FRAMES = 3
"""Of a person in a recording that moves: what is there for less is a chance of false detections."""


@dataclass(frozen=True)
class Bodies:
    """G bodies of some frames, in any order."""

    frame: Int[np.ndarray, " G"]
    points: Float[np.ndarray, "G J 3"]
    valid: Bool[np.ndarray, "G J"]
    identity: Int[np.ndarray, "G V"]
    """The number that each view's own tracker gave the body's detection, -1 where none did."""
    bones: tuple[tuple[int, int], ...]
    """Pairs of joints whose distance hardly changes."""

    def __len__(self) -> int:
        return len(self.frame)

    @cached_property
    def height(self) -> Float[np.ndarray, " G"]:
        """The diagonal of the box around the joints."""
        return box_diagonal(self.points, self.valid)

    @cached_property
    def middle(self) -> Float[np.ndarray, "G 3"]:
        """The mean of the joints."""
        total = np.where(self.valid[..., None], self.points, 0).sum(1)
        return total / self.valid.sum(1).clip(1)[:, None]


def box_diagonal(
    points: Float[np.ndarray, "N J D"], valid: Bool[np.ndarray, "N J"]
) -> Float[np.ndarray, " N"]:
    """Return the diagonal of the box around the valid points; 0 where there is none."""
    mask = valid[..., None]
    low = np.where(mask, points, np.inf).min(1)
    high = np.where(mask, points, -np.inf).max(1)
    known = np.isfinite(low)
    low = np.where(known, low, 0)
    extent = np.where(known, high - low, 0)
    return np.linalg.norm(extent, axis=-1)


def track_bodies(bodies: Bodies) -> Int[np.ndarray, " G"]:
    """Return the number of each body's track.

    In each frame bodies go to the tracks whose last body, moved on as the track last moved, is
    nearest.
    """
    track = np.full(len(bodies), -1)
    last = np.zeros(0, np.int64)
    velocity = np.zeros((0, 3))
    count = 0
    for now in _split_by(bodies.frame):
        gap = bodies.frame[now[0]] - bodies.frame[last]
        recent = gap <= _GAP
        last = last[recent]
        velocity = velocity[recent]
        gap = gap[recent]
        moved = velocity * np.minimum(gap, _COASTING)[:, None]
        distance = _distances(bodies, last[:, None], now, moved[:, None]) / _reach(gap)[:, None]
        same = _same_identity(bodies.identity[last], bodies.identity[now])
        rows, columns = _assign(distance - _SAME_IDENTITY * same)
        track[now[columns]] = track[last[rows]]
        new = track[now] < 0
        track[now[new]] = count + np.arange(new.sum())
        count += int(new.sum())
        of_now = np.zeros((len(now), 3))
        step = _displacement(bodies, last[rows], now[columns]) / gap[rows, None]
        of_now[columns] = (velocity[rows] + step) / 2
        last = np.concatenate([now, np.delete(last, rows)])
        velocity = np.concatenate([of_now, np.delete(velocity, rows, axis=0)])
    return track


_UNREACHABLE = 1e6


def _assign(
    cost: Float[np.ndarray, "A B"],
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return which rows and columns belong together: first the surely near, then the others.

    Taken at once, two that are far could be had for one that is near.
    """
    cost = np.array(cost)
    pairs = []
    for limit in (_SURELY_NEAR, 1.0):
        gated = np.where(cost < limit, cost, limit)
        rows, columns = linear_sum_assignment(gated)
        near = gated[rows, columns] < limit
        pairs.append((rows[near], columns[near]))
        cost[rows[near]] = np.inf
        cost[:, columns[near]] = np.inf
    rows, columns = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return rows, columns


def _reach(gap: Int[np.ndarray, " A"]) -> Float[np.ndarray, " A"]:
    """Return how far a body can be after so many frames, in heights."""
    return _NEAR + _SPEED * (gap - 1)


_STILL = np.zeros(3)


def _distances(
    bodies: Bodies,
    one: Int[np.ndarray, "*S"],
    other: Int[np.ndarray, "*S"],
    moved: Float[np.ndarray, "*S 3"] = _STILL,
) -> Float[np.ndarray, "*S"]:
    """Return the distances of bodies, the first ones ``moved``, in heights of the taller.

    It is the median distance of the joints that both have. Where these are too few, as of a head
    and of legs, it is how far their middles are apart beyond what their own sizes explain, and half
    of the reach more: such a body is taken where no other is.
    """
    before = bodies.points[one] + moved[..., None, :]
    after = bodies.points[other]
    both = bodies.valid[one] & bodies.valid[other]
    median = _median(np.linalg.norm(before - after, axis=-1), both, _LEAST_JOINTS)
    offset = np.linalg.norm(bodies.middle[one] + moved - bodies.middle[other], axis=-1)
    heights = bodies.height[one], bodies.height[other]
    taller = np.maximum(*heights).clip(1e-9)
    beyond = np.maximum(offset - sum(heights) / 4, 0)
    return np.where(np.isfinite(median), median / taller, beyond / taller + _NEAR / 2)


def _median(
    values: Float[np.ndarray, "*S N"], valid: Bool[np.ndarray, "*S N"], least: int
) -> Float[np.ndarray, "*S"]:
    """Return the (lower) median of the valid values; inf where there are fewer than ``least``."""
    if not values.shape[-1]:
        return np.full(values.shape[:-1], np.inf)
    count = valid.sum(-1)
    middle = np.maximum(count - 1, 0) // 2
    ordered = np.sort(np.where(valid, values, np.inf), axis=-1)
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    return np.where(count >= least, median, np.inf)


def _displacement(
    bodies: Bodies, last: Int[np.ndarray, " B"], now: Int[np.ndarray, " B"]
) -> Float[np.ndarray, "B 3"]:
    """Return the median displacement of the joints from one body to another, 0 where none is."""
    both = bodies.valid[last] & bodies.valid[now]
    step = np.moveaxis(bodies.points[now] - bodies.points[last], -1, 1)
    median = _median(step, both[:, None].repeat(3, 1), 1)
    return np.where(np.isfinite(median), median, 0.0)


def _same_identity(
    one: Int[np.ndarray, "A V"], other: Int[np.ndarray, "B V"]
) -> Float[np.ndarray, "A B"]:
    """Return the share of the views, of those whose trackers know both, that call them the same."""
    known = (one >= 0)[:, None] & (other >= 0)
    same = known & (one[:, None] == other)
    return same.sum(-1) / known.sum(-1).clip(1)


@dataclass
class _Person:
    """The tracks that were joined so far."""

    bones: _Bones
    starts: list[int] = field(default_factory=list)
    """First frames of the tracks, rising; they are never there at once."""
    tracks: list[_Track] = field(default_factory=list)
    """In the order of time."""

    def place(self, track: _Track) -> int | None:
        """Return where a track belongs in time, None if another is there at that time."""
        at = bisect(self.starts, track.first)
        if at > 0 and self.tracks[at - 1].last >= track.first:
            return None
        if at < len(self.tracks) and self.tracks[at].first <= track.last:
            return None
        return at

    def add(self, track: _Track, at: int) -> None:
        self.starts.insert(at, track.first)
        self.tracks.insert(at, track)
        self.bones = self.bones.merge(track.bones)


@dataclass(frozen=True)
class _Bones:
    """Logarithmic lengths of the bones, with their precision (1 / variance), 0 where unknown."""

    length: Float[np.ndarray, " B"]
    precision: Float[np.ndarray, " B"]

    def merge(self, other: _Bones) -> _Bones:
        total = self.precision + other.precision
        summed = self.precision * self.length + other.precision * other.length
        return _Bones(summed / np.maximum(total, 1e-12), total)

    def difference(self, other: _Bones) -> float:
        """Return by how many deviations the two are of different size; 0 where too few are known.

        Sizes are compared by the mean difference of the logarithms, weighted by precision. Single
        bones are not: a detector errs by more from one side than people differ.
        """
        known = (self.precision > 0) & (other.precision > 0)
        if known.sum() < _LEAST_BONES:
            return 0.0
        precision = 1 / (1 / self.precision[known] + 1 / other.precision[known])
        difference = self.length[known] - other.length[known]
        mean = (precision * difference).sum() / precision.sum()
        variance = _SIZE_SPREAD**2 + 1 / precision.sum()
        return float(abs(mean) / np.sqrt(variance))


@dataclass(frozen=True)
class _Track:
    """One track."""

    rows: Int[np.ndarray, " N"]
    """Its bodies, in the order of time."""
    first: int
    last: int
    """Frames."""
    bones: _Bones


def _split_by(number: Int[np.ndarray, " G"]) -> list[Int[np.ndarray, " N"]]:
    """Return the positions of each number, in the order of the numbers."""
    if not len(number):
        return []
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order])) + 1
    return np.split(order, starts)


def join_tracks(
    frames: int,
    bodies: Bodies,
    track: Int[np.ndarray, " G"],
    worth: Float[np.ndarray, " G"],
    members: Int[np.ndarray, "G V"],
) -> list[Int[np.ndarray, "T V"]]:
    """Return the members [T V] of each person, the best first; -1 where there is none.

    1. The tracks are taken by what their bodies are worth together, and each is joined to the
       person whom it fits best: who is not there at the same time, has bones of the same lengths,
       and can have come from where they were last. A track that fits nobody is a new person.
    2. A track that only two views support is left out if it is short or jumps (`_is_chance`), and
       who is there for fewer than ``_LEAST_FRAMES`` frames is nobody; unless most tracks are as
       short: then the frames are no film, and nothing is said of where people come from.
    3. Persons are ordered by what their bodies are worth together.
    """
    rows_of_track = _split_by(track)
    counts = np.array([len(rows) for rows in rows_of_track])
    film = len(track) > 0 and bool(np.median(counts[track]) >= _LEAST_FRAMES)
    total = np.bincount(track, worth) if len(track) else np.zeros(0)
    tracks = _tracks(bodies, rows_of_track)
    views = (members >= 0).sum(1)
    persons: list[_Person] = []
    for number in np.argsort(-total, kind="stable"):
        own = tracks[number]
        if film and _is_chance(bodies, views, own):
            continue
        best = _Fit(_UNREACHABLE, -1, 0)
        for index, person in enumerate(persons):
            fit = _fit(bodies, person, own, film, index)
            if fit is not None and fit.cost < best.cost:
                best = fit
        if best.person >= 0:
            persons[best.person].add(own, best.place)
        else:
            persons.append(_Person(own.bones, [own.first], [own]))
    found = []
    for person in persons:
        rows = np.concatenate([each.rows for each in person.tracks])
        if len(rows) >= _LEAST_FRAMES or not film:
            chosen = np.full((frames, members.shape[1]), -1)
            chosen[bodies.frame[rows]] = members[rows]
            found.append((float(worth[rows].sum()), chosen))
    found.sort(key=lambda pair: -pair[0])
    return [chosen for _, chosen in found]


def _is_chance(
    bodies: Bodies,
    views: Int[np.ndarray, " G"],
    track: _Track,
) -> bool:
    """Return whether a track may be of detections that agree by chance.

    Two detections of nobody that lie on one another's epipolar lines make a body in space. It has
    no third view, and no body near it in the next frame.
    """
    rows = track.rows
    if views[rows].mean() >= _SURE_VIEWS:
        return False
    if len(rows) < _LEAST_FRAMES:
        return True
    return bool(_distances(bodies, rows[:-1], rows[1:]).mean() > _JUMP)


@dataclass(frozen=True)
class _Fit:
    """Which person a track fits, and where in time."""

    cost: float
    person: int
    place: int


def _fit(
    bodies: Bodies,
    person: _Person,
    track: _Track,
    film: bool,
    index: int,
) -> _Fit | None:
    """Return how well a track fits a person; None where it cannot be theirs."""
    place = person.place(track)
    if place is None:
        return None
    cost = person.bones.difference(track.bones)
    if cost > _OTHER_SIZE:
        return None
    if not film:
        return _Fit(cost, index, place)
    for before, after in _neighbours(person, track, place):
        one = before.rows[-1:]
        other = after.rows[:1]
        gap = np.array([after.first - before.last])
        distance = float(_distances(bodies, one, other)[0] / _reach(gap)[0])
        if distance > 1:
            return None
        same = _same_identity(bodies.identity[one], bodies.identity[other])
        cost += distance - float(same[0, 0])
    return _Fit(cost, index, place)


def _neighbours(person: _Person, track: _Track, place: int) -> list[tuple[_Track, _Track]]:
    """Return the track with those before and after it, in the order of time."""
    pairs = [(before, track) for before in person.tracks[max(place - 1, 0) : place]]
    return pairs + [(track, after) for after in person.tracks[place : place + 1]]


def _tracks(bodies: Bodies, rows_of_track: list[Int[np.ndarray, " N"]]) -> list[_Track]:
    """Return the tracks, with the lengths of their bones."""
    start, end = np.array(bodies.bones, np.int64).reshape(-1, 2).T
    length = np.linalg.norm(bodies.points[:, start] - bodies.points[:, end], axis=-1)
    known = bodies.valid[:, start] & bodies.valid[:, end] & (length > 0)
    logarithm = np.log(np.where(known, length, 1.0))
    middles = [_median(logarithm[rows].T, known[rows].T, 1) for rows in rows_of_track]
    spread = _spread(logarithm, known, rows_of_track, middles)
    tracks = []
    for rows, middle in zip(rows_of_track, middles, strict=True):
        independent = np.maximum(known[rows].sum(0) / _STEADY, 1.0)
        precision = np.where(np.isfinite(middle), independent / spread**2, 0.0)
        tracks.append(
            _Track(
                rows=rows,
                first=int(bodies.frame[rows[0]]),
                last=int(bodies.frame[rows[-1]]),
                bones=_Bones(np.where(np.isfinite(middle), middle, 0.0), precision),
            )
        )
    return tracks


def _spread(
    logarithm: Float[np.ndarray, "G B"],
    known: Bool[np.ndarray, "G B"],
    rows_of_track: list[Int[np.ndarray, " N"]],
    middles: list[Float[np.ndarray, " B"]],
) -> Float[np.ndarray, " B"]:
    """Return the deviation of each bone's logarithmic length within the tracks."""
    residual = np.full(logarithm.shape, np.inf)
    for rows, middle in zip(rows_of_track, middles, strict=True):
        if len(rows) >= _LEAST_FRAMES:
            residual[rows] = np.abs(logarithm[rows] - middle)
    measured = known & np.isfinite(residual)
    deviation = 1.5 * _median(residual.T, measured.T, 1)
    return np.where(np.isfinite(deviation), deviation, _UNKNOWN_SPREAD).clip(min=0.02)
