"""Views that exchange left and right for a while, or that show somebody else."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.models.estimators.trajectory.priors import TimeAxis
from ghpt.models.estimators.trajectory.rows import ReprojectionRows
from ghpt.skeleton import Skeleton


@dataclass(frozen=True)
class SideExchange:
    """Left and right of a limb may be exchanged in a view, for a while.

    A limb's cost is the sum over its key points of ``log(1 + (r / deviation)^2)``. It is exchanged
    where the cost of the trajectory, averaged over time with a Gaussian of ``window_s``, falls by
    more than ``gain`` for each pair of key points.
    """

    gain: float
    window_s: float

    def __post_init__(self) -> None:
        check_positive(gain=self.gain, window_s=self.window_s)

    def order(
        self,
        rows: ReprojectionRows,
        points: Float[Tensor, "3 J T"],
        scale: Float[Tensor, " J"],
        skeleton: Skeleton,
        axis: TimeAxis,
    ) -> Int[Tensor, "V J T"]:
        """Return which key point each joint has in each view and frame."""
        views, joints, frames = rows.used.shape
        as_given = torch.arange(joints)[:, None].expand(views, joints, frames)
        mirror = torch.tensor(skeleton.mirror)
        mirrored = mirror[:, None].expand(views, joints, frames)
        limbs = sided_limbs(skeleton)
        if not limbs:
            return as_given
        other = rows.exchange(mirrored)
        both = rows.used & other.used
        gain = _loss(rows, points, scale) - _loss(other, points, scale)
        gain = torch.where(both, gain, 0.0)
        order = as_given.clone()
        for limb in limbs:
            chosen = list(limb)
            total = gain[:, chosen].sum(1) / max(len(limb) / 2, 1)
            sigma = self.window_s * axis.rate_hz
            smooth = gaussian_filter1d(total.numpy(), sigma, axis=-1, mode="nearest")
            exchanged = torch.from_numpy(smooth > self.gain)[:, None]
            order[:, chosen] = torch.where(exchanged, mirrored[:, chosen], as_given[:, chosen])
        return order


def _loss(
    rows: ReprojectionRows, points: Float[Tensor, "3 J T"], scale: Float[Tensor, " J"]
) -> Float[Tensor, "V J T"]:
    return torch.log1p((rows.residuals(points) / scale[:, None]).square())


@lru_cache(maxsize=32)
def sided_limbs(skeleton: Skeleton) -> tuple[tuple[int, ...], ...]:
    """Return the key points of the legs, of the arms and so on: left and right together.

    Pairs of key points belong together if bones connect them on their own side.
    """
    limb_of = {joint: number for number, pair in enumerate(skeleton.pairs) for joint in pair}
    for start, end in skeleton.bones:
        if start in limb_of and end in limb_of:
            old = limb_of[end]
            new = limb_of[start]
            limb_of = {joint: new if limb == old else limb for joint, limb in limb_of.items()}
    limbs = sorted(set(limb_of.values()))
    return tuple(tuple(j for j in sorted(limb_of) if limb_of[j] == limb) for limb in limbs)


@dataclass(frozen=True)
class OtherPeople:
    """A view may show somebody else for a while.

    All key points of a view weigh ``1 / (1 + (m / kernel)^4)``, m the median of its residuals in
    their deviations, averaged over time with a Gaussian of ``window_s``.
    """

    kernel: float
    window_s: float

    def __post_init__(self) -> None:
        check_positive(kernel=self.kernel, window_s=self.window_s)

    def weight(
        self, relative: Float[Tensor, "V J T"], used: Bool[Tensor, "V J T"], axis: TimeAxis
    ) -> Float[Tensor, "V 1 T"]:
        """Return the weight of each view, from residuals over their deviations."""
        median = torch.where(used, relative, torch.nan).nanmedian(1).values.nan_to_num(0.0)
        sigma = self.window_s * axis.rate_hz
        smooth = gaussian_filter1d(median.numpy(), sigma, axis=-1, mode="nearest")
        return torch.from_numpy(self.view_weight(smooth))[:, None]

    def view_weight(self, median: Float[np.ndarray, "*T V"]) -> Float[np.ndarray, "*T V"]:
        """Return the weight of views with these medians, averaged over time."""
        return 1 / (1 + (median / self.kernel) ** 4)
