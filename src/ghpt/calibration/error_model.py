"""What errors of key points are made of: kinds of random errors that last, and that neighbouring
key points share, for different spans.

Most of a rig's error comes from what residuals hardly show: somebody who does not turn is seen
wrongly in the same way for the whole recording. So the variances of the kinds are fitted to what
the residuals show of them, and their effect on the rig is calculated from those.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig

_NEIGHBOURS = 0.42
"""Statures within which the correlation of key points' errors falls by e: that of detectors in the
field (conf/detector/field.yaml: 0.62 a bone).
"""
_ALIKE = 0.6
"""The correlation of the lasting errors of two detectors that see the same key point: 0.4 to 0.77
of OpenPose and BlazePose on one recording.
"""
_SIDE_DEGREES = 30.0
"""Turn of the body within which what depends on the side seen is forgotten (the same file)."""
_LASTING = 0.8
"""The variance of the errors that last, units of noise, which the ± of people who stand need: found
with synthetic ones who wait, pose and give directions (scripts/rig_uncertainty_table.py).
"""
_KNOWN_AS = 2.0
"""How much that counts: as so many moments of the residuals."""
_WAVES = 32
"""Of a random function of the side seen."""
_SECTORS = 12
"""Into which the sides seen are cut to measure what depends on them."""
_MORE_DRAWS = 4
"""Of errors that last, over those of others."""
_LONGER = 4.0
"""Ratio of successive correlation times."""
_ROWS = 60
"""Rows that tell how far key points are from each other."""


@dataclass(frozen=True)
class ErrorKind:
    """Random errors of variance 1, in units of noise."""

    lasts: bool
    """Whether another recording like this one would have the same errors."""
    draws: Float[Tensor, "V N 2 D"]


@dataclass(frozen=True)
class ErrorModel:
    """The kinds of errors of N points in V views: independent ones, those that last for a part of
    the recording, for all of it, and for as long as a view sees the same side of somebody. Each but
    the first is of every key point's own, or shared by its neighbours.
    """

    observed: Correspondences
    frame: Float[Tensor, " T"]
    """The number of each used frame."""
    mixing: Float[Tensor, "J J"]
    """Turns independent errors of the key points into errors that neighbours share."""
    side: Float[Tensor, "V R 3"]
    """The direction of each view as each row's body has it."""

    @classmethod
    def of(
        cls,
        observed: Correspondences,
        rig: PlacedRig,
        frame: Int[Tensor, " T"],
        axes: Float[Tensor, "R 3 3"],
        stature: float,
    ) -> ErrorModel:
        """Return the model of a rig's points; ``frame``: the number of each used frame; ``axes``:
        of each row's body, columns; ``stature``: of the people, in the rig's unit.
        """
        points = _table(observed, rig, observed.row)
        together = _table(observed, rig, observed.frame)
        kernel = _ALIKE * _kernel(together, stature) + (1 - _ALIKE) * _kernel(points, stature)
        values, vectors = torch.linalg.eigh(kernel)
        middle = points.nanmean(1).nan_to_num(0.0)
        ray = torch.nn.functional.normalize(rig.centre[:, None] - middle, dim=-1)
        return cls(
            observed=observed,
            frame=frame.double(),
            mixing=vectors * values.clamp(min=0.0).sqrt(),
            side=(ray[..., None, :] @ axes).squeeze(-2),
        )

    @property
    def times(self) -> list[float]:
        """The correlation times that are told apart, frames: from a quarter of the recording down
        to the distance of neighbouring frames.
        """
        gaps = self.frame.diff()
        shortest = float(gaps.median()) if len(gaps) else 1.0
        longest = float(self.frame[-1] - self.frame[0] + 1) / _LONGER
        count = math.floor(math.log(max(longest / shortest, 1.0), _LONGER)) + 1
        return [longest / _LONGER**power for power in range(count)]

    def kinds(self, count: int, seed: int) -> Iterator[ErrorKind]:
        """Yield all kinds, with ``count`` draws of each; of those that last with more, because few
        numbers make them up.
        """
        generator = torch.Generator().manual_seed(seed)
        normal = partial(torch.randn, generator=generator, dtype=torch.float64)
        white = normal(len(self.mixing), len(self.frame), len(self.side), 2, count)
        yield ErrorKind(False, self._at_points(white))
        for time in self.times:
            lasting = _lasting(white, self.frame, time)
            yield ErrorKind(False, self._at_points(lasting))
            yield ErrorKind(False, self._at_points(self._shared(lasting)))
        more = _MORE_DRAWS * count
        static = self._shared(normal(len(self.mixing), 1, len(self.side), 2, more))
        static = static.expand(-1, len(self.frame), -1, -1, -1)
        yield ErrorKind(True, self._at_points(static))
        frequency = normal(3, _WAVES) / (2.0 * math.sin(math.radians(_SIDE_DEGREES) / 2.0))
        phase = 2.0 * math.pi * torch.rand(_WAVES, generator=generator, dtype=torch.float64)
        wave = (2.0 / _WAVES) ** 0.5 * torch.cos(self.side @ frequency + phase)
        amplitude = normal(len(self.mixing), _WAVES, 2, more)
        series = torch.tensordot(wave, self._shared(amplitude), dims=([2], [1]))
        yield ErrorKind(True, series[:, self.observed.row, self.observed.joint])

    def moments(
        self, residual: Float[Tensor, "V N 2 D"], used: Bool[Tensor, "V N"]
    ) -> Float[Tensor, "M D"]:
        """Return mean squares of the mean residuals of groups, which tell the kinds apart: groups
        of a frame, of ever longer stretches of time, and of a side seen; of each key point alone,
        and of neighbours together.
        """
        joints = len(self.mixing)
        flat = residual.flatten(2).flatten(0, 1)
        count = used.flatten().double()
        moments = []
        for group in self._groups():
            place = (group * joints + self.observed.joint).flatten()
            size = (int(group.max()) + 1) * joints
            number = torch.zeros(size, dtype=torch.float64).index_add_(0, place, count)
            mean = torch.zeros(size, flat.shape[1], dtype=torch.float64)
            mean = mean.index_add_(0, place, flat) / number.clamp(min=1.0)[:, None]
            mean = mean.unflatten(0, (-1, joints))
            shared = torch.tensordot(mean, self.mixing, dims=([1], [0]))
            for each in (mean.mT, shared):
                total = each.square().sum((0, 2)).unflatten(0, (2, -1)).sum(0)
                moments.append(total / (number > 0).sum().clamp(min=1))
        return torch.stack(moments)

    def _groups(self) -> Iterator[Int[Tensor, "V N"]]:
        """Yield the group of each observation."""
        views = len(self.side)
        view = torch.arange(views)[:, None]
        since = self.frame - self.frame[0]
        stretches = [torch.arange(len(since))]
        stretches += [(since / (1.5 * time)).long() for time in reversed(self.times)]
        stretches.append(torch.zeros_like(stretches[0]))
        for stretch in stretches:
            yield stretch[self.observed.frame] * views + view
        azimuth = torch.atan2(self.side[..., 1], self.side[..., 0]) / (2.0 * math.pi)
        sector = torch.round(_SECTORS * azimuth).long().remainder(_SECTORS)
        yield sector[:, self.observed.row]

    def _at_points(self, series: Float[Tensor, "J T V 2 D"]) -> Float[Tensor, "V N 2 D"]:
        return series[self.observed.joint, self.observed.frame].transpose(0, 1)

    def _shared(self, own: Float[Tensor, "J ..."]) -> Float[Tensor, "J ..."]:
        return torch.tensordot(self.mixing, own, dims=1)


def variances(
    seen: Float[Tensor, " M"], of_kinds: Float[Tensor, "M K"], lasts: Bool[Tensor, " K"]
) -> Float[Tensor, " K"]:
    """Return the variances >= 0 of the kinds whose moments together are nearest to the seen ones,
    relative to these.

    ``lasts``: the kinds that last. Of people who do not turn residuals hardly show them, so their
    sum is drawn to what it is of detectors in the field.
    """
    weight = 1.0 / seen.clamp(min=1e-12)
    known = _KNOWN_AS * lasts.double()[None] / _LASTING
    design = torch.cat((of_kinds * weight[:, None], known))
    wanted = torch.cat((seen * weight, torch.full((1,), _KNOWN_AS, dtype=seen.dtype)))
    found, _ = nnls(design.numpy(), wanted.numpy())
    return torch.from_numpy(found)


def _lasting(
    white: Float[Tensor, "J T V 2 D"], frame: Float[Tensor, " T"], time: float
) -> Float[Tensor, "J T V 2 D"]:
    """Return processes of variance 1 that forget within a time (Ornstein and Uhlenbeck's)."""
    kept = torch.exp(-frame.diff() / time)
    new = (1.0 - kept.square()).sqrt()
    series = white.clone()
    for place in range(1, len(frame)):
        before = series[:, place - 1]
        series[:, place] = kept[place - 1] * before + new[place - 1] * white[:, place]
    return series


def _table(
    observed: Correspondences, rig: PlacedRig, row: Int[Tensor, " N"]
) -> Float[Tensor, "R J 3"]:
    """Return the points of each row's key points; NaN where there are none."""
    joints = int(observed.joint.max()) + 1
    points = torch.full((int(row.max()) + 1, joints, 3), torch.nan, dtype=torch.float64)
    known = rig.inlier.any(0)
    points[row[known], observed.joint[known]] = rig.points[known]
    return points


def _kernel(points: Float[Tensor, "R J 3"], stature: float) -> Float[Tensor, "J J"]:
    """Return the correlations of key points' errors; none of those that no row has together."""
    sample = points[:: max(1, len(points) // _ROWS)]
    distance = (sample[:, :, None] - sample[:, None]).norm(dim=-1).nanmedian(0).values
    distance = distance.nan_to_num(torch.inf).fill_diagonal_(0.0)
    return torch.exp(-distance / (_NEIGHBOURS * stature))
