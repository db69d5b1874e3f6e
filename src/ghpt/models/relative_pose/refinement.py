"""Relative poses refined to the most likely one of all correspondences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.epipolar import cross_matrix, essential, homogeneous, sampson_jacobian
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.observations import PairObservations, RelativePoseEstimate

_QUARTILE = 0.3186
"""Of the absolute value of a standard normal variable."""
_MEDIAN = 0.6745
_DAMPING = 1e-9
"""Of the diagonal of the normal matrix: keeps it regular where nothing determines a parameter."""
_SETTLED = 8
"""Rounds after which the deviations stay."""


@dataclass(frozen=True)
class PoseRefinement:
    """Gauss and Newton's method for the robust Sampson distances of all correspondences.

    A distance r weighs ``(1 + (r / (kernel x deviation))^2)^-2`` (Geman-McClure) over the squared
    deviation. Each joint has its own, measured on its distances in all frames: hips are found worse
    than wrists. It starts at their first quartile, which many outliers leave alone, and is then
    told by the median of those below ``trim`` deviations. ``rounds`` of 5 unknowns, batched.
    """

    kernel: float
    trim: float
    rounds: int

    def __post_init__(self) -> None:
        check_positive(kernel=self.kernel, trim=self.trim)
        check(self.rounds >= 1, "rounds", f"is {self.rounds}", "It must be >= 1.")

    @torch.no_grad()
    def __call__(
        self, estimate: RelativePoseEstimate, observations: PairObservations
    ) -> RelativePoseEstimate:
        """Return poses nearby with t of the same length; those that are not estimated stay."""
        a, b, both = observations.correspondences()
        if not both.any():
            return estimate
        joints = observations.key_points.shape[-2]
        used = both.unflatten(-1, (-1, joints))
        length = estimate.t.double().norm(dim=-1, keepdim=True)
        R = estimate.R.double()
        t = estimate.t.double() / torch.where(length > 0, length, 1.0)
        rays = (homogeneous(a.double()), homogeneous(b.double()))
        deviation = None
        for number in range(self.rounds):
            distance, jacobian = sampson_jacobian(essential(R, t), *rays)
            if deviation is None or number < _SETTLED:
                of_joints = distance.abs().unflatten(-1, (-1, joints))
                deviation = self._deviation(of_joints, used, deviation)
            every = deviation.expand(used.shape).flatten(1)
            robust = 1 + (distance / (self.kernel * every)).square()
            weight = both / (robust * every).square()
            R, t = _step(R, t, distance, jacobian, weight)
        moved = estimate.estimated & R.isfinite().all(-1).all(-1) & t.isfinite().all(-1)
        R = torch.where(moved[:, None, None], R, estimate.R.double())
        t = torch.where(moved[:, None], t * length, estimate.t.double())
        return replace(estimate, R=R.to(estimate.R), t=t.to(estimate.t))

    def _deviation(
        self,
        distance: Float[Tensor, "B M J"],
        used: Bool[Tensor, "B M J"],
        previous: Float[Tensor, "B 1 J"] | None,
    ) -> Float[Tensor, "B 1 J"]:
        """Return the deviation of each joint's distances; the median joint's where it has none."""
        if previous is None:
            known = torch.where(used, distance, torch.nan)
            own = torch.nanquantile(known, 0.25, dim=1, keepdim=True) / _QUARTILE
        else:
            inside = used & (distance < self.trim * previous)
            known = torch.where(inside, distance, torch.nan)
            own = known.nanmedian(dim=1, keepdim=True).values / _MEDIAN
        tiny = torch.finfo(own.dtype).eps
        typical = own.nanmedian(dim=-1, keepdim=True).values.nan_to_num(1.0)
        return torch.where(own.isnan(), typical, own).clamp_min(tiny)


def _step(
    R: Float[Tensor, "B 3 3"],
    t: Float[Tensor, "B 3"],
    distance: Float[Tensor, "B N"],
    jacobian: Float[Tensor, "B N 9"],
    weight: Float[Tensor, "B N"],
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """Return the poses after one step over 3 parameters of R and 2 of t's direction."""
    largest = weight.amax(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
    weighted = (weight / largest)[..., None] * jacobian
    normal = weighted.mT @ jacobian
    gradient = (weighted * distance[..., None]).sum(-2)
    across = _tangents(t)
    generators = cross_matrix(torch.eye(3, dtype=t.dtype, device=t.device))
    turned = cross_matrix(t)[:, None] @ generators @ R[:, None]
    moved = cross_matrix(across.mT) @ R[:, None]
    along = torch.cat((turned, moved), dim=1).flatten(-2).mT
    small = along.mT @ normal @ along
    diagonal = small.diagonal(dim1=-2, dim2=-1)
    small = small + torch.diag_embed(_DAMPING * diagonal + torch.finfo(t.dtype).tiny)
    step, _ = torch.linalg.solve_ex(small, -along.mT @ gradient[..., None])
    R = vector_to_matrix(step[:, :3, 0]) @ R
    t = t + (across @ step[:, 3:])[..., 0]
    return R, t / t.norm(dim=-1, keepdim=True)


def _tangents(t: Float[Tensor, "B 3"]) -> Float[Tensor, "B 3 2"]:
    """Return two directions across each t, orthonormal."""
    axis = torch.nn.functional.one_hot(t.abs().argmin(-1), 3).to(t)
    first = torch.nn.functional.normalize(torch.linalg.cross(t, axis), dim=-1)
    second = torch.linalg.cross(t, first)
    return torch.stack((first, second), dim=-1)
