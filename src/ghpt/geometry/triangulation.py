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
from ghpt.geometry.masking import where
from ghpt.geometry.normal_equations import (
    LARGEST,
    Row,
    ViewComponents,
    form_equations,
    local_cameras,
    minors,
    solve_symmetric,
    valid_cameras,
    valid_key_points,
    view_components,
    view_equations,
    weighted_sum,
)
from ghpt.geometry.state import State

NO_DEPTH = 1e-9
"""A depth below this fraction of |t| is rounding: the rays met in the camera's own centre."""

_ONE_CENTRE = 1e-12
"""Centres closer than this fraction of the largest |t| are one centre."""

_AT_ONCE = 2**15
"""Key points that are worked on at once: few enough to stay in a processor's cache."""


@dataclass(frozen=True)
class Triangulation:
    """Points and what is known of them.

    Every field is finite but ``cond``, which is inf for no unique point.
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

    def rows(self, rows: Int[Tensor, " b"]) -> Triangulation:
        """Return these rows of the first dimension."""
        return _map_fields(lambda x: x.index_select(0, rows), self)

    def with_rows(self, rows: Int[Tensor, " b"], part: Triangulation) -> Triangulation:
        """Return a copy with ``part`` in these rows of the first dimension."""
        return _map_fields(lambda x, y: x.index_copy(0, rows, y), self, part)

    def with_fallback(self, mask: Bool[Tensor, "*B J"], fallback: Triangulation) -> Triangulation:
        """Return a copy with ``fallback`` where ``mask`` is False."""
        return _map_fields(lambda x, y: where(mask, x, y), self, fallback)

    def with_joints(self, joints: Int[Tensor, " j"], part: Triangulation) -> Triangulation:
        """Return a copy with ``part`` in these joints of [B, J]."""
        return _map_fields(lambda x, y: x.index_copy(1, joints, y), self, part)

    def joints(self, joints: Int[Tensor, " j"]) -> Triangulation:
        """Return some of the joints of [B, J]."""
        return _map_fields(lambda x: x.index_select(1, joints), self)

    def unflatten(self, shape: torch.Size) -> Triangulation:
        """Return a copy whose first dimension has this shape."""
        return _map_fields(lambda x: x.reshape(*shape, *x.shape[1:]), self)


def _map_fields(function: Callable[..., Tensor], *results: Triangulation) -> Triangulation:
    """Return the results with ``function`` applied to each of their fields."""
    changed = {}
    for field in fields(Triangulation):
        values = [getattr(result, field.name) for result in results]
        changed[field.name] = function(*values)
    return Triangulation(**changed)


def triangulate(
    cameras: Cameras,
    key_points: Float[Tensor, "*B V J 2"],
    weights: Float[Tensor, "*B V J"],
) -> Triangulation:
    """Return the points that minimise the sum over views of weight x (depth x pixel error)^2.

    A view with weight 0 (or less) is not used, and whatever its numbers are they change nothing.
    Never raises on values; a joint's result depends on its own inputs only.
    """
    lead = weights.shape[:-2]
    views, joints = weights.shape[-2:]
    frames = lead.numel()
    rig = flat_cameras(cameras, lead)
    key_points = key_points.reshape(frames, views, joints, 2)
    weights = weights.reshape(frames, views, joints)

    def solve(rows: slice) -> Triangulation:
        weight = weights[rows].permute(1, 2, 0)
        return _solve_weighted(select_frames(rig, rows), key_points[rows], weight)

    return solve_in_parts(solve, weights.shape).unflatten(lead)


def _solve_weighted(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    weight: Float[Tensor, "V J B"],
) -> Triangulation:
    chosen = ~(weight <= 0)
    system = System(cameras, key_points, chosen & (weight < torch.inf))
    weight = torch.where(system.used, weight.double(), 0.0)
    largest = weight.amax(dim=0) if len(weight) else weight.sum(0)
    safe_largest = torch.where(largest > 0, largest, 1.0)
    solution, cond = system.solve(weight / safe_largest)
    rejected = (chosen & ~system.used).any(0)
    return system.assess(solution, cond, system.used, rejected)


def solve_in_parts(function: Callable[[slice], Triangulation], shape: torch.Size) -> Triangulation:
    """Return what ``function`` gives for all frames of [B, V, J], a few frames at a time."""
    frames, views, joints = shape
    size = max(1, _AT_ONCE // max(views * joints, 1))
    parts = []
    for start in range(0, max(frames, 1), size):
        rows = slice(start, start + size)
        parts.append(function(rows))
    return concatenate(parts)


def concatenate(parts: Sequence[Triangulation]) -> Triangulation:
    """Return successive parts of a batch as one."""
    if len(parts) == 1:
        return parts[0]
    return _map_fields(lambda *x: torch.cat(x), *parts)


def flat_cameras(cameras: Cameras, lead: torch.Size) -> Cameras:
    """Return cameras with the leading dimensions as one.

    It has length 1 where all frames share one rig in memory.
    """
    K = _expand(cameras.K, lead, 3)
    R = _expand(cameras.R, lead, 3)
    t = _expand(cameras.t, lead, 2)
    frames = lead.numel()
    shared = not any(any(x.stride()[: len(lead)]) for x in (K, R, t))
    if frames > 1 and shared:
        first = (0,) * len(lead)
        return Cameras(K[first][None], R[first][None], t[first][None])
    K = K.reshape(frames, *K.shape[-3:])
    R = R.reshape(frames, *R.shape[-3:])
    t = t.reshape(frames, *t.shape[-2:])
    return Cameras(K, R, t)


def _expand(x: Tensor, lead: torch.Size, inner: int) -> Tensor:
    """Return ``x`` expanded to the leading dimensions before its ``inner`` last ones."""
    return x.expand(*lead, *x.shape[-inner:])


def select_frames(rig: Cameras, rows: slice) -> Cameras:
    """Return the cameras of these frames; the rig itself where all frames share it."""
    return rig if len(rig.t) == 1 else rig.index(rows)


class System:
    """The equations of a few frames, made once for any weights; arrays are [V, J, B].

    ``shared_origin``: the local worlds of all frames are one.
    """

    def __init__(
        self,
        cameras: Cameras,
        key_points: Float[Tensor, "B V J 2"],
        valid: Bool[Tensor, "V J B"],
        shared_origin: bool = False,
    ) -> None:
        camera_valid = valid_cameras(cameras)
        self.local, self.origin = local_cameras(cameras, camera_valid, shared_origin)
        u_bounded, v_bounded = (key_points.abs() <= LARGEST).permute(3, 1, 2, 0)
        self.used = valid & u_bounded & v_bounded & camera_valid.mT[:, None]
        self.views = view_components(self.local, key_points, self.used)
        self.a, self.b = self.views.rows()
        self.equations = form_equations(self.a, self.b)
        t = where(camera_valid, cameras.t.double(), 0.0)
        self.length = torch.linalg.vector_norm(t, dim=-1)

    def solve(
        self,
        weight: Float[Tensor, "V J B"],
    ) -> tuple[Float[Tensor, "3 J B"], Float[Tensor, "J B"]]:
        """Return the solution in the local world and tr(M) tr(M^-1).

        ``weight`` is 0 where not ``used``.
        """
        sums = weighted_sum(self.equations, weight).unbind(0)
        x, y, z, cond = solve_symmetric(sums)
        # once more from the residuals of the rows: the digits that squaring has cost
        gradient = weighted_sum(_gradient(self.a, self.b, x, y, z), weight)
        dx, dy, dz, _ = solve_symmetric((*sums[:6], *gradient))
        return torch.stack((x + dx, y + dy, z + dz)), cond

    def square_residuals(
        self,
        points: Float[Tensor, "3 *P J B"],
        square: Float[Tensor, "V J B"],
        view: int,
    ) -> Float[Tensor, "*P J B"]:
        """Return squared pixel errors of points (local world) in one view over ``square``.

        They are inf where that is 0 and behind the camera.
        """
        over = _residual(self.a, points, view)
        down = _residual(self.b, points, view)
        x, y, z = points
        rx, ry, rz = self.views.axis
        depth = torch.addcmul(self.views.shift[2][view], rx[view], x)
        depth.addcmul_(ry[view], y).addcmul_(rz[view], z).clamp_(min=0)
        scale = depth.mul_(depth).mul_(square[view])
        error = over.mul_(over).addcmul_(down, down).div_(scale)
        return error.nan_to_num_(nan=torch.inf, posinf=torch.inf)

    def assess(
        self,
        solution: Float[Tensor, "3 J B"],
        cond: Float[Tensor, "J B"],
        used: Bool[Tensor, "V J B"],
        rejected: Bool[Tensor, "J B"],
    ) -> Triangulation:
        """Return the Triangulation of a solution that is made of the ``used`` views.

        ``rejected``: the joints one of whose inputs is no number to triangulate from.
        """
        count = used.sum(0)
        depth = self.views.depth(*solution)
        in_view = used.any(1)
        distance = torch.where(in_view, self.length.mT, 0.0)[:, None]
        behind = (used & ~(depth > NO_DEPTH * distance)).any(0)
        parallel = torch.isinf(cond) | _share_centre(self.local, distance, used)
        # the last of these that applies
        status = torch.zeros_like(count, dtype=torch.int8)
        status = status.masked_fill(behind, int(State.BEHIND))
        status = status.masked_fill(parallel, int(State.PARALLEL))
        status = status.masked_fill(count < 2, int(State.FEW_VIEWS))
        status = status.masked_fill(rejected, int(State.BAD_INPUT))
        ok = status == State.OBSERVED
        position = solution + self.origin.mT[:, None]
        world = torch.where(ok, position, 0.0)
        has_depth = ok | (status == State.BEHIND)
        nearest = torch.where(has_depth, _smallest(depth, used), 0.0)
        angle = _ray_angle(self.local, self.views, used, count)
        # the components of a point are neighbours in memory
        points = torch.stack(world.unbind(0), dim=-1).transpose(0, 1)
        return Triangulation(points, status.mT, angle.mT, nearest.mT, cond.mT)


def _smallest(depth: Float[Tensor, "V J B"], used: Bool[Tensor, "V J B"]) -> Float[Tensor, "J B"]:
    """Return the smallest depth over the used views; 0 where there are no views at all."""
    if not len(depth):
        return depth.sum(0)
    return torch.where(used, depth, torch.inf).amin(0)


def _residual(row: Row, points: Float[Tensor, "3 *P J B"], view: int) -> Float[Tensor, "*P J B"]:
    """Return the residual of one view's row at points."""
    x, y, z = points
    kx, ky, kz, right = row
    left = torch.addcmul(kx[view] * x, ky[view], y).addcmul_(kz[view], z)
    return left.sub_(right[view])


def _gradient(a: Row, b: Row, x: Tensor, y: Tensor, z: Tensor) -> Float[Tensor, "V 3 J B"]:
    """Return the right-hand sides of the views' equations for a step from the point (x, y, z)."""
    over = a[3] - (a[0] * x + a[1] * y + a[2] * z)
    down = b[3] - (b[0] * x + b[1] * y + b[2] * z)
    components = [torch.addcmul(a[i] * over, b[i], down) for i in range(3)]
    return torch.stack(components, dim=1)


def _ray_angle(
    cameras: Cameras,
    views: ViewComponents,
    used: Bool[Tensor, "V J B"],
    count: Int[Tensor, "J B"],
) -> Float[Tensor, "J B"]:
    """Return ``Triangulation.angle``.

    The sum of |d_i x d_j|^2 over pairs is the sum of the principal minors of the sum of d d^T
    (Cauchy-Binet).
    """
    ray = _rays(cameras, views)
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    outer = torch.stack([ray[i] * ray[j] for i, j in upper], dim=1)
    square_length = outer[:, 0] + outer[:, 3] + outer[:, 5]
    summed = weighted_sum(outer, used / square_length)
    areas = minors(summed.unbind(0))
    total = areas[0] + areas[3] + areas[5]
    pairs = (count * (count - 1) / 2).clamp(min=1)
    return (total / pairs).clamp(0, 1).sqrt().asin()


def _rays(cameras: Cameras, views: ViewComponents) -> list[Float[Tensor, "V J B"]]:
    """Return the components of the key points' rays in the world, of no particular length."""
    (k, s), (n, m) = cameras.K.permute(2, 3, 1, 0)[:2, :2, :, None].contiguous()
    determinant = k * m - s * n
    determinant = torch.where(determinant == 0, 1.0, determinant)
    x = (m * views.u - s * views.v) / determinant
    y = (k * views.v - n * views.u) / determinant
    first, second, third = cameras.R.permute(2, 3, 1, 0)[..., None, :].contiguous()
    rays = []
    for p, q, r in zip(first, second, third, strict=True):
        component = torch.addcmul(r, q, y)
        rays.append(torch.addcmul(component, p, x))
    return rays


def _share_centre(
    cameras: Cameras,
    distance: Float[Tensor, "V 1 B"],
    used: Bool[Tensor, "V J B"],
) -> Bool[Tensor, "J B"]:
    """Return whether the used cameras have one and the same centre.

    It is the same within the rounding of their world's distances.
    """
    shared = torch.ones(used.shape[1:], dtype=torch.bool, device=used.device)
    if not len(used):
        return shared
    centre = cameras.centre.permute(2, 1, 0)
    limit = _ONE_CENTRE * distance.amax(0)
    gaps = centre[0].sort(0).values.diff(dim=0)
    if not (gaps <= limit).any():  # no two cameras can have one: nothing to do
        return torch.zeros_like(shared)
    for x in centre[..., None, :]:
        largest = torch.where(used, x, -torch.inf).amax(0)
        smallest = torch.where(used, x, torch.inf).amin(0)
        shared &= largest - smallest <= limit
    return shared


@torch.no_grad()
def triangulate_subsets(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "B V J"],
    subsets: Bool[Tensor, "B H J V"],
) -> tuple[Float[Tensor, "B H J 3"], Bool[Tensor, "B H J"]]:
    """Triangulate each joint of each hypothesis from its own subset of views (paper, section 3.1).

    Returns points (world, mm, float64; 0 where not ok) and whether they are ok: two views or more,
    all of them valid and finite, rays that fix a point, in front of every camera of the subset. Few
    views: each of the 2^V subsets is triangulated once and looked up; many views: the cost grows
    with V and never with 2^V.
    """
    _, hypotheses, _, views = subsets.shape
    valid = valid & valid_key_points(cameras, key_points)
    local, origin = local_cameras(cameras)
    equations = view_equations(local, key_points, valid).transpose(1, 2)
    length = torch.linalg.vector_norm(cameras.t.double(), dim=-1)
    floor = NO_DEPTH * length.nan_to_num(0.0)
    shift = local.t[..., 2] - floor
    depth_rows = torch.cat((local.R[..., 2, :], shift[..., None]), dim=-1)
    solver = _SubsetSolver(equations, depth_rows, valid.transpose(1, 2))
    if 2**views > hypotheses:
        points, ok = solver.solve(subsets)
    else:
        points, ok = _look_up(solver, subsets)
    world = points + origin[:, None, None]
    return where(ok, world, 0.0), ok


def _look_up(
    solver: _SubsetSolver,
    subsets: Bool[Tensor, "B H J V"],
) -> tuple[Float[Tensor, "B H J 3"], Bool[Tensor, "B H J"]]:
    """Solve each of the 2^V subsets once and return the solutions of these."""
    views = subsets.shape[-1]
    bit = 1 << torch.arange(views, device=subsets.device)
    codes = torch.arange(2**views, device=subsets.device)
    all_subsets = (codes[:, None] & bit) != 0
    frames, joints, _ = solver.valid.shape
    points, ok = solver.solve(all_subsets[:, None].expand(frames, -1, joints, -1))
    code = (subsets * bit).sum(-1)
    point_index = code[..., None].expand(-1, -1, -1, 3)
    return points.gather(1, point_index), ok.gather(1, code)


@dataclass(frozen=True)
class _SubsetSolver:
    """The equations of all joints, to be summed over subsets of the views."""

    equations: Float[Tensor, "B J V 9"]
    depth_rows: Float[Tensor, "B V 4"]
    """Depth in each view, less what is rounding, as a linear function of a point."""
    valid: Bool[Tensor, "B J V"]

    def solve(
        self,
        subsets: Bool[Tensor, "B H J V"],
    ) -> tuple[Float[Tensor, "B H J 3"], Bool[Tensor, "B H J"]]:
        chosen = subsets.permute(0, 2, 3, 1).contiguous()
        summed = self.equations.mT @ chosen.double()
        x, y, z, cond = solve_symmetric(summed.unbind(-2))
        points = torch.stack((x, y, z), dim=-2)
        rows = self.depth_rows[:, None]
        depth = rows[..., :3] @ points + rows[..., 3:]
        in_front = (depth > 0) & self.valid[..., None]
        all_in_front = (in_front | ~chosen).all(-2)
        enough = chosen.sum(-2) >= 2
        ok = enough & torch.isfinite(cond) & all_in_front
        return points.permute(0, 3, 1, 2), ok.transpose(1, 2)
