"""Iteratively reweighted triangulation: a view's equations are made once, only their weights
change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import products, solve_symmetric, weighted_sum
from ghpt.geometry.state import State
from ghpt.geometry.triangulation import System, Triangulation, flat_cameras, in_parts

_TINY = 1e-30
_SETTLED = 1e-3
"""A joint whose step is below this share of the tolerance is left where it is."""

WEIGHTS: dict[str, Callable[[Tensor], Tensor]] = {
    "huber": lambda near: (1 / near - 1).clamp(min=1).rsqrt(),
    "cauchy": lambda near: near,
    "geman_mcclure": lambda near: near * near,
}
"""Weight of a residual of r scales in iteratively reweighted least squares (the loss's derivative
over r), as a function of ``1 / (1 + r^2)``.
"""


@torch.no_grad()
def triangulate_robustly(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "B V J"],
    scale: Float[Tensor, "B V"],
    weigh: Callable[[Tensor], Tensor],
    iterations: int,
    tolerance: float,
) -> Triangulation:
    """Iteratively reweighted least squares on the reprojection error, from the linear solution of
    all seen views.

    A view's weight is that of its reprojection error in ``scale`` pixels over its squared depth,
    which turns the rows' residuals into pixels; 0 behind a camera. A joint whose last step is
    longer than ``tolerance`` (mm) is NOT_CONVERGED; one whose step is far shorter rests. Where a
    solution fails, the linear one stands.
    """
    rig = flat_cameras(cameras, valid.shape[:1])

    def part(rows: slice) -> tuple[Tensor, ...]:
        given = valid[rows].permute(1, 2, 0)
        system = System(rig if len(rig.t) == 1 else rig.index(rows), key_points[rows], given)
        spoilt = (given & ~system.used).any(0)
        linear = system.solve(system.used.double())
        first = system.fields(*linear, system.used, spoilt)
        square = torch.where(system.used, scale[rows].double().mT[:, None] ** 2, 0.0)
        before, weight = _reweighted(system, linear[0], square, weigh, iterations - 1, tolerance)
        robust = system.solve(weight / weight.amax(0).clamp(min=_TINY))
        fields = system.fields(*robust, weight > 0, spoilt)
        step = torch.linalg.vector_norm(torch.stack(robust[0]) - before, dim=0).mT
        started = first[1] == State.OBSERVED
        good = fields[1] == State.OBSERVED
        fields = tuple(
            torch.where((started & good)[..., None] if x.ndim > good.ndim else started & good, x, y)
            for x, y in zip(fields, first, strict=True)
        )
        unsettled = started & ~(good & (step <= tolerance))
        return (fields[0], fields[1].masked_fill(unsettled, int(State.NOT_CONVERGED)), *fields[2:])

    return Triangulation(*in_parts(part, valid.shape))


def _reweighted(
    system: System,
    start: Sequence[Tensor],
    square: Tensor,
    weigh: Callable[[Tensor], Tensor],
    steps: int,
    tolerance: float,
) -> tuple[Float[Tensor, "3 J B"], Float[Tensor, "V J B"]]:
    """The solution after so many steps from ``start``, and the weights that it gives the views.

    Joints and frames are one dimension N, which shrinks to those still moving.
    """
    x, y, z = start
    a, b = ((*r[:3], r[3] - (r[0] * x + r[1] * y + r[2] * z)) for r in (system.a, system.b))
    axis = [r.expand_as(system.used) for r in system.views.axis]
    depth = system.views.depth(x, y, z)
    whole = rows = torch.stack((*a, *b, *axis, depth, square), dim=1).flatten(2)
    equations = products(rows[:, :4].unbind(1), rows[:, 4:8].unbind(1))
    total = rows.new_zeros(3, rows.shape[-1])
    offset = total.clone()
    moving = torch.arange(rows.shape[-1], device=rows.device)
    active = torch.ones_like(moving, dtype=torch.bool)
    for _ in range(steps):
        sums = weighted_sum(equations, _weights(rows, offset, weigh))
        *solution, cond = solve_symmetric(tuple(sums))
        moved = torch.where(active & torch.isfinite(cond), torch.stack(solution), offset)
        active = (moved - offset).abs().amax(0) > _SETTLED * tolerance
        offset = moved
        left = torch.nonzero(active)[:, 0]
        if 4 * len(left) < 3 * len(active):
            total[:, moving] = offset
            rows = rows[..., left]
            equations = equations[..., left]
            offset = offset[:, left]
            moving = moving[left]
            active = active[left]
        if not len(left):
            break
    total[:, moving] = offset
    end = torch.stack(list(start)) + total.unflatten(1, square.shape[1:])
    return end, _weights(whole, total, weigh).unflatten(1, square.shape[1:])


def _weights(rows: Tensor, offset: Tensor, weigh: Callable[[Tensor], Tensor]) -> Tensor:
    ax, ay, az, right_a, bx, by, bz, right_b, rx, ry, rz, depth, square = rows.unbind(1)
    x, y, z = offset
    over = right_a.addcmul(ax, x, value=-1).addcmul_(ay, y, value=-1).addcmul_(az, z, value=-1)
    down = right_b.addcmul(bx, x, value=-1).addcmul_(by, y, value=-1).addcmul_(bz, z, value=-1)
    depth = depth.addcmul(rx, x).addcmul_(ry, y).addcmul_(rz, z).clamp_(min=0)
    depth2 = depth.mul_(depth)
    scale2 = depth2 * square
    near = scale2 / over.mul_(over).addcmul_(down, down).add_(scale2).add_(_TINY)
    return weigh(near) / depth2.add_(_TINY)
