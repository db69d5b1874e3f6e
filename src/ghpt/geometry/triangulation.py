"""Linear triangulation: batched, unit-invariant, and never spoilt by one bad joint.

The views' normal equations only have to be summed over the views of a subset, which is a matrix product, whatever
the number of subsets; then each joint is a 3x3 solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import (
    local_cameras,
    minors,
    solve_symmetric,
    usable_views,
    view_equations,
    view_rows,
)

NO_DEPTH = 1e-9
"""A depth below this fraction of |t| is rounding: the rays met in the camera's own centre."""


class Status(IntEnum):
    """Why a joint has no point. The first that applies, in the order NONFINITE_INPUT, FEW_VIEWS, PARALLEL,
    BEHIND, NOT_CONVERGED."""

    OK = 0
    FEW_VIEWS = 1
    """Fewer than two views are used."""
    PARALLEL = 2
    """The used rays do not fix a point: parallel, along their baseline, or from one and the same centre."""
    BEHIND = 3
    """The point is not in front of every used camera."""
    NONFINITE_INPUT = 4
    """A used key point, weight or camera is not finite, absurdly large (``LARGEST``) or not a camera at all
    (R not a rotation, focal length not positive)."""
    NOT_CONVERGED = 5
    """An iterative estimator stopped at its limit; the point is its last."""


@dataclass(frozen=True)
class Triangulation:
    """Points and what is known of them; every field is finite but ``cond``, which is inf for no unique point."""

    points: Float[Tensor, "*B J 3"]
    """World frame, mm, float64; 0 where not ``ok``."""
    status: Int8[Tensor, "*B J"]
    angle: Float[Tensor, "*B J"]
    """Radians in [0, pi/2]: the arc sine of the root mean square, over the pairs of used views, of the sine
    between their rays. For two views it is the (acute) angle between the two rays."""
    depth_min: Float[Tensor, "*B J"]
    """Smallest depth over the used views, mm; 0 where there is no point to measure it for."""
    cond: Float[Tensor, "*B J"]
    """tr(M) tr(M^-1) of the normal equations: at least their condition number, at most 9 times it."""

    @property
    def ok(self) -> Bool[Tensor, "*B J"]:
        return self.status == Status.OK


def _ray_angle(cameras: Cameras, key_points: Tensor, used: Bool[Tensor, "*B V J"]) -> Float[Tensor, "*B J"]:
    """``Triangulation.angle``: the sum of |d_i x d_j|^2 over pairs is the sum of the principal minors of
    the sum of d d^T (Cauchy-Binet)."""
    rays = torch.cat((key_points, torch.ones_like(key_points[..., :1])), dim=-1)
    rays = rays @ (torch.linalg.inv_ex(cameras.K).inverse.mT @ cameras.R)
    rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    x, y, z = torch.where(used[..., None], rays, 0.0).unbind(-1)
    areas = minors(tuple(product.sum(-2) for product in (x * x, x * y, x * z, y * y, y * z, z * z)))
    count = used.sum(-2)
    pairs = (count * (count - 1) / 2).clamp(min=1)
    return ((areas[0] + areas[3] + areas[5]) / pairs).clamp(0, 1).sqrt().asin()


def _one_centre(
    cameras: Cameras, distance: Float[Tensor, "*B V"], used: Bool[Tensor, "*B V J"]
) -> Bool[Tensor, "*B J"]:
    """Whether the used cameras have one and the same centre, within the rounding of their world's distances."""
    centre = cameras.centre[..., None, :]
    spread = torch.where(used[..., None], centre, -torch.inf).amax(-3)
    spread = spread - torch.where(used[..., None], centre, torch.inf).amin(-3)
    return (spread <= 1e-12 * distance.amax(-1)[..., None, None]).all(-1)


def triangulate(
    cameras: Cameras, key_points: Float[Tensor, "*B V J 2"], weights: Float[Tensor, "*B V J"]
) -> Triangulation:
    """The points that minimise the sum over views of weight x (depth x pixel error)^2.

    A view with weight 0 (or less) is not used, and whatever its numbers are they change nothing. Never raises
    on values; a joint's result depends on its own inputs only.
    """
    chosen = ~(weights <= 0)
    used = chosen & usable_views(cameras, key_points) & (weights < torch.inf)
    spoilt = (chosen & ~used).any(-2)
    local, origin = local_cameras(cameras)
    safe = torch.where(used[..., None], key_points.to(torch.float64), 0.0)
    weight = torch.where(used, weights.to(torch.float64), 0.0)
    largest = weight.amax(dim=-2, keepdim=True)
    weight = weight / torch.where(largest > 0, largest, 1.0)

    rows, right = view_rows(local, safe)
    scaled = rows * weight[..., None, None]
    matrix = torch.stack([(scaled[..., i] * rows[..., j]).sum((-3, -1)) for i in range(3) for j in range(i, 3)])
    solution = torch.zeros((*weight.shape[:-2], weight.shape[-1], 3), dtype=torch.float64, device=weight.device)
    for _ in range(2):  # once more from the residuals of the rows: the digits that squaring has cost
        residual = right - (rows * solution[..., None, :, None, :]).sum(-1)
        toward = (scaled * residual[..., None]).sum((-4, -2))
        *step, cond = solve_symmetric((*matrix.unbind(0), *toward.unbind(-1)))
        solution = solution + torch.stack(step, dim=-1)

    depth = (local.R[..., None, 2, :] * solution[..., None, :, :]).sum(-1) + local.t[..., None, 2]
    distance = torch.where(used.any(-1)[..., None], cameras.t.to(torch.float64), 0.0).norm(dim=-1)
    few = used.sum(-2) < 2
    parallel = torch.isinf(cond) | _one_centre(local, distance, used)
    behind = (used & ~(depth > NO_DEPTH * distance[..., None])).any(-2)
    status = torch.full(few.shape, int(Status.OK), dtype=torch.int8, device=few.device)
    for mask, reason in (
        (behind, Status.BEHIND), (parallel, Status.PARALLEL), (few, Status.FEW_VIEWS),
        (spoilt, Status.NONFINITE_INPUT),
    ):  # fmt: skip
        status = torch.where(mask, int(reason), status)
    measured = (status == Status.OK) | (status == Status.BEHIND)
    return Triangulation(
        points=torch.where((status == Status.OK)[..., None], solution + origin[..., None, :], 0.0),
        status=status.to(torch.int8),
        angle=_ray_angle(local, safe, used),
        depth_min=torch.where(measured, torch.where(used, depth, torch.inf).amin(-2), 0.0),
        cond=cond,
    )


@torch.no_grad()
def triangulate_subsets(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    seen: Bool[Tensor, "B V J"],
    subsets: Bool[Tensor, "B H J V"],
) -> tuple[Float[Tensor, "B H J 3"], Bool[Tensor, "B H J"]]:
    """Triangulate each joint of each hypothesis from its own subset of views (paper, section 3.1).

    Returns points (world, mm, float64; 0 where not ok) and whether they are ok: two views or more, all of
    them seen and finite, rays that fix a point, in front of every camera of the subset. Few views: each of
    the 2^V subsets is triangulated once and looked up; many views: the cost grows with V and never with 2^V.
    """
    views, hypotheses = subsets.shape[-1], subsets.shape[1]
    usable = seen & usable_views(cameras, key_points)
    local, origin = local_cameras(cameras)
    equations = view_equations(local, key_points, usable).transpose(1, 2)
    floor = NO_DEPTH * torch.linalg.vector_norm(cameras.t.to(torch.float64), dim=-1).nan_to_num(0.0)
    depth_rows = torch.cat((local.R[..., 2, :], (local.t[..., 2] - floor)[..., None]), dim=-1)
    usable = usable.transpose(1, 2)
    if 2**views > hypotheses:
        points, ok = _solve_subsets(equations, depth_rows, usable, subsets.permute(0, 2, 1, 3))
        points, ok = points.permute(0, 3, 1, 2), ok.transpose(1, 2)
    else:
        bit = 1 << torch.arange(views, device=subsets.device)
        every = (torch.arange(2**views, device=subsets.device)[:, None] & bit) != 0
        points, ok = _solve_subsets(equations, depth_rows, usable, every.expand(*usable.shape[:2], -1, -1))
        code = (subsets * bit).sum(-1)
        ok = ok.transpose(1, 2).gather(1, code)
        points = points.permute(0, 3, 1, 2).gather(1, code[..., None].expand(-1, -1, -1, 3))
    return torch.where(ok[..., None], points + origin[:, None, None], 0.0), ok


def _solve_subsets(
    equations: Float[Tensor, "B J V 9"],
    depth_rows: Float[Tensor, "B V 4"],
    usable: Bool[Tensor, "B J V"],
    subsets: Bool[Tensor, "B J H V"],
) -> tuple[Float[Tensor, "B J 3 H"], Bool[Tensor, "B J H"]]:
    chosen = subsets.mT.contiguous()
    summed = equations.mT @ chosen.to(torch.float64)
    *solution, cond = solve_symmetric(summed.unbind(-2))
    points = torch.stack(solution, dim=-2)
    depth = depth_rows[:, None, :, :3] @ points + depth_rows[:, None, :, 3:]
    good = (depth > 0) & usable[..., None]
    enough = chosen.sum(-2) >= 2
    return points, enough & torch.isfinite(cond) & (good | ~chosen).all(-2)
