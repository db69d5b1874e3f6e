"""The error of a pose that training lessens where mistakes are large and many."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import JOINTS, PELVIS

_SMALL = 10.0
"""mm: the loss grows with the error below it, and with its root far above."""


def robust_error(estimate: PoseEstimate, truth: Truth) -> Float[Tensor, " B"]:
    """Return the mean loss of the joints' distances from the truth: the mean of two kinds.

    One is of the distances as they are, the other of those of the pose relative to the pelvis.
    Cameras that are not where they are said to be move all joints alike, and weights that differ
    from joint to joint then tear the pose apart: only the second kind sees that.
    """
    offset = estimate.points - truth.points.double()
    counted = estimate.estimated & truth.valid
    is_pelvis = torch.arange(len(JOINTS), device=counted.device) == PELVIS
    others = counted & counted[:, PELVIS, None] & ~is_pelvis
    relative = offset - offset[:, PELVIS, None]
    return (_mean_loss(offset, counted) + _mean_loss(relative, others)) / 2


def _mean_loss(offset: Float[Tensor, "B J 3"], counted: Bool[Tensor, "B J"]) -> Float[Tensor, " B"]:
    """Return the mean over the counted joints of the root of 1 + distance / ``_SMALL``, less 1."""
    square = torch.where(counted, offset.square().sum(-1), 1.0)
    loss = torch.where(counted, (1 + square.sqrt() / _SMALL).sqrt() - 1, 0.0)
    return loss.sum(-1) / counted.sum(-1).clamp_min(1)
