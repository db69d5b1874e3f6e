"""What the doctor looks at: a choice of frames, each with the frames around it, as the detector
gave them.
"""

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
    extrinsics, and with fewer than two views.
    """
    cameras = sequence.cameras
    if len(cameras) < 2:
        problem = f"{len(cameras)} with a camera"
        raise GhptDataError(sequence.source, "views", problem, "Give two views or more.")
    if not cameras.calibrated:
        hint = "Calibrate them first: python calibrate.py --help"
        raise GhptDataError(
            cameras.path, "extrinsics", "are missing: there is nothing to check", hint
        )
    points = sequence.detected()
    return choose(
        cameras.names,
        points.pixels,
        points.valid,
        sequence.frame,
        frames,
        max_shift,
        sequence.source,
    )


def choose(
    names: tuple[str, ...],
    pixels: Float[np.ndarray, "T V J 2"],
    valid: Bool[np.ndarray, "T V J"],
    frame: Int[np.ndarray, " T"],
    frames: int,
    max_shift: int,
    where: str,
) -> Evidence:
    """The evidence of a recording's detected pixels; a frame number that is left out is a gap in
    time.
    """
    usable = np.flatnonzero((valid.sum(1) >= 2).sum(-1) >= _LEAST_JOINTS)
    if not len(usable):
        hint = "Check that the views show the same person at the same time."
        raise GhptDataError(
            where, "key points", f"no frame has {_LEAST_JOINTS} joints in two views", hint
        )
    rows = usable[
        np.unique(np.linspace(0, len(usable) - 1, min(frames, len(usable))).round().astype(int))
    ]
    max_shift = min(max_shift, len(usable) // 4)
    valid = valid & np.isfinite(pixels).all(-1)
    order = (2, 0, 1, 3)

    def around(
        moments: Float[np.ndarray, " F"], views: int | slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """What is nearest to the moments (numbers of frames) and their neighbours: [S, F, ...]."""
        wanted = moments[None] + np.arange(-max_shift, max_shift + 1)[:, None]
        index = np.searchsorted(frame, np.rint(wanted)).clip(0, len(frame) - 1)
        there = (np.abs(frame[index] - wanted) <= _NEAR)[
            (..., *[None] * (valid[:, views].ndim - 1))
        ]
        shown = valid[:, views][index] & there
        return np.where(shown[..., None], pixels[:, views][index], 0.0), shown

    def at_rate(view: int, ratio: float) -> tuple[Tensor, Tensor]:
        values, shown = around(frame[0] + ratio * (frame[rows] - frame[0]), view)
        return torch.from_numpy(values).double(), torch.from_numpy(shown)

    values, shown = around(frame[rows].astype(np.float64), slice(None))
    return Evidence(
        names,
        torch.from_numpy(values.transpose(*order, 4)).double(),
        torch.from_numpy(shown.transpose(*order).copy()),
        torch.from_numpy(frame[rows].astype(np.int64)),
        at_rate,
    )


def moment(
    frame: Int[np.ndarray, " T"], rate: float, shift: int
) -> tuple[Int[np.ndarray, " T"], Bool[np.ndarray, " T"]]:
    """The rows of a view at the others' frames, and where it has one: for a view whose numbers
    count ``rate`` times as fast and are ``shift`` later.
    """
    wanted = frame[0] + rate * (frame - frame[0]) + shift
    rows = np.searchsorted(frame, np.rint(wanted)).clip(0, len(frame) - 1)
    return rows, np.abs(frame[rows] - wanted) <= _NEAR
