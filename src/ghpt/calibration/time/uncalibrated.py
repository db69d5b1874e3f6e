"""Shifts of views whose extrinsics are not known: the share of key points that one essential matrix
explains is largest where both views are of one time.
"""

from __future__ import annotations

from dataclasses import dataclass

import poselib
import torch
from jaxtyping import Int
from torch import Tensor

from ghpt.calibration.pairs import camera_dict, ransac_options
from ghpt.calibration.time.shifts import all_pairs_of
from ghpt.calibration.time.timeline import Timeline
from ghpt.errors import check_positive

_LEAST = 30
"""Correspondences for an essential matrix."""


@dataclass(frozen=True)
class UncalibratedShifts:
    """The settings of the search for shifts without extrinsics.

    ``frames``, ``fine_frames``: frames of a pair that are compared in the search and where it
    ends. ``step``: of the search, frames. ``threshold``: largest error of an inlier, sizes of the
    person. ``iterations``: of RANSAC. ``overlap``: least share of the frames that a shift leaves.
    ``apart``: frames beyond which a shift is another one. ``gap``: least difference of the shares
    of inliers of the best shift and of every other one. ``pairs``: most pairs of views.
    """

    frames: int
    fine_frames: int
    step: int
    threshold: float
    iterations: int
    overlap: float
    apart: int
    gap: float
    pairs: int

    def __post_init__(self) -> None:
        check_positive(**vars(self))

    def __call__(self, timeline: Timeline, seed: int) -> UncalibratedEstimate:
        """Return the shifts by whole frames of all views that pairs link to the first."""
        views = len(timeline.valid)
        pairs = all_pairs_of(views, self.pairs)
        found = [self.pair(timeline, a, b, seed) for a, b in pairs.tolist()]
        shift = torch.zeros(views, dtype=torch.int64)
        linked = torch.zeros(views, dtype=torch.bool)
        linked[0] = True
        gap = torch.tensor([one.gap for one in found], dtype=torch.float64)
        least = torch.inf
        for _ in range(views - 1):
            into = linked[pairs].sum(-1) == 1
            if not bool(into.any()):
                break
            pair = int(torch.where(into, gap, -torch.inf).argmax())
            least = min(least, float(gap[pair]))
            a, b = pairs[pair].tolist()
            if linked[a]:
                shift[b] = shift[a] + found[pair].shift
            else:
                shift[a] = shift[b] - found[pair].shift
            linked[[a, b]] = True
        return UncalibratedEstimate(shift, least >= self.gap)

    def pair(self, timeline: Timeline, a: int, b: int, seed: int) -> PairShift:
        """Return the shift of view b against view a: frame n of a goes with n + shift of b."""
        longest = int((1 - self.overlap) * timeline.frames)
        coarse = range(-longest, longest + 1, self.step)
        share = {s: self._share(timeline, a, b, s, self.frames, seed) for s in coarse}
        order = sorted(share, key=lambda s: -share[s])
        best = order[0]
        second = next((s for s in order if abs(s - best) > self.apart), best)
        fine = {
            s: self._share(timeline, a, b, s, self.fine_frames, seed)
            for middle in (best, second)
            for s in range(middle - self.step, middle + self.step + 1)
        }
        shift = max(fine, key=lambda s: fine[s])
        rivals = [fine[s] for s in fine if abs(s - shift) > self.apart]
        rivals += [share[s] for s in share if abs(s - shift) > self.apart]
        return PairShift(shift, fine[shift] - max(rivals, default=0.0))

    def _share(
        self, timeline: Timeline, a: int, b: int, shift: int, frames: int, seed: int
    ) -> float:
        """Return the share of the common key points that an essential matrix explains."""
        first = max(0, -shift)
        last = min(timeline.frames, timeline.frames - shift)
        if last - first < 2:
            return 0.0
        both = timeline.valid[a, first:last] & timeline.valid[b, first + shift : last + shift]
        rows = torch.nonzero(both.any(-1))[:, 0]
        spread = torch.linspace(0, len(rows) - 1, min(frames, len(rows))).round().long()
        rows = rows[spread]
        common = both[rows]
        if int(common.sum()) < _LEAST:
            return 0.0
        one = timeline.xy[a, rows + first][common]
        other = timeline.xy[b, rows + first + shift][common]
        _, info = poselib.estimate_relative_pose(
            one.numpy(),
            other.numpy(),
            camera_dict(1 / float(timeline.size[a])),
            camera_dict(1 / float(timeline.size[b])),
            ransac_options(self.threshold, self.iterations, seed, "max_epipolar_error"),
            {"max_iterations": 0},
        )
        return float(info["num_inliers"]) / int(common.sum())


@dataclass(frozen=True)
class PairShift:
    """The shift of one pair of views."""

    shift: int
    """Frames."""
    gap: float
    """The share of inliers there, less the largest at any other shift."""


@dataclass(frozen=True)
class UncalibratedEstimate:
    """Shifts by whole frames."""

    shift: Int[Tensor, " V"]
    determined: bool
    """Whether every link of the tree of pairs beats its rivals."""
