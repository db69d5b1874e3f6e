"""The normal equations of all joints of a person through time, and their solution.

The unknowns are 3 J T numbers. In a frame a joint is tied to its key points (a 3x3 block) and to
its neighbours by bones; through time it is tied to itself, at most two frames away. With the joints
of a group next to each other the matrix of a group is banded, and its Cholesky factor costs
O(T n^3). The groups are made so that the bones between them lead from an even group to an odd one
(`BodyGroups`): the odd groups are eliminated, and what is left of the even ones is solved by
conjugate gradients. That is linear in the number of joints, and exact for one group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import lapack
from torch import Tensor

from ghpt.models.estimators.trajectory.groups import BodyGroups, Bones

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Places of the elements xx xy xz yy yz zz of a symmetric matrix."""


@dataclass(frozen=True)
class TimeCoupling:
    """What ties a joint to itself through time, the same for its three coordinates."""

    own: Float[Tensor, "J T"]
    """Elements on the diagonal."""
    next: Float[Tensor, "J T"]
    """Elements between frames t and t + 1."""
    second: Float[Tensor, "J T"]
    """Elements between frames t and t + 2."""


@dataclass(frozen=True)
class NormalEquations:
    """The matrix and the right-hand side of the least squares problem."""

    blocks: Float[Tensor, "6 J T"]
    """xx xy xz yy yz zz of what each joint is tied to on its own, its bones included."""
    right: Float[Tensor, "3 J T"]
    time: TimeCoupling
    bones: Float[Tensor, "3 B T"]
    """The direction of each bone times the square root of its precision."""


@dataclass(frozen=True)
class ConjugateGradients:
    """When the iteration over the bones between groups ends."""

    tolerance: float
    """Largest last step of a coordinate, mm."""
    iterations: int


def solve(
    equations: NormalEquations,
    skeleton: Bones,
    groups: BodyGroups,
    start: Float[Tensor, "3 J T"],
    limit: ConjugateGradients,
) -> Float[Tensor, "3 J T"]:
    """Return the solution.

    ``skeleton``: the bones, whose ``groups`` these are. ``start``: a position near the solution.
    Raises ArithmeticError where the matrix is not positive definite.
    """
    even = Factor(groups.even, equations, skeleton, groups.inner)
    solution = torch.empty_like(equations.right)
    if not groups.odd:
        solution[:, even.joints] = even.solve(equations.right[:, even.joints])
        return solution
    odd = Factor(groups.odd, equations, skeleton, groups.inner)
    links = _Links(equations.bones, skeleton, groups.outer, even.joints, odd.joints)
    right_even = equations.right[:, even.joints]
    right_odd = equations.right[:, odd.joints]

    def eliminate(x: Float[Tensor, "3 E T"]) -> Float[Tensor, "3 E T"]:
        return links.to_even(odd.solve(links.to_odd(x)))

    # The image of x under the even groups' own matrix is carried along and never computed.
    image = right_even + links.to_even(start[:, odd.joints])
    x = even.solve(image)
    residual = right_even + links.to_even(odd.solve(right_odd + links.to_odd(x))) - image
    direction = even.solve(residual)
    image = residual.clone()
    energy = (residual * direction).sum()
    for _ in range(limit.iterations):
        forward = image - eliminate(direction)
        curvature = (direction * forward).sum()
        if not curvature > 0:
            break
        step = energy / curvature
        x += step * direction
        residual -= step * forward
        if float(step * direction.abs().max()) < limit.tolerance:
            break
        improved = even.solve(residual)
        next_energy = (residual * improved).sum()
        ratio = next_energy / energy
        energy = next_energy
        direction = improved + ratio * direction
        image = residual + ratio * image
    solution[:, even.joints] = x
    solution[:, odd.joints] = odd.solve(right_odd + links.to_odd(x))
    return solution


class _InnerBones:
    """The elements that bones within groups have between their two joints."""

    def __init__(self, bones: Float[Tensor, "3 B T"], skeleton: Bones, inner: Sequence[int]):
        chosen = bones[:, list(inner)].numpy()
        self.elements = [chosen[i] * chosen[k] for i, k in UPPER]
        self.ends = [skeleton[bone] for bone in inner]


class _Links:
    """The bones between even and odd groups as a map from one half to the other."""

    def __init__(
        self,
        bones: Float[Tensor, "3 B T"],
        skeleton: Bones,
        outer: Sequence[int],
        even: Sequence[int],
        odd: Sequence[int],
    ) -> None:
        self.bones = bones[:, list(outer)]
        self.even = bones.new_zeros(len(even), len(outer))
        self.odd = bones.new_zeros(len(odd), len(outer))
        for column, bone in enumerate(outer):
            for joint in skeleton[bone]:
                if joint in even:
                    self.even[even.index(joint), column] = 1
                else:
                    self.odd[odd.index(joint), column] = 1

    def to_odd(self, x: Float[Tensor, "3 E T"]) -> Float[Tensor, "3 O T"]:
        return self._project(x, self.even, self.odd)

    def to_even(self, x: Float[Tensor, "3 O T"]) -> Float[Tensor, "3 E T"]:
        return self._project(x, self.odd, self.even)

    def _project(self, x: Tensor, source: Tensor, target: Tensor) -> Tensor:
        along = (self.bones * (source.T @ x)).sum(0)
        return target @ (self.bones * along)


class Factor:
    """Cholesky factors of groups; those of one size share a matrix.

    Vectors are [3, J', T] with the joints in the order of ``joints``. ``inner``: the indices of the
    bones of the ``skeleton`` that are within groups. Raises ArithmeticError where a matrix is not
    positive definite.
    """

    def __init__(
        self,
        groups: Sequence[Sequence[int]],
        equations: NormalEquations,
        skeleton: Bones,
        inner: Sequence[int],
    ) -> None:
        bones = _InnerBones(equations.bones, skeleton, inner)
        sizes = sorted({len(group) for group in groups})
        self.joints: list[int] = []
        self.parts: list[tuple[np.ndarray, slice, int]] = []
        for size in sizes:
            equal = [group for group in groups if len(group) == size]
            first = len(self.joints)
            self.joints += [joint for group in equal for joint in group]
            band = _band(np.array(equal), equations, bones)
            factor, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
            if info:
                raise ArithmeticError(f"the normal matrix is not positive definite ({info})")
            self.parts.append((factor, slice(first, len(self.joints)), size))

    def solve(self, right: Float[Tensor, "3 K T"]) -> Float[Tensor, "3 K T"]:
        solution = torch.empty_like(right)
        frames = right.shape[-1]
        for factor, joints, size in self.parts:
            columns = right[:, joints].unflatten(1, (-1, size)).permute(1, 3, 2, 0)
            x, _ = lapack.dpbtrs(factor, columns.reshape(-1).numpy(), lower=1)
            found = torch.from_numpy(x).view(-1, frames, size, 3)
            solution[:, joints] = found.permute(3, 0, 2, 1).flatten(1, 2)
        return solution


def _band(groups: np.ndarray, equations: NormalEquations, inner: _InnerBones) -> np.ndarray:
    """Return the lower band of the matrices of equal groups [G, n], one after the other.

    Element [d, i] is that of row i + d and column i. Columns run over the groups, the frames, the
    joints of the group and their coordinates.
    """
    count, size = groups.shape
    frames = equations.right.shape[-1]
    band = np.zeros((count, frames, size, 3, 6 * size + 1))

    def of_groups(values: Tensor) -> np.ndarray:
        return values.numpy()[groups].transpose(0, 2, 1)

    own = of_groups(equations.time.own)
    for element, (row, column) in zip(equations.blocks, UPPER, strict=True):
        values = of_groups(element)
        band[..., row, column - row] = values + own if row == column else values
    _add_inner_bones(band, groups, inner)
    band[..., 3 * size] += of_groups(equations.time.next)[..., None]
    band[..., 6 * size] = of_groups(equations.time.second)[..., None]
    return band.reshape(-1, band.shape[-1]).T


def _add_inner_bones(band: np.ndarray, groups: np.ndarray, inner: _InnerBones) -> None:
    place = {
        int(joint): (group, at) for group, row in enumerate(groups) for at, joint in enumerate(row)
    }
    for bone, ends in enumerate(inner.ends):
        if ends[0] not in place:
            continue
        group, one = place[ends[0]]
        _, other = place[ends[1]]
        low, high = sorted((one, other))
        for values, (row, column) in zip(inner.elements, UPPER, strict=True):
            distance = 3 * (high - low)
            band[group, :, low, row, distance + column - row] = -values[bone]
            if row != column:
                band[group, :, low, column, distance + row - column] = -values[bone]
