"""A sequence whose views' frames were taken at other times than their numbers say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.clock import Clock
from ghpt.data.people.detections import Detections
from ghpt.data.people.sequence import KeyPointSource, Rows, Sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

_Read = Callable[[Rows], KeyPoints]
_EXACT = 1e-6
"""Frames: a moment that is no farther from a frame is that frame's."""


@dataclass(frozen=True)
class RetimedKeyPoints:
    """Key points of the views at the rig's frames, linearly interpolated between a view's own.

    A joint exists where both of the neighbouring frames have it; its confidence is the less of
    theirs.
    """

    source: KeyPointSource
    own_frame: Int[np.ndarray, " S"]
    """The numbers of the frames of ``source``."""
    frame: Int[np.ndarray, " T"]
    """The numbers of the rig's frames."""
    clock: Clock

    def undistorted(self, rows: Rows) -> KeyPoints:
        return self._interpolate(rows, self.source.undistorted)

    def detected(self, rows: Rows) -> KeyPoints:
        return self._interpolate(rows, self.source.detected)

    def _interpolate(self, rows: Rows, read: _Read) -> KeyPoints:
        moment = moments(self.frame[rows], self.clock)
        before = np.floor(moment + _EXACT).astype(np.int64)
        part = (moment - before).clip(0)
        part = np.where(part <= _EXACT, 0.0, part)
        row_before, has_before = rows_of(self.own_frame, before)
        row_after, has_after = rows_of(self.own_frame, before + (part > 0))
        needed = np.unique(np.concatenate([row_before, row_after]))
        points = read(needed)
        first = _select(points, np.searchsorted(needed, row_before), has_before)
        second = _select(points, np.searchsorted(needed, row_after), has_after)
        valid = first.valid & second.valid
        weight = part[..., None, None].astype(points.pixels.dtype)
        pixels = (1 - weight) * first.pixels + weight * second.pixels
        confidence = np.minimum(first.confidence, second.confidence)
        return KeyPoints(
            pixels=np.where(valid[..., None], pixels, 0).astype(points.pixels.dtype),
            confidence=np.where(valid, confidence, 0).astype(points.confidence.dtype),
            valid=valid,
        )


def moments(frame: Int[np.ndarray, " T"], clock: Clock) -> Float[np.ndarray, "T V"]:
    """Return the views' own frames, which need not be whole, at frames of the rig."""
    return frame[:, None] * np.array(clock.rate) + np.array(clock.shift)


def rows_of(
    own_frame: Int[np.ndarray, " S"], wanted: Int[np.ndarray, "T V"]
) -> tuple[Int[np.ndarray, "T V"], Bool[np.ndarray, "T V"]]:
    """Return the rows of wanted frames, and which of them exist."""
    rows = np.searchsorted(own_frame, wanted).clip(0, len(own_frame) - 1)
    return rows, own_frame[rows] == wanted


def retime(sequence: Sequence, clock: Clock) -> Sequence:
    """Return the sequence in the time of a rig.

    Its frames are those numbers of the recording of which two views or more have a frame. Raises
    GhptDataError for a clock of another number of views, and if there is no such frame.
    """
    if clock.is_synchronised:
        return sequence
    views = len(sequence.cameras)
    if len(clock) != views:
        problem = f"is of {len(clock)} views, and the recording has {views}"
        raise GhptDataError(sequence.source, "time", problem, "Give a shift for each view.")
    own_frame = sequence.frame
    moment = moments(own_frame, clock)
    inside = (moment >= own_frame[0]) & (moment <= own_frame[-1])
    kept = own_frame[inside.sum(-1) >= 2]
    if not len(kept):
        problem = "at no frame of the recording are there two views"
        hint = "Check the shifts, and that the views were recorded at one time."
        raise GhptDataError(sequence.source, "time", problem, hint)
    points = RetimedKeyPoints(sequence.points, own_frame, kept, clock)
    return replace(sequence, frame=kept, points=points)


def _select(
    points: KeyPoints, rows: Int[np.ndarray, "T V"], exists: Bool[np.ndarray, "T V"]
) -> KeyPoints:
    chosen = points[rows, np.arange(rows.shape[1])]
    valid = chosen.valid & exists[..., None]
    return KeyPoints(chosen.pixels, chosen.confidence, valid)


def shift_detections(people: Detections, by: Int[np.ndarray, " V"]) -> Detections:
    """Return everybody with the frames of view v counted ``by[v]`` lower, so that its frame
    n + by[v] is of the others' frame n.
    """
    number = people.frame[people.row] - by[people.view]
    frame = np.unique(number)
    return replace(people, frame=frame, row=np.searchsorted(frame, number))
