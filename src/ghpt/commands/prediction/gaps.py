"""Filling and smoothing, on request alone, and marked.

Nothing is invented outside of what was observed.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.signal import butter, sosfiltfilt

from ghpt.commands.prediction.shards import Shards
from ghpt.errors import GhptConfigError, check
from ghpt.export.stream import Chunks
from ghpt.files import allocate
from ghpt.reconstruction import Reconstruction, State

OWN = "trajectory"
"""The interpolation that takes the points of a trajectory, which is known in gaps too."""
_ORDER = 2
"""Of the filter in one direction; forwards and backwards it is twice that."""


@dataclass(frozen=True)
class Gaps:
    """What is done to a joint's path over the frames.

    ``longest``: gaps of at most so many frames are filled between the frames with a position on
    both sides (None: none). ``interpolation``: ``pchip``, ``linear``, or ``trajectory``, which is
    what the estimator itself has there. ``cut_off_hz``: of a zero-phase
    Butterworth low-pass filter of fourth order over every run of frames with a position (None: no
    filter), which takes ``rate_hz``.
    """

    longest: int | None
    interpolation: str
    cut_off_hz: float | None
    rate_hz: float | None

    def __post_init__(self) -> None:
        kinds = ("pchip", "linear", OWN)
        problem = f"is {self.interpolation!r}"
        check(self.interpolation in kinds, "interpolation", problem, f"Existing: {kinds}.")
        if self.cut_off_hz is None:
            return
        rate = _known_rate("smooth", self.rate_hz, "Give rate_hz=60, say.")
        hint = f"Give more than 0 and less than half the frame rate of {rate:g} Hz."
        check(0 < self.cut_off_hz < rate / 2, "smooth", f"is {self.cut_off_hz:g} Hz", hint)

    @property
    def changes_nothing(self) -> bool:
        return self.longest is None and self.cut_off_hz is None

    def __call__(
        self,
        frame: Int[np.ndarray, " T"],
        points: Float[np.ndarray, "T 3"],
        state: Int[np.ndarray, " T"],
    ) -> tuple[Float[np.ndarray, "T 3"], Int[np.ndarray, " T"]]:
        """Return one joint's path, filled and smoothed, and its states.

        Frames without a position keep their reason.
        """
        step = frame_step(frame)
        if self.longest is not None:
            points, state = self._fill(frame, points, state, step, self.longest)
        if self.cut_off_hz is not None:
            points = self._smooth(frame, points, state <= State.FILLED, step)
        return points, state

    def _fill(
        self,
        frame: Int[np.ndarray, " T"],
        points: Float[np.ndarray, "T 3"],
        state: Int[np.ndarray, " T"],
        step: int,
        longest: int,
    ) -> tuple[Float[np.ndarray, "T 3"], Int[np.ndarray, " T"]]:
        placed = state <= State.SUPPORTED
        observed = np.flatnonzero(placed)
        following = np.searchsorted(observed, np.arange(len(frame)))
        inside = (following > 0) & (following < len(observed))
        missing = ~placed
        rows = np.flatnonzero(inside & missing)
        after = following[rows]
        gap = frame[observed[after]] - frame[observed[after - 1]]
        rows = rows[gap <= (longest + 1) * step]
        points = points.copy()
        state = state.copy()
        if self.interpolation == OWN:
            state[rows] = State.FILLED
        elif len(rows):
            times = frame.astype(np.float64)
            known = points[observed].astype(np.float64)
            points[rows] = _interpolate(times[observed], known, times[rows], self.interpolation)
            state[rows] = State.FILLED
        return points, state

    def _smooth(
        self,
        frame: Int[np.ndarray, " T"],
        points: Float[np.ndarray, "T 3"],
        has_position: Bool[np.ndarray, " T"],
        step: int,
    ) -> Float[np.ndarray, "T 3"]:
        sections = butter(_ORDER, self.cut_off_hz, fs=self.rate_hz, output="sos")
        points = points.copy()
        for run in unbroken_runs(frame, has_position, step):
            if len(run) > 1:
                padding = min(3 * (_ORDER + 1), len(run) - 1)
                path = points[run].astype(np.float64)
                points[run] = sosfiltfilt(sections, path, axis=0, padlen=padding)
        return points


def gap_frames(fill: int | str | None, rate_hz: float | None) -> int | None:
    """Return the longest gap in frames, of ``6`` or of seconds as ``0.1s``.

    Raises GhptConfigError.
    """
    hint = "Give frames (fill=6) or seconds (fill=0.1s)."
    if fill is None:
        return None
    if isinstance(fill, int) and not isinstance(fill, bool):
        check(fill >= 1, "fill", f"is {fill}", hint)
        return fill
    seconds = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?s", str(fill))
    if seconds is None:
        raise GhptConfigError("fill", f"is {fill!r}", hint)
    rate = _known_rate("fill", rate_hz, "Give rate_hz=60, say, or frames: fill=6.")
    frames = int(float(seconds[1]) * rate + 1e-9)
    check(frames >= 1, "fill", f"is less than a frame at {rate:g} Hz", hint)
    return frames


def _known_rate(key: str, rate_hz: float | None, hint: str) -> float:
    """Return the frame rate. Raises GhptConfigError for ``key`` unless it is one."""
    rate = rate_hz or math.nan
    check(0 < rate < math.inf, key, "needs the frame rate, which the files do not tell", hint)
    return rate


def frame_step(frame: Int[np.ndarray, " T"]) -> int:
    """Return the median difference of the numbers of successive frames."""
    return int(np.median(np.diff(frame))) if len(frame) > 1 else 1


def unbroken_runs(
    frame: Int[np.ndarray, " T"], has_position: Bool[np.ndarray, " T"], step: int
) -> list[Int[np.ndarray, " N"]]:
    """Return the rows of each unbroken run of frames with a position.

    A frame number that is left out breaks a run.
    """
    rows = np.flatnonzero(has_position)
    broken = (np.diff(rows) > 1) | (np.diff(frame[rows]) > step)
    runs = np.split(rows, np.flatnonzero(broken) + 1)
    return [run for run in runs if len(run)]


def _interpolate(
    x: Float[np.ndarray, " N"], y: Float[np.ndarray, "N 3"], at: Float[np.ndarray, " M"], kind: str
) -> Float[np.ndarray, "M 3"]:
    if kind == "pchip":
        return PchipInterpolator(x, y, axis=0)(at)
    return np.stack([np.interp(at, x, y[:, i]) for i in range(3)], axis=-1)


@contextmanager
def _scratch(folder: Path, dtype: str, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Yield an array of zeros in a nameless file of ``folder``.

    Raises OSError if the disk lacks the space.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    with tempfile.TemporaryFile(dir=folder) as handle:
        allocate(handle, size, folder)
        yield np.memmap(handle, dtype, "r+", shape=shape)


@contextmanager
def apply_gaps(gaps: Gaps, shards: Shards, joints: int, folder: Path) -> Iterator[Chunks]:
    """Yield the shards as they are to be written: as they are, or filled and smoothed.

    Joint by joint, each over all frames, so that no border between chunks shows: memory holds one
    joint's path, the others are in a nameless temporary file in ``folder``. Raises OSError if the
    disk lacks the space for it.
    """
    if gaps.changes_nothing:
        yield shards.chunks
        return
    frames = shards.frames
    with (
        _scratch(folder, "<f8", (joints, frames, 3)) as points,
        _scratch(folder, "|i1", (joints, frames)) as state,
    ):
        frame = np.zeros(frames, np.int64)
        for shard, part in enumerate(shards.chunks()):
            rows = _as_slice(shards.rows(shard))
            frame[rows] = part.frame.numpy()
            points[:, rows] = part.points.numpy().transpose(1, 0, 2)
            state[:, rows] = part.state.numpy().T
        for joint in range(joints):
            path = np.array(points[joint])
            points[joint], state[joint] = gaps(frame, path, np.array(state[joint]))

        def chunks() -> Iterator[Reconstruction]:
            for shard, part in enumerate(shards.chunks()):
                rows = _as_slice(shards.rows(shard))
                new_points = np.ascontiguousarray(points[:, rows].transpose(1, 0, 2))
                new_state = np.ascontiguousarray(state[:, rows].T)
                yield replace(
                    part, points=torch.from_numpy(new_points), state=torch.from_numpy(new_state)
                )

        yield chunks


def _as_slice(rows: range) -> slice:
    return slice(rows.start, rows.stop)
