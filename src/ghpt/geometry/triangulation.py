"""Linear triangulation: batched, unit-invariant, and never spoilt by one bad joint.

The views' normal equations only have to be summed over the views of a subset, which is a matrix
product, whatever the number of subsets; then each joint is a 3x3 solve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import (
    LARGEST,
    Views,
    local_cameras,
    minors,
    products,
    solve_symmetric,
    usable_views,
    valid_cameras,
    view_equations,
    views_of,
    weighted_sum,
)
from ghpt.geometry.state import State

NO_DEPTH = 1e-9
"""A depth below this fraction of |t| is rounding: the rays met in the camera's own centre."""

_AT_ONCE = 2**15
"""Key points that are worked on at once: few enough to stay in a processor's cache."""


@dataclass(frozen=True)
class Triangulation:
    """Points and what is known of them; every field is finite but ``cond``, which is inf for no
    unique point.
    """

    points: Float[Tensor, "*B J 3"]
    """World frame, mm, float64; 0 where not ``ok``."""
    status: Int8[Tensor, "*B J"]
    """Values of ``State``."""
    angle: Float[Tensor, "*B J"]
    """Radians in [0, pi/2]: the arc sine of the root mean square, over the pairs of used views, of
    the sine between their rays. For two views it is the (acute) angle between the two rays.
    """
    depth_min: Float[Tensor, "*B J"]
    """Smallest depth over the used views, mm; 0 where there is no point to measure it for."""
    cond: Float[Tensor, "*B J"]
    """tr(M) tr(M^-1) of the normal equations: at least their condition number, at most 9 times it.
    """

    @property
    def ok(self) -> Bool[Tensor, "*B J"]:
        return self.status == State.OBSERVED

    @property
    def has_position(self) -> Bool[Tensor, "*B J"]:
        """The joints that have a point: those that are ``ok`` or did not converge."""
        return self.status <= State.FILLED

    def with_rows(self, rows: Int[Tensor, " b"], part: Triangulation) -> Triangulation:
        """This, with ``part`` in these rows of the first dimension."""
        return Triangulation(
            *(
                getattr(self, f.name).index_copy(0, rows, getattr(part, f.name))
                for f in fields(self)
            )
        )


def triangulate(
    cameras: Cameras, key_points: Float[Tensor, "*B V J 2"], weights: Float[Tensor, "*B V J"]
) -> Triangulation:
    """The points that minimise the sum over views of weight x (depth x pixel error)^2.

    A view with weight 0 (or less) is not used, and whatever its numbers are they change nothing.
    Never raises on values; a joint's result depends on its own inputs only.
    """
    lead = weights.shape[:-2]
    (views, joints) = weights.shape[-2:]
    rig = flat_cameras(cameras, lead)
    frames = lead.numel()
    key_points = key_points.reshape(frames, views, joints, 2)
    weights = weights.reshape(frames, views, joints)

    def part(rows: slice) -> tuple[Tensor, ...]:
        weight = weights[rows].permute(1, 2, 0)
        chosen = ~(weight <= 0)
        system = System(
            rig if len(rig.t) == 1 else rig.index(rows),
            key_points[rows],
            chosen & (weight < torch.inf),
        )
        weight = torch.where(system.used, weight.to(torch.float64), 0.0)
        largest = weight.amax(dim=0) if len(weight) else weight.sum(0)
        solution = system.solve(weight / torch.where(largest > 0, largest, 1.0))
        return system.fields(*solution, system.used, (chosen & ~system.used).any(0))

    fields = in_parts(part, weights.shape)
    return Triangulation(*(x.reshape(*lead, *x.shape[1:]) for x in fields))


def in_parts(function: Callable[[slice], tuple[Tensor, ...]], shape: torch.Size) -> list[Tensor]:
    """What ``function`` gives for all frames of [B, V, J], a few frames at a time."""
    frames, views, joints = shape
    size = max(1, _AT_ONCE // max(views * joints, 1))
    parts = [function(slice(start, start + size)) for start in range(0, max(frames, 1), size)]
    return [torch.cat(field) if len(parts) > 1 else field[0] for field in zip(*parts, strict=True)]


def flat_cameras(cameras: Cameras, lead: torch.Size) -> Cameras:
    """Cameras with the leading dimensions as one; of length 1 where all frames share one rig in
    memory.
    """
    views = cameras.t.shape[-2]
    fields = []
    for x, inner in ((cameras.K, 2), (cameras.R, 2), (cameras.t, 1)):
        fields.append(x.expand(*lead, views, *x.shape[-inner:]))
    frames = lead.numel()
    if frames > 1 and not any(any(x.stride()[: len(lead)]) for x in fields):
        return Cameras(*(x[(0,) * len(lead)][None] for x in fields))
    return Cameras(*(x.reshape(frames, *x.shape[len(lead) :]) for x in fields))


class System:
    """The equations of a few frames, made once for any weights; arrays are [V, J, B]."""

    def __init__(
        self, cameras: Cameras, key_points: Float[Tensor, "B V J 2"], given: Bool[Tensor, "V J B"]
    ) -> None:
        valid = valid_cameras(cameras)
        self.local, self.origin = local_cameras(cameras, valid)
        finite = (key_points.abs() <= LARGEST).permute(3, 1, 2, 0)
        self.used = given & finite[0] & finite[1] & valid.mT[:, None]
        self.views = views_of(self.local, key_points, self.used)
        self.a, self.b = self.views.rows()
        self.equations = products(self.a, self.b)
        self.length = torch.linalg.vector_norm(
            torch.where(valid[..., None], cameras.t.to(torch.float64), 0.0), dim=-1
        )

    def solve(
        self, weight: Float[Tensor, "V J B"]
    ) -> tuple[Sequence[Tensor], Float[Tensor, "J B"]]:
        """The solution in the local world and tr(M) tr(M^-1); ``weight`` is 0 where not ``used``."""
        sums = weighted_sum(self.equations, weight)
        *solution, cond = solve_symmetric(tuple(sums))
        # once more from the residuals of the rows: the digits that squaring has cost
        toward = weighted_sum(_toward(self.a, self.b, solution), weight)
        step = solve_symmetric((*sums[:6], *toward))[:3]
        return [x + d for x, d in zip(solution, step, strict=True)], cond

    def square_residuals(
        self, points: Float[Tensor, "3 *P J B"], square: Float[Tensor, "V J B"], view: int
    ) -> Float[Tensor, "*P J B"]:
        """Squared pixel errors of points (local world) in one view over ``square``; inf where that
        is 0 and behind the camera.
        """
        x, y, z = points
        over, down = (
            torch.addcmul(r[0][view] * x, r[1][view], y).addcmul_(r[2][view], z)
            for r in (self.a, self.b)
        )
        over = over.sub_(self.a[3][view])
        down = down.sub_(self.b[3][view])
        (rx, ry, rz) = self.views.axis
        shift = self.views.shift[2]
        depth = (
            torch.addcmul(shift[view], rx[view], x)
            .addcmul_(ry[view], y)
            .addcmul_(rz[view], z)
            .clamp_(min=0)
        )
        scale = depth.mul_(depth).mul_(square[view])
        return (
            over.mul_(over)
            .addcmul_(down, down)
            .div_(scale)
            .nan_to_num_(nan=torch.inf, posinf=torch.inf)
        )

    def fields(
        self,
        solution: Sequence[Tensor],
        cond: Tensor,
        used: Bool[Tensor, "V J B"],
        spoilt: Bool[Tensor, "J B"],
    ) -> tuple[Tensor, ...]:
        """The fields of Triangulation of a solution that is made of the ``used`` views."""
        count = used.sum(0)
        depth = self.views.depth(*solution)
        distance = torch.where(used.any(1), self.length.mT, 0.0)[:, None]
        parallel = torch.isinf(cond) | _one_centre(self.local, distance, used)
        behind = (used & ~(depth > NO_DEPTH * distance)).any(0)
        status = torch.full_like(count, int(State.OBSERVED), dtype=torch.int8)
        for mask, reason in (
            (behind, State.BEHIND),
            (parallel, State.PARALLEL),
            (count < 2, State.FEW_VIEWS),
            (spoilt, State.BAD_INPUT),
        ):
            status = status.masked_fill(mask, int(reason))
        ok = status == State.OBSERVED
        nearest = (
            torch.where(used, depth, torch.inf).amin(0) if len(depth) else torch.zeros_like(cond)
        )
        nearest = torch.where(ok | (status == State.BEHIND), nearest, 0.0)
        world = [torch.where(ok, x + o, 0.0) for x, o in zip(solution, self.origin.mT, strict=True)]
        angle = _ray_angle(self.local, self.views, used, count)
        return (
            torch.stack(world, -1).transpose(0, 1),
            *(x.mT for x in (status, angle, nearest, cond)),
        )


def _toward(
    a: Sequence[Tensor], b: Sequence[Tensor], solution: Sequence[Tensor]
) -> Float[Tensor, "V 3 J B"]:
    """The right-hand sides of the views' equations for a step from ``solution``."""
    over, down = (
        r[3] - (r[0] * solution[0] + r[1] * solution[1] + r[2] * solution[2]) for r in (a, b)
    )
    return torch.stack([torch.addcmul(a[i] * over, b[i], down) for i in range(3)], dim=1)


def _ray_angle(
    cameras: Cameras, views: Views, used: Bool[Tensor, "V J B"], count: Int[Tensor, "J B"]
) -> Float[Tensor, "J B"]:
    """``Triangulation.angle``: the sum of |d_i x d_j|^2 over pairs is the sum of the principal
    minors of the sum of d d^T (Cauchy-Binet).
    """
    (k, s), (n, m) = cameras.K.permute(2, 3, 1, 0)[:2, :2, :, None].contiguous()
    determinant = k * m - s * n
    determinant = torch.where(determinant == 0, 1.0, determinant)
    x = (m * views.u - s * views.v) / determinant
    y = (k * views.v - n * views.u) / determinant
    first, second, third = cameras.R.permute(2, 3, 1, 0)[..., None, :].contiguous()
    ray = [
        torch.addcmul(torch.addcmul(r, q, y), p, x)
        for p, q, r in zip(first, second, third, strict=True)
    ]
    outer = torch.stack([ray[i] * ray[j] for i in range(3) for j in range(i, 3)], dim=1)
    share = used / (outer[:, 0] + outer[:, 3] + outer[:, 5])
    areas = minors(tuple(weighted_sum(outer, share)))
    pairs = (count * (count - 1) / 2).clamp(min=1)
    return ((areas[0] + areas[3] + areas[5]) / pairs).clamp(0, 1).sqrt().asin()


def _one_centre(
    cameras: Cameras, distance: Float[Tensor, "V 1 B"], used: Bool[Tensor, "V J B"]
) -> Bool[Tensor, "J B"]:
    """Whether the used cameras have one and the same centre, within the rounding of their world's
    distances.
    """
    centre = cameras.centre.permute(2, 1, 0)
    if not len(used):
        return torch.ones(used.shape[1:], dtype=torch.bool, device=used.device)
    limit = 1e-12 * distance.amax(0)
    if not (
        centre[0].sort(0).values.diff(dim=0) <= limit
    ).any():  # no two cameras can have: nothing to do
        return torch.zeros(used.shape[1:], dtype=torch.bool, device=used.device)
    one = torch.ones(used.shape[1:], dtype=torch.bool, device=used.device)
    for x in centre[..., None, :]:
        spread = torch.where(used, x, -torch.inf).amax(0) - torch.where(used, x, torch.inf).amin(0)
        one &= spread <= limit
    return one


@torch.no_grad()
def triangulate_subsets(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "B V J"],
    subsets: Bool[Tensor, "B H J V"],
) -> tuple[Float[Tensor, "B H J 3"], Bool[Tensor, "B H J"]]:
    """Triangulate each joint of each hypothesis from its own subset of views (paper, section 3.1).

    Returns points (world, mm, float64; 0 where not ok) and whether they are ok: two views or more,
    all of them seen and finite, rays that fix a point, in front of every camera of the subset. Few
    views: each of the 2^V subsets is triangulated once and looked up; many views: the cost grows
    with V and never with 2^V.
    """
    views = subsets.shape[-1]
    hypotheses = subsets.shape[1]
    usable = valid & usable_views(cameras, key_points)
    local, origin = local_cameras(cameras)
    equations = view_equations(local, key_points, usable).transpose(1, 2)
    floor = NO_DEPTH * torch.linalg.vector_norm(cameras.t.to(torch.float64), dim=-1).nan_to_num(0.0)
    depth_rows = torch.cat((local.R[..., 2, :], (local.t[..., 2] - floor)[..., None]), dim=-1)
    usable = usable.transpose(1, 2)
    if 2**views > hypotheses:
        points, ok = _solve_subsets(equations, depth_rows, usable, subsets.permute(0, 2, 1, 3))
        points = points.permute(0, 3, 1, 2)
        ok = ok.transpose(1, 2)
    else:
        bit = 1 << torch.arange(views, device=subsets.device)
        every = (torch.arange(2**views, device=subsets.device)[:, None] & bit) != 0
        points, ok = _solve_subsets(
            equations, depth_rows, usable, every.expand(*usable.shape[:2], -1, -1)
        )
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
