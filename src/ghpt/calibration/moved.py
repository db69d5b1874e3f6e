"""Which cameras have moved, where a rig from the people in view is not the one that a file has."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.comparison import align_robustly
from ghpt.calibration.rig import RigEstimate
from ghpt.calibration.uncertainty import gauge
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import matrix_to_vector

_CONTRAST = 9.0
"""Squared standard deviations by which another explanation must be worse to be ruled out."""
_LEAST_VARIANCE = 0.01
"""Of the mean one; the covariance is of few draws, which leave some directions without any."""


@dataclass(frozen=True)
class RigChange:
    """How a reference rig differs from an estimated one, in units of the estimate's ±: those that
    the people determine well count more, and the world and scale of the reference do not count.
    """

    whitened: Float[Tensor, " F"]
    """F = 6 V - 7 independent differences, each of variance 1 if the rigs are the same."""
    by_camera: Float[Tensor, "F V 6"]
    """What moving each camera does to them."""

    @classmethod
    def of(cls, estimate: RigEstimate, reference: Cameras) -> RigChange:
        """Return the change from an estimate to a reference rig of the same V >= 3 cameras."""
        own = estimate.cameras
        moved = align_robustly(reference, own).cameras(reference)
        turn = matrix_to_vector(moved.R.mT @ own.R)
        change = torch.cat((turn, moved.centre - own.centre), dim=-1)
        size = (own.centre - own.centre.mean(0)).square().sum(-1).mean().sqrt()
        unit = torch.cat((torch.ones(3, dtype=size.dtype), (1 / size).expand(3)))
        per_rig = unit.repeat(len(own.R))
        free = torch.linalg.svd(gauge(own.R, own.centre / size))[0][:, 7:]
        covariance = free.mT @ (per_rig[:, None] * estimate.joint_covariance * per_rig) @ free
        values, vectors = torch.linalg.eigh(covariance)
        root = values.clamp(min=_LEAST_VARIANCE * float(values.mean())).sqrt()
        by_camera = (vectors / root).mT @ free.mT
        return cls(by_camera @ (unit * change).flatten(), by_camera.unflatten(1, (-1, 6)))

    def misfit(self, moved: Collection[int]) -> float:
        """Return the sum of squares that is left if these cameras have moved, and no others."""
        design = self.by_camera[:, sorted(moved)].flatten(1)
        step = torch.linalg.lstsq(design, self.whitened[:, None]).solution
        return float((self.whitened - (design @ step)[:, 0]).square().sum())

    def suspects(self, view: int, others: Collection[int] = ()) -> tuple[int, ...]:
        """Return the cameras whose move explains the change as well as that of the best one of
        them does, ``view`` first in any case; ``others``: cameras that have moved anyway.
        """
        freedom = len(self.whitened) - 6 * (len(others) + 1)
        cameras = [camera for camera in range(self.by_camera.shape[1]) if camera not in others]
        misfit = {camera: self.misfit({camera, *others}) for camera in cameras}
        least = min(misfit.values())
        limit = least + _CONTRAST * max(least / max(freedom, 1), 1.0)
        return (view, *(one for one in cameras if misfit[one] <= limit and one != view))
