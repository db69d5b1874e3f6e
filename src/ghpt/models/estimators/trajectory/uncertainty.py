"""The covariance of a trajectory's points."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.models.estimators.trajectory.groups import body_groups
from ghpt.models.estimators.trajectory.normal_matrix import (
    UPPER,
    Factor,
    NormalEquations,
)
from ghpt.models.estimators.trajectory.solver import Solution

_APART = 24
"""Frames between two whose columns of the inverse are computed at once; what is farther apart is
taken to be independent.
"""
_LARGEST = 1000.0
"""mm. No deviation is larger: what nothing is known of is independent of frames ``_APART``."""
_EVERY = 4
"""Covariances are computed at every 4th frame, and interpolated between them."""


def covariances(solution: Solution) -> Float[Tensor, "6 J T"]:
    """Return the covariances xx xy xz yy yz zz of the points, mm^2, of unit scale.

    They are blocks of the inverse of the normal matrix (Gauss-Markov), with the bones taken one at
    a time: a bone to a neighbour whose variance along it is c tells the position along it with
    variance ``deviation^2 + c``, c being the neighbour's without any bone.
    """
    observed = solution.observed
    alone = _inverse_blocks(observed, solution.equations)
    across = solution.bones
    start, end = across.ends
    blocks = observed.clone()
    for one, other in ((start, end), (end, start)):
        along = _quadratic(alone[:, other], across.direction).clamp(min=0)
        variance = 1 / across.precision.clamp(min=1e-12) + along
        told = torch.where(across.precision > 0, 1 / variance, 0.0)
        outer = torch.stack([across.direction[i] * across.direction[k] for i, k in UPPER])
        blocks.index_add_(1, one, told * outer)
    return _inverse_blocks(blocks, solution.equations)


def _inverse_blocks(
    blocks: Float[Tensor, "6 J T"], equations: NormalEquations
) -> Float[Tensor, "6 J T"]:
    """Return the 3x3 blocks of the inverse, of joints that only time ties to themselves."""
    joints, frames = blocks.shape[1:]
    right = torch.zeros_like(equations.right)
    own = equations.time.own + 1 / _LARGEST**2
    time = replace(equations.time, own=own)
    alone = NormalEquations(blocks, right, time, equations.bones[:, :0])
    factor = Factor(body_groups(joints, (), 1).even, alone, (), ())
    at = torch.arange(0, frames, _EVERY)
    found = blocks.new_zeros(6, joints, len(at))
    for shift in range(0, min(_APART, frames), _EVERY):
        chosen = torch.arange(shift, frames, _APART)
        columns = []
        for coordinate in range(3):
            right.zero_()
            right[coordinate][:, chosen] = 1
            columns.append(factor.solve(right)[..., chosen])
        for element, (i, k) in zip(found, UPPER, strict=True):
            element[:, chosen // _EVERY] = columns[k][i]
    return _interpolate(found, at, frames)


def _interpolate(
    values: Float[Tensor, "6 J N"], at: Int[Tensor, " N"], frames: int
) -> Float[Tensor, "6 J T"]:
    """Return values of every frame, linear between those that are known."""
    frame = torch.arange(frames)
    before = (frame // _EVERY).clamp(max=len(at) - 1)
    after = (before + 1).clamp(max=len(at) - 1)
    share = (frame - at[before]) / _EVERY
    share = torch.where(after > before, share, 0.0)
    return torch.lerp(values[..., before], values[..., after], share.to(values))


def _quadratic(
    matrix: Float[Tensor, "6 B T"], direction: Float[Tensor, "3 B T"]
) -> Float[Tensor, "B T"]:
    total = torch.zeros_like(direction[0])
    for element, (i, k) in zip(matrix, UPPER, strict=True):
        total += (1 if i == k else 2) * element * direction[i] * direction[k]
    return total
