"""Residuals in millimetres at the body's depth, and their normal equations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.normal_equations import Row, ViewComponents, form_equations, weighted_sum
from ghpt.geometry.triangulation import System, flat_cameras
from ghpt.observations import Observations


@dataclass(frozen=True)
class ReprojectionRows:
    """The equations of all key points of T frames, in which points are linear.

    A residual is the pixel error x depth / focal length, which is a length at the body's depth: one
    unit for all views, whatever their resolution and distance. Arrays are [V, J, T].
    """

    views: ViewComponents
    millimetres: Float[Tensor, "V 1 T"]
    """One over the focal length: from the rows' unit, depth x pixels, to mm."""
    used: Bool[Tensor, "V J T"]
    origin: Float[Tensor, " 3"]
    """The zero of the local world that points are in."""

    @staticmethod
    def from_observations(batch: Observations) -> ReprojectionRows:
        """Return the rows of the frames of one recording, whose cameras may change by frame."""
        rig = flat_cameras(batch.cameras, batch.valid.shape[:1])
        valid = batch.valid.permute(1, 2, 0)
        system = System(rig, batch.key_points, valid, shared_origin=True)
        focal = system.local.K.diagonal(dim1=-2, dim2=-1)[..., :2]
        millimetres = (1 / focal.prod(-1).sqrt()).mT[:, None]
        return ReprojectionRows(
            views=system.views,
            millimetres=millimetres,
            used=system.used,
            origin=system.origin[0],
        )

    @cached_property
    def pair(self) -> tuple[Row, Row]:
        """The two rows of each key point."""
        return self.views.rows()

    @cached_property
    def equations(self) -> Float[Tensor, "V 9 J T"]:
        """``a a^T + b b^T`` of the two rows and its right-hand side."""
        return form_equations(*self.pair)

    def exchange(self, joints: Int[Tensor, "V J T"]) -> ReprojectionRows:
        """Return the rows in which each joint has the key point of another one of its view."""
        views = replace(
            self.views, u=self.views.u.gather(1, joints), v=self.views.v.gather(1, joints)
        )
        return replace(self, views=views, used=self.used.gather(1, joints))

    def residuals(self, points: Float[Tensor, "3 J T"]) -> Float[Tensor, "V J T"]:
        """Return the lengths of the residuals of points of the local world, mm."""
        a, b = self.pair
        over = _row_residual(a, points)
        down = _row_residual(b, points)
        square = torch.addcmul(over.mul_(over), down, down)
        return square.sqrt_().mul_(self.millimetres)

    def sums(
        self, precision: Float[Tensor, "V J T"]
    ) -> tuple[Float[Tensor, "6 J T"], Float[Tensor, "3 J T"]]:
        """Return the normal matrices and right-hand sides; ``precision`` of a residual, mm^-2."""
        weight = torch.where(self.used, precision * self.millimetres**2, 0.0)
        total = weighted_sum(self.equations, weight)
        return total[:6], total[6:]


def _row_residual(row: Row, points: Float[Tensor, "3 J T"]) -> Float[Tensor, "V J T"]:
    x, y, z = points
    total = torch.addcmul(row[0] * x, row[1], y)
    return torch.addcmul(total, row[2], z).sub_(row[3])
