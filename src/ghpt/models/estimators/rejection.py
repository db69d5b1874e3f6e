"""Which joints nothing explains: fewer than two of the views see them where they were put."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.geometry.cameras import project
from ghpt.models.estimators.classical import person_scale
from ghpt.observations import Observations

_FEW = 6
"""Joints in a view; the box around fewer is not the person's."""


@dataclass(frozen=True)
class Rejection:
    """A joint is explained if it lies within ``limit`` of the rays of two views or more.

    The distance is the reprojection error taken to the depth of the joint, in extents of the
    person: the median over frames and views of the box around the person, taken to the person's
    depth. A box in the image would not do: it shrinks with the joints that a view misses.
    ``extent`` is that length in mm; null: of each batch on its own.

    0.1 is 12 to 18 cm. It rejects no joint of the synthetic data, none of Pose2Sim's recording by
    either detector, and 0.6 % of the seated person's of caliscope, where two of the views are a
    hand's breadth off.
    """

    limit: float
    extent: float | None = None

    def __post_init__(self) -> None:
        check_positive(limit=self.limit)

    def fitted(
        self, batch: Observations, points: Float[Tensor, "B J 3"], placed: Bool[Tensor, "B J"]
    ) -> Rejection:
        """The same with the extent of the person in these frames."""
        return replace(self, extent=float(self._extent(batch, points, placed)))

    @torch.no_grad()
    def explained(
        self, batch: Observations, points: Float[Tensor, "B J 3"], placed: Bool[Tensor, "B J"]
    ) -> Bool[Tensor, "B J"]:
        """Which of the ``placed`` joints two views explain; all of them where the person's extent
        is not known.
        """
        distance, used, _ = _distances(batch, points, placed)
        extent = self._extent(batch, points, placed) if self.extent is None else self.extent
        if not extent > 0:
            return placed
        return ((distance <= self.limit * extent) & used).sum(1) >= 2

    @staticmethod
    def _extent(
        batch: Observations, points: Float[Tensor, "B J 3"], placed: Bool[Tensor, "B J"]
    ) -> Float[Tensor, ""]:
        _, used, depth = _distances(batch, points, placed)
        middle = torch.where(used, depth, torch.nan).nanmedian(-1).values
        size = person_scale(batch.key_points, batch.valid).double() * middle / _focal(batch)[..., 0]
        whole = (batch.valid.sum(-1) >= _FEW) & (size > 0)
        return torch.where(whole, size, torch.nan).nanmedian().nan_to_num(0.0)


def _distances(
    batch: Observations, points: Float[Tensor, "B J 3"], placed: Bool[Tensor, "B J"]
) -> tuple[Float[Tensor, "B V J"], Bool[Tensor, "B V J"], Float[Tensor, "B V J"]]:
    """How far each joint is from each view's ray (mm), where that can be told, and the joint's
    depth (mm).
    """
    projected, depth = project(batch.cameras, points)
    pixels = (projected - batch.key_points).norm(dim=-1)
    used = batch.valid & placed[:, None] & (depth > 0) & torch.isfinite(pixels)
    return pixels * depth / _focal(batch), used, depth


def _focal(batch: Observations) -> Float[Tensor, "B V 1"]:
    K = batch.cameras.K
    return (K[..., 0, 0] * K[..., 1, 1]).sqrt()[..., None]
