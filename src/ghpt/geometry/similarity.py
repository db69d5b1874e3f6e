"""Similarities: the way from one world to another."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras


@dataclass(frozen=True)
class Similarity:
    """From one world to another: ``X' = scale R X + t``; mm."""

    R: Float[Tensor, "3 3"]
    scale: float
    t: Float[Tensor, " 3"]

    def points(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return points in the other world."""
        return self.scale * (points @ self.R.mT) + self.t

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the same cameras in the other world: their images stay as they are."""
        R = cameras.R @ self.R.mT
        origin = (R @ self.t[:, None])[..., 0]
        return Cameras(cameras.K, R, self.scale * cameras.t - origin)

    def covariance(self, covariance: Float[Tensor, "V 6 6"]) -> Float[Tensor, "V 6 6"]:
        """Return covariances of rotations (radians, about the world's axes) and centres (mm)."""
        change = torch.block_diag(self.R, self.scale * self.R)
        return change @ covariance @ change.T
