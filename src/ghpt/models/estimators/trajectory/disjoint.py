"""A test of the covariances without any truth: two halves of the views, each on its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.observations import Observations

LEVELS = (0.5, 0.9, 0.95)
"""Of the ellipsoids."""
_CHI_SQUARE = (2.366, 6.251, 7.815)
"""Squared Mahalanobis distances of these ellipsoids in three dimensions."""
HALF_INFLATION = 2**0.25
"""What a half of the views has more of `Trajectory.inflation` than all of them. Errors that last
are taken for noise that an average over time removes; the span of that average grows with the
fourth root of the variance of a frame's own estimate.
"""
LEAST_VIEWS = 4
_LEAST_JOINTS = 200
"""Joints of frames that a coverage may rest on."""


@dataclass(frozen=True)
class DisjointTest:
    """How far the points of two halves of the views are from each other."""

    square: Float[Tensor, " N"]
    """Squared distances in their common covariance, of all joints that both halves observe."""

    @property
    def is_decidable(self) -> bool:
        """Whether there are enough of them."""
        return len(self.square) >= _LEAST_JOINTS

    def coverage(self) -> tuple[float, ...]:
        """Return the share of the differences within the ellipsoids of ``LEVELS``."""
        return tuple(float((self.square <= limit).double().mean()) for limit in _CHI_SQUARE)

    def inflation(self) -> float:
        """Return the factor of the covariances with which they hold.

        It is the geometric mean of the factors with which the ellipsoids of 50 and of 90 % do:
        real errors have longer tails than normal ones.
        """
        ratios = []
        for level, limit in zip(LEVELS[:2], _CHI_SQUARE[:2], strict=True):
            ratios.append(float(self.square.quantile(level)) / limit)
        return (ratios[0] * ratios[1]) ** 0.5


def halves(batch: Observations) -> Iterator[tuple[Observations, Observations]]:
    """Yield the observations of two disjoint halves of the views, divided in three ways."""
    views = torch.arange(batch.valid.shape[1])
    low = views & 1
    high = (views >> 1) & 1
    for side in (low, high, low ^ high):
        first = side.bool()[:, None]
        yield (
            replace(batch, valid=batch.valid & first),
            replace(batch, valid=batch.valid & ~first),
        )


def square_distances(
    difference: Float[Tensor, "N 3"], covariance: Float[Tensor, "N 6"]
) -> Float[Tensor, " N"]:
    """Return squared Mahalanobis distances; covariances are xx xy xz yy yz zz."""
    rows = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    matrix = covariance[:, rows]
    scaled = torch.linalg.solve(matrix, difference)
    return (difference * scaled).sum(-1)


def observed_by_two(views: Bool[Tensor, "N V J"]) -> Bool[Tensor, "N J"]:
    """Return the joints with which two views agree."""
    return views.sum(1) >= 2
