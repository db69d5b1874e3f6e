"""The covariance of a trajectory's points."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.models.estimators.trajectory.inverse import tridiagonal_inverse
from ghpt.models.estimators.trajectory.normal_matrix import UPPER, TimeCoupling
from ghpt.models.estimators.trajectory.solver import Solution

_LARGEST = 1000.0
"""mm. No deviation is larger, whatever little is known."""


def covariances(solution: Solution, inflation: float) -> Float[Tensor, "6 J T"]:
    """Return the covariances xx xy xz yy yz zz of the points, mm^2.

    They are blocks of the inverse of the normal matrix (Gauss-Markov) times ``inflation``, with the
    bones taken one at a time: a bone to a neighbour whose variance along it is c tells the position
    along it with variance ``deviation^2 + c``, c being the neighbour's without any bone. To that
    comes what `_mirrored` says.
    """
    observed = solution.observed
    time = solution.time
    alone = _inverse_blocks(observed, time)
    across = solution.bones
    start, end = across.ends
    blocks = observed.clone()
    for one, other in ((start, end), (end, start)):
        along = _quadratic(alone[:, other], across.direction).clamp(min=0)
        variance = 1 / across.precision.clamp(min=1e-12) + along
        told = torch.where(across.precision > 0, 1 / variance, 0.0)
        outer = torch.stack([across.direction[i] * across.direction[k] for i, k in UPPER])
        blocks.index_add_(1, one, told * outer)
    known = inflation * _inverse_blocks(blocks, time)
    return known + _mirrored(solution, inflation * alone)


def _mirrored(solution: Solution, alone: Float[Tensor, "6 J T"]) -> Float[Tensor, "6 J T"]:
    """Return what is added to the covariance of joints that only bones place along the one ray.

    A bone of known length fits at two depths, mirror images of each other; the solution is one of
    them. Two points a apart, the other with probability p, have the variance p (1 - p) a^2, where
    ``p / (1 - p) = exp(-a^2 / 2 c)`` by the variance c that the joint has along the ray ``alone``,
    without bones. Of several bones the one that says most counts.
    """
    added = torch.zeros_like(alone)
    doubtful = ~solution.crossed
    if not doubtful.any():
        return added
    xx, xy, xz, yy, yz, zz = alone[:, doubtful]
    rows = (
        torch.stack((xx, xy, xz), -1),
        torch.stack((xy, yy, yz), -1),
        torch.stack((xz, yz, zz), -1),
    )
    variances, axes = torch.linalg.eigh(torch.stack(rows, -1))
    ray = added.new_zeros(3, *doubtful.shape)
    ray[:, doubtful] = axes[..., -1].T
    variance = added.new_ones(doubtful.shape)
    variance[doubtful] = variances[..., -1]
    bones = solution.bones
    length = solution.body.length[:, None]
    most = torch.zeros_like(variance)
    for joint in bones.ends:
        apart = 2 * length * (bones.direction * ray[:, joint]).sum(0)
        odds = torch.exp(-apart.square() / (2 * variance[joint]))
        doubt = odds / (1 + odds).square() * apart.square() * (bones.precision > 0)
        doubt = doubt * doubtful[joint]
        most.scatter_reduce_(0, joint[:, None].expand_as(doubt), doubt, "amax")
    return torch.stack([most * ray[i] * ray[k] for i, k in UPPER])


def _inverse_blocks(blocks: Float[Tensor, "6 J T"], time: TimeCoupling) -> Float[Tensor, "6 J T"]:
    """Return the 3x3 blocks of the inverse, of joints that only time ties to themselves.

    A joint is tied to itself over two frames: with two frames to a block the matrix is tridiagonal.
    """
    frames = blocks.shape[-1]
    padded = frames + frames % 2
    own = time.own + 1 / _LARGEST**2
    diagonal = blocks.new_zeros(padded // 2, blocks.shape[1], 2, 3, 2, 3)
    upper = torch.zeros_like(diagonal)
    for element, (i, k) in zip(blocks, UPPER, strict=True):
        values = _by_two(element + own if i == k else element, float(i == k))
        for half in (0, 1):
            diagonal[:, :, half, i, half, k] = values[..., half]
            diagonal[:, :, half, k, half, i] = values[..., half]
    near = _by_two(time.next)
    far = _by_two(time.second)
    for axis in range(3):
        diagonal[:, :, 0, axis, 1, axis] = near[..., 0]
        diagonal[:, :, 1, axis, 0, axis] = near[..., 0]
        upper[:, :, 1, axis, 0, axis] = near[..., 1]
        for half in (0, 1):
            upper[:, :, half, axis, half, axis] = far[..., half]
    inverse, _ = tridiagonal_inverse(
        diagonal.flatten(4).flatten(2, 3), upper.flatten(4).flatten(2, 3)[:-1]
    )
    found = inverse.unflatten(-1, (2, 3)).unflatten(-3, (2, 3))
    elements = [
        torch.stack([found[:, :, half, i, half, k] for half in (0, 1)], dim=-1) for i, k in UPPER
    ]
    return torch.stack([values.transpose(0, 1).flatten(1)[:, :frames] for values in elements])


def _by_two(values: Float[Tensor, "J T"], padding: float = 0.0) -> Float[Tensor, "N J 2"]:
    """Return the values of each two frames together, with one more frame where T is odd."""
    if values.shape[-1] % 2:
        values = torch.cat((values, torch.full_like(values[:, :1], padding)), dim=-1)
    return values.unflatten(-1, (-1, 2)).transpose(0, 1)


def _quadratic(
    matrix: Float[Tensor, "6 B T"], direction: Float[Tensor, "3 B T"]
) -> Float[Tensor, "B T"]:
    total = torch.zeros_like(direction[0])
    for element, (i, k) in zip(matrix, UPPER, strict=True):
        total += (1 if i == k else 2) * element * direction[i] * direction[k]
    return total
