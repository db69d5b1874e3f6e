"""What the camera check looks at: some frames, each with the frames around it, as detected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError

_LEAST_JOINTS = 6
"""Seen in two views for a frame to be looked at."""
_NEAR = 0.25
"""Frames: a view of another rate has no frame of a moment that is farther from its nearest one."""
AtRate = Callable[[int, float], tuple[Float[Tensor, "S F J 2"], Bool[Tensor, "S F J"]]]


@dataclass(frozen=True)
class Evidence:
    """F frames of V views of one person, each with its 2N neighbours in time (S = 2N + 1, the frame
    itself at N).
    """

    names: tuple[str, ...]
    pixels: Float[Tensor, "V S F J 2"]
    """As detected, through the lens."""
    valid: Bool[Tensor, "V S F J"]
    frame: Int[Tensor, " F"]
    at_rate: AtRate | None = None
    """The pixels of a view, and what is seen, if its frame numbers count ``ratio`` times as fast as
    the others'; None where the recording is not at hand.
    """

    @property
    def max_shift(self) -> int:
        """N: the largest shift in time that can be tried, in frames."""
        return (self.valid.shape[1] - 1) // 2


def gather(sequence: Sequence, frames: int, max_shift: int) -> Evidence:
    """Return at most ``frames`` frames, evenly spread over those in which people are seen.

    ``max_shift``: the largest shift, at most a quarter of the frames. Raises GhptDataError without
    extrinsics, with fewer than two views, and if no frame shows enough.
    """
    cameras = sequence.cameras
    if len(cameras) < 2:
        problem = f"{len(cameras)} with a camera"
        raise GhptDataError(sequence.source, "views", problem, "Give two views or more.")
    if not cameras.calibrated:
        problem = "are missing: there is nothing to check"
        hint = "Calibrate them first: python calibrate.py --help"
        raise GhptDataError(cameras.path, "extrinsics", problem, hint)
    return gather_rows(sequence, np.arange(len(sequence)), frames, max_shift)


def gather_rows(
    sequence: Sequence, rows: Int[np.ndarray, " N"], frames: int, max_shift: int
) -> Evidence:
    """Return the evidence of some frames of a sequence, as `gather` does of all."""
    points = sequence.detected(rows)
    pixels = points.pixels.astype(np.float64)
    names = sequence.cameras.names
    valid = np.array(points.valid)
    return choose(names, pixels, valid, sequence.frame[rows], frames, max_shift, sequence.source)


def choose(
    names: tuple[str, ...],
    pixels: Float[np.ndarray, "T V J 2"],
    valid: Bool[np.ndarray, "T V J"],
    frame: Int[np.ndarray, " T"],
    frames: int,
    max_shift: int,
    where: str,
) -> Evidence:
    """Return the evidence of a recording's detected pixels.

    A frame number that is left out is a gap in time. Raises GhptDataError, about ``where``, if no
    frame shows enough joints in two views.
    """
    seen_twice = valid.sum(1) >= 2
    usable = np.flatnonzero(seen_twice.sum(-1) >= _LEAST_JOINTS)
    if not len(usable):
        problem = f"no frame has {_LEAST_JOINTS} joints in two views"
        hint = "Check that the views show the same person at the same time."
        raise GhptDataError(where, "key points", problem, hint)
    spread = np.linspace(0, len(usable) - 1, min(frames, len(usable)))
    rows = usable[np.unique(spread.round().astype(int))]
    recording = _Recording(pixels, valid & np.isfinite(pixels).all(-1), frame)
    offsets = _offsets(min(max_shift, len(usable) // 4))
    all_views = np.arange(len(names))

    def at_rate(view: int, ratio: float) -> tuple[Tensor, Tensor]:
        moments = frame[0] + ratio * (frame[rows] - frame[0])
        values, shown = recording.around(moments, offsets, np.array([view]))
        return torch.from_numpy(values[:, :, 0]).double(), torch.from_numpy(shown[:, :, 0].copy())

    values, shown = recording.around(frame[rows].astype(np.float64), offsets, all_views)
    return Evidence(
        names,
        torch.from_numpy(values.transpose(2, 0, 1, 3, 4)).double(),
        torch.from_numpy(shown.transpose(2, 0, 1, 3).copy()),
        torch.from_numpy(frame[rows].astype(np.int64)),
        at_rate,
    )


def _offsets(max_shift: int) -> Int[np.ndarray, " S"]:
    return np.arange(-max_shift, max_shift + 1)


@dataclass(frozen=True)
class _Recording:
    pixels: Float[np.ndarray, "T V J 2"]
    valid: Bool[np.ndarray, "T V J"]
    frame: Int[np.ndarray, " T"]

    def around(
        self,
        moments: Float[np.ndarray, " F"],
        offsets: Int[np.ndarray, " S"],
        views: Int[np.ndarray, " v"],
    ) -> tuple[Float[np.ndarray, "S F v J 2"], Bool[np.ndarray, "S F v J"]]:
        """Return the key points nearest to the moments (numbers of frames) and their neighbours."""
        wanted = moments[None] + offsets[:, None]
        rows, exists = _nearest(self.frame, wanted)
        shown = self.valid[:, views][rows] & exists[..., None, None]
        return np.where(shown[..., None], self.pixels[:, views][rows], 0.0), shown


def moment(
    frame: Int[np.ndarray, " T"], rate: float, shift: int
) -> tuple[Int[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """Return the rows of a view at the others' frames, and where it has one.

    The view's numbers count ``rate`` times as fast and are ``shift`` later.
    """
    return _nearest(frame, frame[0] + rate * (frame - frame[0]) + shift)


def _nearest(
    frame: Int[np.ndarray, " T"], wanted: Float[np.ndarray, "*N"]
) -> tuple[Int[np.ndarray, "*N"], Bool[np.ndarray, "*N"]]:
    rows = np.searchsorted(frame, np.rint(wanted)).clip(0, len(frame) - 1)
    return rows, np.abs(frame[rows] - wanted) <= _NEAR
