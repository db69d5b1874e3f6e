"""What detectors found: everybody in every view, with the joints and pixels of the files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.formats.skeletons import joints_of, recognise, skeleton_of
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.skeleton import Skeleton

MOST_PEOPLE = 64
"""In a view of a frame; more are no people."""
_MOST_VALUES = 1 << 31
_FARTHEST = 1e6
"""Pixels."""
_NUMBERS = {int, float, type(None)}


@dataclass(frozen=True)
class Detections:
    """N detections of people in V views of T frames, in the pixels of the images as they were."""

    path: str
    views: tuple[str, ...]
    """The views as the files call them."""
    joints: tuple[str, ...]
    """The K joints of the detector, in the words of ``ghpt.data.formats.skeletons``; empty while
    they are not known, in the detections of one view that are to be merged.
    """
    frame: Int[np.ndarray, " T"]
    """Frame numbers, rising, of all views together."""
    row: Int[np.ndarray, " N"]
    """Index into ``frame`` of each detection."""
    view: Int[np.ndarray, " N"]
    """Index into ``views``; detections are in the order of views, then of frames."""
    identity: Int[np.ndarray, " N"]
    """Number that a tracker of the view gave the person, -1 where none did. It means nothing in
    another view.
    """
    points: KeyPoints
    """[N K]."""
    rate_hz: float | None = None
    own_skeleton: Skeleton | None = None
    """The skeleton with these joints that was asked for; None: what their names tell."""
    normalised: bool = False
    """Pixels are shares of the image's width and height; see `scale_to_images`."""

    def __len__(self) -> int:
        return len(self.row)

    @property
    def skeleton(self) -> Skeleton:
        """What is known of the joints. Raises GhptDataError for a name that is there twice."""
        return self.own_skeleton or skeleton_of(self.path, self.joints)

    @classmethod
    def of_person(
        cls,
        path: str | Path,
        views: Sequence[str],
        joints: Sequence[str],
        frame: Int[np.ndarray, " T"],
        points: KeyPoints,
        rate_hz: float | None = None,
    ) -> Detections:
        """Return the detections of one person whose ``points`` are [T V K]."""
        view, row = np.nonzero(points.valid.any(-1).T)
        return cls(
            path=str(path),
            views=tuple(views),
            joints=tuple(joints),
            frame=frame,
            row=row,
            view=view,
            identity=np.full(len(row), -1),
            points=points[row, view],
            rate_hz=rate_hz,
        )

    def above(self, least_confidence: float) -> Detections:
        """Return the detections without key points below this confidence, nor who has no other."""
        points = self.points.above(least_confidence)
        kept = np.flatnonzero(points.valid.any(-1) | ~self.points.valid.any(-1))
        return replace(
            self,
            row=self.row[kept],
            view=self.view[kept],
            identity=self.identity[kept],
            points=points[kept],
        )

    def counts(self) -> Int[np.ndarray, "T V"]:
        """Return the number of people in each frame of each view."""
        cell = self.row * len(self.views) + self.view
        found = np.bincount(cell, minlength=len(self.frame) * len(self.views))
        return found.reshape(len(self.frame), len(self.views))

    def crowded_frames(self) -> dict[str, int]:
        """Return the number of frames with several people, of each view that has any."""
        frames = (self.counts() > 1).sum(0).tolist()
        return {view: count for view, count in zip(self.views, frames, strict=True) if count}

    def first_of(self, indices: Int[np.ndarray, " M"]) -> Int[np.ndarray, "T V"]:
        """Return the first of these detections in each frame and view, -1 where there is none."""
        chosen = np.full((len(self.frame), len(self.views)), -1)
        backwards = indices[::-1]
        chosen[self.row[backwards], self.view[backwards]] = backwards
        return chosen

    def first(self) -> Int[np.ndarray, "T V"]:
        """Return the first detection of each frame and view, -1 where there is none."""
        return self.first_of(np.arange(len(self)))


def detections_in_view(
    path: Path,
    view: str,
    frames: Sequence[int] | Int[np.ndarray, " F"],
    number: Int[np.ndarray, " N"],
    values: Float[np.ndarray, "N K 3"],
    identity: Int[np.ndarray, " N"] | None = None,
    joints: tuple[str, ...] = (),
) -> Detections:
    """Return what one view's files hold, for ``merge_views``.

    ``frames``: numbers of the frames that were looked at, those without anybody among them.
    ``number``: that of each detection's frame, not falling. ``values``: x, y, confidence; a joint
    whose confidence is 0 or less is not valid. ``identity``: the numbers that people have; they
    count where they can be a tracker's (`_tracker_numbers`).
    """
    frame = np.unique(np.array(frames, np.int64))
    points = KeyPoints(values[..., :2], values[..., 2].clip(0, 1), values[..., 2] > 0)
    return Detections(
        path=str(path),
        views=(view,),
        joints=joints,
        frame=frame,
        row=np.searchsorted(frame, number),
        view=np.zeros(len(number), np.int64),
        identity=np.full(len(number), -1)
        if identity is None
        else _tracker_numbers(number, identity),
        points=points,
    )


def _tracker_numbers(
    number: Int[np.ndarray, " N"], identity: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Return the numbers of people in one view's frames; all are -1 where no tracker gave them.

    1. A number that is twice in a frame is nobody's.
    2. One number for everybody says nothing.
    3. Numbers that count the people of each frame from 0 on change when somebody comes or goes.
    """
    named = identity >= 0
    pairs = np.stack([number, identity], 1)[named]
    twice = len(np.unique(pairs, axis=0)) < len(pairs)
    distinct = len(np.unique(identity[named]))
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    place = np.arange(len(number)) - np.repeat(starts, np.diff(starts, append=len(number)))
    leaves = len(np.unique(np.diff(starts, append=len(number)))) > 1
    if twice or distinct < 2 or (leaves and (identity == place).all()):
        return np.full(len(identity), -1)
    return identity


def merge_views(path: Path, found: Sequence[Detections], skeleton: str | None) -> Detections:
    """Return the detections of several views as one.

    ``skeleton`` overrules the names of the joints in the files; where neither names them, the
    skeleton is recognised. Raises GhptDataError where the views do not fit together, or the
    skeleton is not known.
    """
    count = _joint_count(path, found)
    frame = np.unique(np.concatenate([view.frame for view in found]))
    values = len(frame) * len(found) * count
    if values > _MOST_VALUES:
        raise GhptDataError(path, "", f"holds {values} joints", "Split the recording.")
    _check_common_frames(path, found)
    full = [view for view in found if len(view)]
    points = KeyPoints(
        pixels=np.concatenate([view.points.pixels for view in full]),
        confidence=np.concatenate([view.points.confidence for view in full]),
        valid=np.concatenate([view.points.valid for view in full]),
    )
    joints = found[0].joints
    if skeleton is not None or not joints:
        skeleton = skeleton or recognise(path, points.pixels, points.valid)
        joints = joints_for(path, skeleton, count)
    return Detections(
        path=str(path),
        views=tuple(view.views[0] for view in found),
        joints=joints,
        frame=frame,
        row=np.concatenate([np.searchsorted(frame, view.frame[view.row]) for view in full]),
        view=np.repeat(np.arange(len(found)), [len(view) for view in found]),
        identity=np.concatenate([view.identity for view in full]),
        points=points,
    )


def _joint_count(path: Path, found: Sequence[Detections]) -> int:
    counts = sorted({view.points.valid.shape[1] for view in found if len(view)})
    if len(counts) == 1:
        return counts[0]
    problem = "is empty"
    if counts:
        problem = f"the views have people of {' and '.join(map(str, counts))} joints"
    raise GhptDataError(path, "people", problem, "Detect all views with one model.")


def _check_common_frames(path: Path, found: Sequence[Detections]) -> None:
    common = set.intersection(*(set(view.frame.tolist()) for view in found))
    if common or len(found) == 1:
        return
    ranges = []
    for view in found:
        frames = f"{view.frame[0]} to {view.frame[-1]}" if len(view.frame) else "none"
        ranges.append(f"{view.views[0]} {frames}")
    problem = f"no frame is in all views ({', '.join(ranges)})"
    hint = "Number the frames of synchronised cameras alike."
    raise GhptDataError(path, "frame numbers", problem, hint)


def check_people(path: Path, field: str, count: int) -> None:
    """Raise GhptDataError for more than ``MOST_PEOPLE`` people in a view of a frame."""
    if count > MOST_PEOPLE:
        problem = f"{count} people are in a frame"
        raise GhptDataError(path, field, problem, f"At most {MOST_PEOPLE} are read.")


def joint_values(
    path: Path, field: str, flat: object, per_joint: int = 3
) -> Float[np.ndarray, "K per_joint"]:
    """Return a flat list of ``per_joint`` numbers for each joint as an array.

    A joint with NaN or null among them is missing: it is all zeros. Raises GhptDataError for
    anything else, and for numbers from 1e6 on.
    """
    numbers = isinstance(flat, list) and _NUMBERS.issuperset(map(type, flat))
    if not isinstance(flat, list) or not numbers or len(flat) % per_joint:
        words = "x, y, confidence" if per_joint == 3 else "x, y"
        raise GhptDataError(path, field, f"is not a list of {words}", "Detect this frame again.")
    try:
        joints = np.array(flat, dtype=np.float64).reshape(-1, per_joint)
    except OverflowError:
        joints = np.full((1, per_joint), np.inf)
    joints[np.isnan(joints).any(1)] = 0
    if not (np.abs(joints) < _FARTHEST).all():
        raise GhptDataError(path, field, "holds a number beyond 1e6", "Detect this frame again.")
    return joints


def joints_for(where: Path, skeleton: str, count: int) -> tuple[str, ...]:
    """Return the names of the skeleton's joints. Raises GhptDataError unless they are ``count``."""
    joints = joints_of(where, skeleton)
    if len(joints) != count:
        problem = f"{skeleton} has {len(joints)} joints and the key points have {count}"
        raise GhptDataError(where, "skeleton", problem, "Name the skeleton of these key points.")
    return joints
