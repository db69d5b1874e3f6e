"""Joints that nothing explains: fewer than two of the views see them where they were put."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
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

    def fit_to(
        self,
        batch: Observations,
        points: Float[Tensor, "B J 3"],
        has_position: Bool[Tensor, "B J"],
    ) -> Rejection:
        """Return the same rule with the extent of the person in these frames."""
        distance = _ray_distance(batch, points, has_position)
        return replace(self, extent=float(_person_extent(batch, distance)))

    @torch.no_grad()
    def find_explained(
        self,
        batch: Observations,
        points: Float[Tensor, "B J 3"],
        has_position: Bool[Tensor, "B J"],
    ) -> Bool[Tensor, "B J"]:
        """Return which of the joints with a position two views explain.

        These are all of them where the person's extent is not known.
        """
        return has_position & (self.explaining(batch, points, has_position) >= 2)

    @torch.no_grad()
    def explaining(
        self,
        batch: Observations,
        points: Float[Tensor, "B J 3"],
        has_position: Bool[Tensor, "B J"],
    ) -> Int[Tensor, "B J"]:
        """Return the number of views that explain each joint; 0 where it has no position.

        These are all views where the person's extent is not known.
        """
        distance = _ray_distance(batch, points, has_position)
        extent = self.extent
        if extent is None:
            extent = float(_person_extent(batch, distance))
        if not extent > 0:
            return has_position * batch.valid.shape[1]
        near = (distance.mm <= self.limit * extent) & distance.valid
        return near.sum(1)


@dataclass(frozen=True)
class _RayDistance:
    """How far each joint is from each view's ray."""

    mm: Float[Tensor, "B V J"]
    valid: Bool[Tensor, "B V J"]
    depth: Float[Tensor, "B V J"]
    """The joint's depth in the view, mm."""


def _ray_distance(
    batch: Observations, points: Float[Tensor, "B J 3"], has_position: Bool[Tensor, "B J"]
) -> _RayDistance:
    projected, depth = project(batch.cameras, points)
    error = (projected - batch.key_points).norm(dim=-1)
    valid = batch.valid & has_position[:, None] & (depth > 0) & torch.isfinite(error)
    return _RayDistance(error * depth / _focal(batch), valid, depth)


def _person_extent(batch: Observations, distance: _RayDistance) -> Float[Tensor, ""]:
    """Return the median extent of the person over frames and views, mm; 0 where none is known."""
    depth = torch.where(distance.valid, distance.depth, torch.nan).nanmedian(-1).values
    scale = person_scale(batch.key_points, batch.valid).double()
    extent = scale * depth / _focal(batch)[..., 0]
    known = (batch.valid.sum(-1) >= _FEW) & (extent > 0)
    return torch.where(known, extent, torch.nan).nanmedian().nan_to_num(0.0)


def _focal(batch: Observations) -> Float[Tensor, "B V 1"]:
    K = batch.cameras.K
    return (K[..., 0, 0] * K[..., 1, 1]).sqrt()[..., None]
