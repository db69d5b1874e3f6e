"""What a detector found: everybody in every view, or one person followed through all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.formats.skeletons import joints_of, recognise
from ghpt.errors import GhptDataError

MOST_PEOPLE = 64
"""In a view of a frame; more are no people."""
_MOST_VALUES = 1 << 31
_FARTHEST = 1e6
"""Pixels."""


@dataclass(frozen=True)
class KeyPoints:
    """T frames of V views of one person, in the pixels of the images as they were (lens distortion
    and all).
    """

    path: str
    views: tuple[str, ...]
    """The views as the files call them."""
    joints: tuple[str, ...]
    """The K joints of the detector, in the words of ``ghpt.data.formats.skeletons``."""
    frame: Int[np.ndarray, " T"]
    """Frame numbers, rising; one that a view lacks is there with nothing seen."""
    key_points: Float[np.ndarray, "T V K 2"]
    confidence: Float[np.ndarray, "T V K"]
    """In [0, 1]; 1 where the detector gives none."""
    valid: Bool[np.ndarray, "T V K"]
    rate_hz: float | None
    several: tuple[int, ...]
    """For each view the number of frames with more than one person, of whom one was followed."""


@dataclass(frozen=True)
class Detections:
    """N detections of people in V views of T frames, in the pixels of the images as they were."""

    path: str
    views: tuple[str, ...]
    joints: tuple[str, ...]
    frame: Int[np.ndarray, " T"]
    """Frame numbers, rising, of all views together."""
    row: Int[np.ndarray, " N"]
    """Index into ``frame`` of each detection."""
    view: Int[np.ndarray, " N"]
    """Index into ``views``; detections are in the order of views, then of frames."""
    identity: Int[np.ndarray, " N"]
    """Number of the person, the same in all views; -1 where the files do not say."""
    key_points: Float[np.ndarray, "N K 2"]
    confidence: Float[np.ndarray, "N K"]
    valid: Bool[np.ndarray, "N K"]
    rate_hz: float | None

    def counts(self) -> Int[np.ndarray, "T V"]:
        """How many people there are."""
        place = self.row * len(self.views) + self.view
        found = np.bincount(place, minlength=len(self.frame) * len(self.views))
        return found.reshape(len(self.frame), len(self.views))

    def pick(self, chosen: Int[np.ndarray, "T V"]) -> KeyPoints:
        """The detections of these indices; -1 where nobody is taken."""
        there = chosen >= 0
        parts = []
        for values in (self.key_points, self.confidence, self.valid):
            part = np.zeros((*chosen.shape, *values.shape[1:]), values.dtype)
            part[there] = values[chosen[there]]
            parts.append(part)
        several = tuple((self.counts() > 1).sum(0).tolist())
        return KeyPoints(
            self.path, self.views, self.joints, self.frame, *parts, self.rate_hz, several
        )

    def of(self, indices: Int[np.ndarray, " M"]) -> Int[np.ndarray, "T V"]:
        """The first of these detections in each frame and view, -1 where there is none."""
        chosen = np.full((len(self.frame), len(self.views)), -1)
        chosen[self.row[indices[::-1]], self.view[indices[::-1]]] = indices[::-1]
        return chosen

    def first(self) -> Int[np.ndarray, "T V"]:
        """The first detection of each frame and view, -1 where there is none."""
        return self.of(np.arange(len(self.row)))


@dataclass(frozen=True)
class ViewDetections:
    """What one view's files hold."""

    view: str
    frames: Int[np.ndarray, " T"]
    """Numbers of the frames that were looked at, rising, those without anybody among them."""
    frame: Int[np.ndarray, " N"]
    """Number of each detection's frame, not falling."""
    values: Float[np.ndarray, "N K 3"]
    """x, y, confidence; not seen where the confidence is 0 or less."""
    identity: Int[np.ndarray, " N"]


def as_people(points: KeyPoints) -> Detections:
    """One person's key points as the only detections."""
    view, row = np.nonzero(points.valid.any(-1).T)
    values = (x[row, view] for x in (points.key_points, points.confidence, points.valid))
    return Detections(
        points.path,
        points.views,
        points.joints,
        points.frame,
        row,
        view,
        np.full(len(row), -1),
        *values,
        points.rate_hz,
    )


def gather(
    path: Path,
    found: Sequence[ViewDetections],
    joints: tuple[str, ...] | None,
    skeleton: str | None,
) -> Detections:
    """The views' detections as one; ``joints`` if the files name them, which ``skeleton``
    overrules.

    Raises GhptDataError where the views do not fit together, or the skeleton is not known.
    """
    counts = {view.values.shape[1] for view in found if len(view.values)}
    if len(counts) != 1:
        problem = (
            f"the views have people of {' and '.join(map(str, sorted(counts)))} joints"
            if counts
            else "is empty"
        )
        raise GhptDataError(path, "people", problem, "Detect all views with one model.")
    count = counts.pop()
    frame = np.unique(np.concatenate([view.frames for view in found]))
    if len(frame) * len(found) * count > _MOST_VALUES:
        raise GhptDataError(
            path, "", f"holds {len(frame) * len(found) * count} joints", "Split the recording."
        )
    common = set.intersection(*(set(view.frames.tolist()) for view in found))
    if len(found) > 1 and not common:
        ranges = ", ".join(
            f"{v.view} {v.frames[0]} to {v.frames[-1]}" if len(v.frames) else f"{v.view} none"
            for v in found
        )
        hint = "Number the frames of synchronised cameras alike."
        raise GhptDataError(path, "frame numbers", f"no frame is in all views ({ranges})", hint)
    full = [view for view in found if len(view.values)]
    values = np.concatenate([view.values for view in full])
    valid = values[..., 2] > 0
    if skeleton is not None or joints is None:
        joints = joints_for(path, skeleton or recognise(path, values[..., :2], valid), count)
    return Detections(
        path=str(path),
        views=tuple(view.view for view in found),
        joints=joints,
        frame=frame,
        row=np.concatenate([np.searchsorted(frame, view.frame) for view in full]),
        view=np.repeat(np.arange(len(found)), [len(view.values) for view in found]),
        identity=np.concatenate([view.identity for view in full]),
        key_points=values[..., :2],
        confidence=values[..., 2].clip(0, 1),
        valid=valid,
        rate_hz=None,
    )


def detections(
    path: Path,
    view: str,
    frames: Sequence[int],
    found: Sequence[tuple[int, Float[np.ndarray, "K 3"]]],
) -> ViewDetections:
    """One view's people without identities: (frame number, joints) in any order, of the frames in
    ``frames``.

    Raises GhptDataError for people of different numbers of joints, or too many of them.
    """
    count = found[0][1].shape[0] if found else 0
    odd = next((f for f in found if f[1].shape != found[0][1].shape), None)
    if odd is not None:
        problem = f"frame {odd[0]} has a person of {odd[1].shape[0]} joints, frame {found[0][0]} of {count}"
        raise GhptDataError(path, "keypoints", problem, "Detect all frames with one model.")
    numbers = np.array([frame for frame, _ in found], np.int64)
    order = np.argsort(numbers, kind="stable")
    check_people(path, "keypoints", int(np.unique(numbers, return_counts=True)[1].max(initial=0)))
    values = np.stack([joints for _, joints in found])[order] if found else np.zeros((0, 0, 3))
    return ViewDetections(
        view,
        np.unique(np.array(frames, np.int64)),
        numbers[order],
        values,
        np.full(len(numbers), -1),
    )


def check_people(path: Path, field: str, count: int) -> None:
    """Raise GhptDataError for more than ``MOST_PEOPLE`` people in a view of a frame."""
    if count > MOST_PEOPLE:
        problem = f"{count} people are in a frame"
        raise GhptDataError(path, field, problem, f"At most {MOST_PEOPLE} are read.")


def triples(
    path: Path, field: str, flat: object, per_joint: int = 3
) -> Float[np.ndarray, "K per_joint"]:
    """A list of ``per_joint`` numbers for each joint, below 1e6. Raises GhptDataError for anything
    else.
    """
    if (
        not isinstance(flat, list)
        or len(flat) % per_joint
        or not {int, float}.issuperset(map(type, flat))
    ):
        words = "x, y, confidence" if per_joint == 3 else "x, y"
        raise GhptDataError(path, field, f"is not a list of {words}", "Detect this frame again.")
    try:
        joints = np.array(flat, dtype=np.float64).reshape(-1, per_joint)
    except OverflowError:
        joints = np.full((1, per_joint), np.inf)
    if not (np.abs(joints) < _FARTHEST).all():
        raise GhptDataError(path, field, "holds a number beyond 1e6", "Detect this frame again.")
    return joints


def joints_for(where: Path, skeleton: str, count: int) -> tuple[str, ...]:
    """The names of ``count`` joints. Raises GhptDataError if the skeleton has another number of
    them.
    """
    joints = joints_of(where, skeleton)
    if len(joints) != count:
        problem = f"{skeleton} has {len(joints)} joints and the key points have {count}"
        raise GhptDataError(where, "skeleton", problem, "Name the skeleton of these key points.")
    return joints
