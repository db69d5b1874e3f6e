"""Cost, gradient and normal matrix of a rig under the robust loss, with the points eliminated
(Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.geometry.epipolar import cross_matrix

BEHIND = 1e4
"""Units of noise that an observation behind its camera counts as."""


@dataclass(frozen=True)
class Linearised:
    """A rig's state. Parameters of a view: a rotation vector w (radians, ``R exp([w]x)^T``: a turn
    of the camera about the world's axes) and its centre c (world).
    """

    scale: float
    """Of the Cauchy loss, units of noise."""
    cost: float
    """Sum of the Cauchy loss c^2 / 2 log(1 + r^2 / c^2) over the used observations, r in units."""
    finite: bool
    in_front: bool
    gain: float
    """What a full Gauss-Newton step would gain: half the squared length of the gradient in the
    inverse normal matrix. It is 0 at a minimum and the same in any gauge and unit.
    """
    matrix: Float[Tensor, "P P"]
    """Normal matrix of the P = 6 V parameters of the views, points eliminated; singular along the
    gauge's 7.
    """
    scores: Float[Tensor, "T P"]
    """Gradient of each frame's cost by the views' parameters, points eliminated."""


def linearise(
    observed: Correspondences, rig: PlacedRig, used: Bool[Tensor, "V N"], scale: float
) -> Linearised:
    """``scale``: of the Cauchy loss, units of noise. Not finite numbers give ``finite`` False and
    zeros.
    """
    used = used & rig.placed[:, None]
    views = len(rig.R)
    frames = int(observed.frame[-1]) + 1 if len(observed.frame) else 0
    nothing = (
        torch.zeros(6 * views, 6 * views, dtype=torch.float64),
        torch.zeros(frames, 6 * views, dtype=torch.float64),
    )
    chosen = used.any(0)
    inputs = (
        rig.R[rig.placed],
        rig.t[rig.placed],
        rig.points[chosen],
        observed.xy[:, chosen][used[:, chosen]],
    )
    if not (
        chosen.any() and all(torch.isfinite(x).all() and x.abs().max() < 1e100 for x in inputs)
    ):
        return Linearised(scale, float("inf"), False, False, float("inf"), *nothing)
    used = used[:, chosen]
    frame = observed.frame[chosen]
    centre = rig.centre
    arm = rig.points[chosen] - centre[:, None]
    x, y, z = (arm @ rig.R.mT).unbind(-1)
    front = used & (z > 0)
    depth = torch.where(front, z, 1.0)
    f = 1 / observed.noise[:, chosen]
    residual = (torch.stack((x, y), dim=-1) / depth[..., None] - observed.xy[:, chosen]) * f[
        ..., None
    ]
    residual = torch.where(front[..., None], residual, 0.0)
    square = torch.where(front, residual.square().sum(-1), torch.where(used, BEHIND**2, 0.0))
    cost = float((scale**2 / 2 * torch.log1p(square / scale**2)).sum())
    weight = torch.where(front, 1 / (1 + square / scale**2), 0.0)

    zero = torch.zeros_like(x)
    by_camera = torch.stack(
        (f / depth, zero, -f * x / depth**2, zero, f / depth, -f * y / depth**2), dim=-1
    )
    by_point = by_camera.unflatten(-1, (2, 3)) @ rig.R[:, None]
    by_view = torch.cat((by_point @ cross_matrix(arm), -by_point), dim=-1)
    Jp = by_point * weight[..., None, None]
    Jv = by_view * weight[..., None, None]
    r = residual
    Hpp = torch.einsum("vnri,vnrj->nij", Jp, by_point)
    gp = torch.einsum("vnri,vnr->ni", Jp, r)
    Hvp = torch.einsum("vnri,vnrj->nvij", Jv, by_point)
    gv = torch.einsum("vnri,vnr->nvi", Jv, r)
    Hvv = torch.einsum("vnri,vnrj->vij", Jv, by_view)
    inverse, solvable = _inverse(Hpp)
    right = torch.cat((Hvp.flatten(1, 2).mT, gp[..., None]), dim=-1)
    solved = inverse @ right
    matrix = torch.block_diag(*Hvv) - torch.einsum("nki,nkj->ij", right[..., :-1], solved[..., :-1])
    reduced = gv.flatten(1) - (right[..., :-1].mT @ solved[..., -1:])[..., 0]
    scores = nothing[1].index_add(0, frame, reduced)
    gain = float((gp * solved[..., -1]).sum() / 2) + _gain((matrix + matrix.T) / 2, scores.sum(0))
    finite = bool(torch.isfinite(matrix).all() and torch.isfinite(scores).all()) and gain < float(
        "inf"
    )
    return Linearised(
        scale,
        cost,
        finite,
        bool((front == used).all() and solvable.all()),
        gain,
        (matrix + matrix.T) / 2,
        scores,
    )


def _inverse(H: Float[Tensor, "N 3 3"]) -> tuple[Float[Tensor, "N 3 3"], Bool[Tensor, " N"]]:
    """Inverses of points' normal matrices; 0 where a point's rays do not fix it."""
    trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)
    safe = torch.where(trace > 0, trace, 1.0)[:, None, None]
    scaled = H / safe
    solvable = (trace > 0) & (torch.linalg.det(scaled) > 1e-18)
    eye = torch.eye(3, dtype=H.dtype)
    inverse, failed = torch.linalg.inv_ex(torch.where(solvable[:, None, None], scaled, eye))
    solvable = solvable & (failed == 0)
    return torch.where(solvable[:, None, None], inverse / safe, 0.0), solvable


def preconditioned(
    matrix: Float[Tensor, "P P"],
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, "P P"]]:
    """1 / sqrt of the diagonal (0 where it is 0), and eigenvalues and -vectors of the matrix scaled
    to diagonal 1: so radians and lengths compare.
    """
    diagonal = matrix.diagonal()
    scale = torch.where(diagonal > 0, diagonal.clamp_min(1e-300).rsqrt(), 0.0)
    values, vectors = torch.linalg.eigh(matrix * scale * scale[:, None])
    return scale, values, vectors


def _gain(matrix: Float[Tensor, "P P"], gradient: Float[Tensor, " P"]) -> float:
    if not (torch.isfinite(matrix).all() and torch.isfinite(gradient).all()):
        return float("inf")
    scale, values, vectors = preconditioned(matrix)
    along = vectors.T @ (scale * gradient)
    known = values > 1e-10 * values[-1].clamp_min(1e-300)
    return float((along[known] ** 2 / values[known]).sum() / 2)
