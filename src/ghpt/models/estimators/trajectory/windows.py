"""Windows of a recording that depend on its frame numbers alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.models.estimators.trajectory.priors import NOMINAL_RATE, TimeAxis

Rows = Int[np.ndarray, " N"]


@dataclass(frozen=True)
class Clock:
    """How the frame numbers of a recording tell the time."""

    step: int
    """Largest number that divides the distances between frames of one piece."""
    rate_hz: float
    """Steps per second."""
    longest_gap: int
    """Frames that are farther apart, in frame numbers, are of two pieces."""

    @staticmethod
    def of_frames(frame: Rows, rate_hz: float | None, longest_gap_s: float) -> Clock:
        """Return the clock of a recording; one of unknown rate is taken to have the nominal one.

        Where frame numbers rise by more than one as a rule, ``rate_hz`` is that of the frames.
        """
        steps = np.diff(frame)
        usual = int(np.median(steps)) if len(steps) else 1
        per_number = (rate_hz or NOMINAL_RATE) * max(usual, 1)
        longest = max(round(longest_gap_s * per_number), usual, 1)
        step = int(np.gcd.reduce(steps[steps <= longest])) if (steps <= longest).any() else 1
        return Clock(max(step, 1), per_number / max(step, 1), longest)

    def axis(self, frame: Rows) -> tuple[Rows, TimeAxis]:
        """Return the place of each frame on an axis without gaps, and that axis.

        A frame number that is left out within a piece is a frame in which nothing is seen.
        """
        steps = np.diff(frame)
        apart = np.where(steps <= self.longest_gap, steps // self.step, 1)
        place = np.concatenate([[0], np.cumsum(apart)])
        joined = np.ones(int(place[-1]) + 1, dtype=bool)
        joined[place[:-1][steps > self.longest_gap]] = False
        joined[-1] = False
        return place, TimeAxis(self.rate_hz, torch.from_numpy(joined))


@dataclass(frozen=True)
class Window:
    """Successive frames that are solved together."""

    rows: Rows
    """Of the recording."""
    core: Bool[np.ndarray, " N"]
    """The frames whose result counts: every frame of a recording is in the core of one window."""


@dataclass(frozen=True)
class Windows:
    """Windows of ``length`` steps that begin at multiples of it, with ``overlap`` steps around."""

    length: int
    overlap: int

    def __post_init__(self) -> None:
        check_positive(length=self.length, overlap=self.overlap)

    def covering(self, frame: Rows, rows: Rows, clock: Clock) -> Iterator[Window]:
        """Yield the windows whose cores hold these rows of a recording, in order."""
        length = self.length * clock.step
        overlap = self.overlap * clock.step
        for number in np.unique(frame[rows] // length):
            start = number * length
            first, last = np.searchsorted(frame, (start - overlap, start + length + overlap))
            within = np.arange(first, last)
            core = (frame[within] >= start) & (frame[within] < start + length)
            yield Window(within, core)


RUN = 100
"""Successive frames of which a sample of a recording is made, and which are evaluated together."""


def spread_runs(frames: int, total: int, length: int = RUN) -> Rows:
    """Return at most about ``total`` of the rows of a recording: runs of ``length``, spread."""
    if frames <= total:
        return np.arange(frames)
    length = min(length, total)
    count = max(1, total // length)
    starts = np.linspace(0, frames - length, count).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))


def dense(values: Tensor, place: Rows, length: int) -> Tensor:
    """Return values [N ...] at their places among ``length`` frames; zeros elsewhere."""
    if len(values) == length:
        return values
    result = values.new_zeros(length, *values.shape[1:])
    result[torch.from_numpy(place)] = values
    return result
