"""The bodies of successive frames as people.

What stays near is a track; tracks that can be one person's are joined.
"""

from __future__ import annotations

from dataclasses import dataclass
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
"""Heights by which who does not go straight moves from frame to frame, at most, on average."""
_REST = 0.06
"""Deviation of where a body is in the next frame from where its way led, in heights."""
_WANDER = 0.03
"""By how much that grows in each frame in which the body is not seen."""
_ANYWHERE = 3.0
"""The largest."""
_SAME_WORTH = 4.0
"""What it is worth, as a logarithm of likelihood, that trackers call two tracks the same."""
_LINKS = 64
"""Tracks after a track's end that are thought of at once as its continuation."""
_STRAIGHT = 0.75
"""Change of the step from frame to frame, as a part of it, below which somebody goes straight."""
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


@dataclass(frozen=True)
class _Bones:
    """Logarithmic lengths of the bones, with their precision (1 / variance), 0 where unknown."""

    length: Float[np.ndarray, "*N B"]
    precision: Float[np.ndarray, "*N B"]

    def merge(self, other: _Bones) -> _Bones:
        total = self.precision + other.precision
        summed = self.precision * self.length + other.precision * other.length
        return _Bones(summed / np.maximum(total, 1e-12), total)

    def take(self, at: Int[np.ndarray, " M"]) -> _Bones:
        return _Bones(self.length[at], self.precision[at])

    def difference(self, other: _Bones) -> Float[np.ndarray, "*N"]:
        """Return by how many deviations they are of different size; 0 where too few are known.

        Sizes are compared by the mean difference of the logarithms, weighted by precision. Single
        bones are not: a detector errs by more from one side than people differ.
        """
        known = (self.precision > 0) & (other.precision > 0)
        variance = 1 / self.precision.clip(1e-12) + 1 / other.precision.clip(1e-12)
        precision = np.where(known, 1 / variance, 0.0)
        total = precision.sum(-1).clip(1e-12)
        mean = (precision * (self.length - other.length)).sum(-1) / total
        deviation = np.sqrt(_SIZE_SPREAD**2 + 1 / total)
        return np.where(known.sum(-1) < _LEAST_BONES, 0.0, abs(mean) / deviation)


@dataclass(frozen=True)
class _Track:
    """One track."""

    rows: Int[np.ndarray, " N"]
    """Its bodies, in the order of time."""
    first: int
    last: int
    """Frames."""
    bones: _Bones

    def join(self, later: _Track) -> _Track:
        """Return the track that goes on as a later one."""
        rows = np.concatenate([self.rows, later.rows])
        return _Track(rows, self.first, later.last, self.bones.merge(later.bones))


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

    1. A track that only two views support is left out if it is short or jumps (`_is_chance`).
    2. A track goes on as the later one that it can be and is likeliest to be (`_Links`), the
       likeliest of all first: who has bones of the same lengths, and is where the way led.
    3. Who is there for fewer than ``_LEAST_FRAMES`` frames is nobody; unless most tracks are as
       short: then the frames are no film, and nothing is said of where people come from.
    4. Persons are ordered by what their bodies are worth together.
    """
    rows_of_track = _split_by(track)
    counts = np.array([len(rows) for rows in rows_of_track])
    film = len(track) > 0 and bool(np.median(counts[track]) >= _LEAST_FRAMES)
    views = (members >= 0).sum(1)
    tracks = _tracks(bodies, rows_of_track)
    if film:
        tracks = [each for each in tracks if not _is_chance(bodies, views, each)]
    found = []
    for person in _join(bodies, tracks, film):
        if len(person.rows) >= _LEAST_FRAMES or not film:
            chosen = np.full((frames, members.shape[1]), -1)
            chosen[bodies.frame[person.rows]] = members[person.rows]
            found.append((float(worth[person.rows].sum()), chosen))
    found.sort(key=lambda pair: -pair[0])
    return [chosen for _, chosen in found]


def _is_chance(
    bodies: Bodies,
    views: Int[np.ndarray, " G"],
    track: _Track,
) -> bool:
    """Return whether a track may be of detections that agree by chance.

    Two detections of nobody that lie on one another's epipolar lines make a body in space. It has
    no third view, and no body near it in the next frame; where few frames are taken in a second, a
    person moves as far, but goes on as they went.
    """
    rows = track.rows
    if views[rows].mean() >= _SURE_VIEWS:
        return False
    if len(rows) < _LEAST_FRAMES:
        return True
    if _distances(bodies, rows[:-1], rows[1:]).mean() <= _JUMP:
        return False
    frames = np.diff(bodies.frame[rows])[:, None]
    step = _displacement(bodies, rows[:-1], rows[1:]) / frames
    change = np.linalg.norm(np.diff(step, axis=0), axis=-1)
    steady = change.mean() < _STRAIGHT * np.linalg.norm(step, axis=-1).mean()
    return len(rows) < _STEADY or not steady


@dataclass(frozen=True)
class _Links:
    """L pairs of tracks of which the second can be the first one's continuation."""

    cost: Float[np.ndarray, " L"]
    """Minus the logarithm of how likely it is, but for a constant."""
    first: Int[np.ndarray, " L"]
    second: Int[np.ndarray, " L"]


def _join(bodies: Bodies, tracks: list[_Track], film: bool) -> list[_Track]:
    """Return the tracks of people, joined of those that are one person's."""
    while tracks:
        tracks = sorted(tracks, key=lambda track: track.first)
        links = _find_links(bodies, tracks, film)
        joined = dict(enumerate(tracks))
        head = list(range(len(tracks)))  # of what ends with each track
        tail = list(range(len(tracks)))  # of what begins with each track
        for at in np.argsort(links.cost, kind="stable"):
            first = int(links.first[at])
            second = int(links.second[at])
            begin = head[first]
            if tail[begin] != first or second not in joined:
                continue
            if joined[begin].bones.difference(joined[second].bones) > _OTHER_SIZE:
                continue
            joined[begin] = joined[begin].join(joined.pop(second))
            tail[begin] = tail[second]
            head[tail[begin]] = begin
        if len(joined) == len(tracks):
            break
        tracks = list(joined.values())
    return tracks


def _find_links(bodies: Bodies, tracks: list[_Track], film: bool) -> _Links:
    """Return the links of tracks, in the order of their first frames, to some that come next."""
    starts = np.array([track.first for track in tracks])
    next_one = np.searchsorted(starts, [track.last for track in tracks], side="right")
    second = next_one[:, None] + np.arange(_LINKS)
    first = np.arange(len(tracks))[:, None].repeat(_LINKS, 1)[second < len(tracks)]
    second = second[second < len(tracks)]
    bones = _Bones(
        np.stack([track.bones.length for track in tracks]),
        np.stack([track.bones.precision for track in tracks]),
    )
    size = bones.take(first).difference(bones.take(second))
    cost = size**2 / 2
    possible = size <= _OTHER_SIZE
    if film:
        ways = _ways(bodies, tracks, first, second)
        possible &= ways < np.inf
        cost += ways
    return _Links(cost[possible], first[possible], second[possible])


def _ways(
    bodies: Bodies,
    tracks: list[_Track],
    first: Int[np.ndarray, " L"],
    second: Int[np.ndarray, " L"],
) -> Float[np.ndarray, " L"]:
    """Return minus the logarithm of how likely a track leads to another; inf where it cannot.

    It is the density of a normal distribution over the floor around where the first would be had
    both gone on as they went, whose deviation grows with the frames between.
    """
    end = np.array([track.rows[-1] for track in tracks])[first]
    start = np.array([track.rows[0] for track in tracks])[second]
    gap = bodies.frame[start] - bodies.frame[end]
    leaving = np.stack([_velocity(bodies, track.rows[-_STEADY:]) for track in tracks])[first]
    coming = np.stack([_velocity(bodies, track.rows[:_STEADY]) for track in tracks])[second]
    frames = np.minimum(gap, _STEADY)[:, None]
    moved = (leaving + coming) / 2 * frames
    nearest = np.minimum(
        _distances(bodies, end, start),
        _distances(bodies, end, start, moved),
    )
    deviation = np.minimum(_REST + _WANDER * gap, _ANYWHERE)
    same = np.array(
        [
            _same_identity(bodies.identity[[a]], bodies.identity[[b]])[0, 0]
            for a, b in zip(end, start, strict=True)
        ]
    )
    cost = (nearest / deviation) ** 2 / 2 + 2 * np.log(deviation) - _SAME_WORTH * same
    return np.where(nearest <= _reach(gap), cost, np.inf)


def _velocity(bodies: Bodies, rows: Int[np.ndarray, " N"]) -> Float[np.ndarray, " 3"]:
    """Return by how much a body moves in a frame."""
    frames = bodies.frame[rows[-1]] - bodies.frame[rows[0]]
    return _displacement(bodies, rows[:1], rows[-1:])[0] / max(int(frames), 1)


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
