"""The normal equations of a few successive frames, with a prior for all that came before them.

The terms are those of `normal_matrix`. Here the frames are few and one comes at a time, so arrays
are NumPy's, whose calls cost less than the arithmetic; the frames lead, oldest first. The joints of
a group are solved at once by a banded Cholesky factor in which the newest frame comes first, so
that its last block is the information on the oldest frame that all others leave.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import lapack

from ghpt.models.estimators.trajectory.groups import Bones

Array = np.ndarray

_NOTHING = 1e-12
"""mm^-2: no information."""


@dataclass(frozen=True)
class WindowTerms:
    """What is known of the joints of a group in K frames; precisions are in mm^-2."""

    blocks: Float[Array, "K J 3 3"]
    """Of the key points of each joint."""
    right: Float[Array, "K J 3"]
    first: Float[Array, "K-1 J"]
    """Precision of the difference between a frame and the next one."""
    second: Float[Array, "K-2 J"]
    """Precision of the second difference around each inner frame."""
    least: float
    """What each coordinate has at least."""
    directions: Float[Array, "K B 3"]
    """The direction of each bone times the square root of its precision."""
    pull: Float[Array, "K B"]
    """The length of each bone times the square root of its precision."""


@dataclass(frozen=True)
class Prior:
    """What the past says of the two oldest frames: the newer one's coordinates come first."""

    matrix: Float[Array, "6J 6J"]
    right: Float[Array, 6j]

    def forget(self, joints: Bool[Array, " J"]) -> Prior:
        """Return what is said of the other joints; of these nothing is known."""
        gone = np.tile(np.repeat(joints, 3), 2)
        kept = ~gone
        between = self.matrix[np.ix_(gone, kept)]
        # what has no information has no part in this
        own = self.matrix[np.ix_(gone, gone)] + _NOTHING * np.eye(int(gone.sum()))
        told = np.linalg.solve(own, np.column_stack((between, self.right[gone])))
        matrix = np.zeros_like(self.matrix)
        right = np.zeros_like(self.right)
        matrix[np.ix_(kept, kept)] = self.matrix[np.ix_(kept, kept)] - between.T @ told[:, :-1]
        right[kept] = self.right[kept] - between.T @ told[:, -1]
        return Prior(matrix, right)


@dataclass(frozen=True)
class Factored:
    """The solution for a group, and the factor that gave it."""

    points: Float[Array, "K J 3"]
    factor: Float[Array, "d n"]
    """Lower band; columns run over the frames from the newest, the joints and coordinates."""

    def covariance(self, frame: int) -> Float[Array, "J 3 3"]:
        """Return the covariances of the joints of a frame."""
        frames, joints, _ = self.points.shape
        first = 3 * joints * (frames - 1 - frame)
        rest = self.factor.shape[1] - first
        columns = np.zeros((rest, 3 * joints), order="F")
        np.fill_diagonal(columns, 1.0)
        inverse, _ = lapack.dpbtrs(self.factor[:, first:], columns, lower=1, overwrite_b=1)
        joint = np.arange(joints)
        by_joint = inverse[: 3 * joints].reshape(joints, 3, joints, 3)
        found: Array = by_joint[joint, :, joint]
        return found


class Group:
    """Joints that are solved at once, and the bones between them."""

    def __init__(self, joints: tuple[int, ...], skeleton: Bones, inner: tuple[int, ...]) -> None:
        self.joints = np.array(joints)
        self.bones = np.array(inner, dtype=np.int64)
        place = {joint: index for index, joint in enumerate(joints)}
        ends = [(place[skeleton[bone][0]], place[skeleton[bone][1]]) for bone in inner]
        self.ends: Int[Array, "B 2"] = np.array(ends, dtype=np.int64).reshape(-1, 2)
        count = len(joints)
        self.incidence = np.zeros((count, len(inner)))
        self.sign = np.zeros((count, len(inner)))
        bone = np.arange(len(inner))
        for side, sign in ((0, 1.0), (1, -1.0)):
            self.incidence[self.ends[:, side], bone] = 1.0
            self.sign[self.ends[:, side], bone] = sign
        low = self.ends.min(-1)[:, None, None]
        high = self.ends.max(-1)[:, None, None]
        row = np.arange(3)[:, None]
        column = np.arange(3)
        shape = (len(inner), 3, 3)
        self.low = np.broadcast_to(low, shape).reshape(-1)
        self.row = np.broadcast_to(row, shape).reshape(-1)
        self.distance = np.broadcast_to(3 * (high - low) + column - row, shape).reshape(-1)

    def solve(self, terms: WindowTerms, prior: Prior | None) -> Factored:
        """Return the least squares solution. Raises ArithmeticError where there is none."""
        frames, joints, _ = terms.right.shape
        outer, blocks, right = self._with_bones(terms)
        second = terms.second
        first = terms.first
        own = np.full((frames, joints), terms.least)
        own[:-1] += first
        own[1:] += first
        own[:-2] += second
        own[1:-1] += 4 * second
        own[2:] += second
        near = -first
        near[:-1] -= 2 * second
        near[1:] -= 2 * second
        band = np.zeros((frames, joints, 3, 6 * joints + 1))
        newest_first = blocks[::-1]
        band[..., 0] = newest_first[..., _DIAGONAL, _DIAGONAL] + own[::-1, :, None]
        band[..., :2, 1] = newest_first[..., (0, 1), (1, 2)]
        band[..., 0, 2] = newest_first[..., 0, 2]
        band[:, self.low, self.row, self.distance] = -outer[::-1].reshape(frames, -1)
        band[:-1, ..., 3 * joints] += near[::-1, :, None]
        band[:-2, ..., 6 * joints] = second[::-1, :, None]
        band = band.reshape(-1, band.shape[-1])
        vector = right[::-1].reshape(-1).copy()
        if prior is not None:
            size = 6 * joints
            source, target = _lower(size, band.shape[1])
            oldest = band[-size:].reshape(-1)
            oldest[target] += prior.matrix.reshape(-1)[source]
            vector[-size:] += prior.right
        factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if info:
            raise ArithmeticError(f"the normal matrix is not positive definite ({info})")
        solution, _ = lapack.dpbtrs(factor, vector, lower=1, overwrite_b=1)
        return Factored(solution.reshape(frames, joints, 3)[::-1], factor)

    def marginal(self, terms: WindowTerms, prior: Prior | None) -> Prior:
        """Return what the oldest of three frames or more, and the prior, say of the next two."""
        joints = len(self.joints)
        size = 3 * joints
        outer, blocks, right = self._with_bones(terms, frames=1)
        matrix = np.zeros((3 * size, 3 * size))
        vector = np.zeros(3 * size)
        old = slice(2 * size, 3 * size)
        if prior is not None:
            matrix[size:, size:] = prior.matrix
            vector[size:] = prior.right
        joint = np.arange(joints)
        square = matrix[old, old].reshape(joints, 3, joints, 3)
        square[joint, :, joint] += blocks[0]
        start, end = self.ends.T
        square[start, :, end] -= outer[0]
        square[end, :, start] -= outer[0]
        vector[old] += right[0].reshape(-1)
        second = np.repeat(terms.second[0], 3)
        first = np.repeat(terms.first[0], 3)
        flat = matrix.reshape(-1)
        for one, other, value in (
            (0, 0, second),
            (1, 1, 4 * second + first),
            (2, 2, second + first + terms.least),
            (0, 1, -2 * second),
            (0, 2, second),
            (1, 2, -2 * second - first),
        ):
            for row, column in {(one, other), (other, one)}:
                begin = size * (3 * size * row + column)
                flat[begin : begin + 3 * size * size : 3 * size + 1][:size] += value
        factor, info = lapack.dpotrf(matrix[old, old], lower=1)
        if info:
            raise ArithmeticError(f"the normal matrix is not positive definite ({info})")
        coupling = np.column_stack((matrix[old, : 2 * size], vector[old]))
        told, _ = lapack.dtrtrs(factor, coupling, lower=1)
        between = told[:, :-1]
        return Prior(
            matrix[: 2 * size, : 2 * size] - between.T @ between,
            vector[: 2 * size] - between.T @ told[:, -1],
        )

    def _with_bones(
        self, terms: WindowTerms, frames: int | None = None
    ) -> tuple[Float[Array, "K B 3 3"], Float[Array, "K J 3 3"], Float[Array, "K J 3"]]:
        """Return the outer products of the bones, and the blocks and right-hand sides with them."""
        directions = terms.directions[:frames]
        outer = directions[..., :, None] * directions[..., None, :]
        flat = outer.reshape(*outer.shape[:2], 9)
        on_joints = (self.incidence @ flat).reshape(*flat.shape[:1], -1, 3, 3)
        pulled = self.sign @ (terms.pull[:frames, :, None] * directions)
        return outer, terms.blocks[:frames] + on_joints, terms.right[:frames] + pulled


_DIAGONAL = (0, 1, 2)


@lru_cache(maxsize=8)
def _lower(size: int, width: int) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Return where the lower triangle of a matrix is in it, and in a band of so many columns."""
    row, column = np.tril_indices(size)
    return row * size + column, column * width + row - column
