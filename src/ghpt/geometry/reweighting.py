"""Iteratively reweighted triangulation: a view's equations are made once, their weights change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.normal_equations import Row, form_equations, solve_symmetric, weighted_sum
from ghpt.geometry.state import State
from ghpt.geometry.triangulation import (
    System,
    Triangulation,
    flat_cameras,
    select_frames,
    solve_in_parts,
)

_TINY = 1e-30
_SETTLED = 1e-3
"""A joint whose step is below this share of the tolerance is left where it is."""

Weigh = Callable[[Tensor], Tensor]
"""The weight of a residual of r scales as a function of ``1 / (1 + r^2)``."""

WEIGHTS: dict[str, Weigh] = {
    "huber": lambda near: (1 / near - 1).clamp(min=1).rsqrt(),
    "cauchy": lambda near: near,
    "geman_mcclure": lambda near: near * near,
}
"""Weights of iteratively reweighted least squares: the loss's derivative over r."""


@torch.no_grad()
def triangulate_robustly(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "B V J"],
    scale: Float[Tensor, "B V"],
    confidence: Float[Tensor, "B V J"],
    weigh: Weigh,
    iterations: int,
    tolerance: float,
) -> Triangulation:
    """Return the iteratively reweighted least-squares points of the reprojection error.

    It starts from the linear solution of all valid views. A view's weight is its ``confidence``
    times that of its reprojection error in ``scale`` pixels over its squared depth, which turns the
    rows' residuals into pixels; 0 behind a camera. A joint whose last step is longer than
    ``tolerance`` (mm) is NOT_CONVERGED; one whose step is far shorter rests. Where a solution
    fails, the linear one stands.
    """
    rig = flat_cameras(cameras, valid.shape[:1])
    settings = _Iteration(weigh, iterations, tolerance)

    def solve(rows: slice) -> Triangulation:
        own = select_frames(rig, rows)
        system = System(own, key_points[rows], valid[rows].permute(1, 2, 0))
        return settings.triangulate(system, valid[rows], scale[rows], confidence[rows])

    return solve_in_parts(solve, valid.shape)


@dataclass(frozen=True)
class _Iteration:
    weigh: Weigh
    iterations: int
    tolerance: float
    """mm."""

    def triangulate(
        self,
        system: System,
        valid: Bool[Tensor, "B V J"],
        scale: Float[Tensor, "B V"],
        confidence: Float[Tensor, "B V J"],
    ) -> Triangulation:
        """Return the robust points of a few frames, and the linear ones where that fails."""
        used = system.used
        rejected = (valid.permute(1, 2, 0) & ~used).any(0)
        start, cond = system.solve(used.double())
        linear = system.assess(start, cond, used, rejected)
        square = torch.where(used, scale.double().mT[:, None] ** 2, 0.0)
        weights = confidence.permute(1, 2, 0)
        previous, weight = self._reweight(system, start, square, weights)
        largest = weight.amax(0).clamp(min=_TINY)
        last, cond = system.solve(weight / largest)
        robust = system.assess(last, cond, weight > 0, rejected)
        step = torch.linalg.vector_norm(last - previous, dim=0).mT
        result = robust.with_fallback(linear.ok & robust.ok, linear)
        converged = robust.ok & (step <= self.tolerance)
        unsettled = linear.ok & ~converged
        status = result.status.masked_fill(unsettled, int(State.NOT_CONVERGED))
        return replace(result, status=status)

    def _reweight(
        self,
        system: System,
        start: Float[Tensor, "3 J B"],
        square: Float[Tensor, "V J B"],
        confidence: Float[Tensor, "V J B"],
    ) -> tuple[Float[Tensor, "3 J B"], Float[Tensor, "V J B"]]:
        """Return the solution before the last iteration, and the weights that it gives the views.

        Joints and frames are one dimension N, which shrinks to those still moving.
        """
        all_rows = _stack_rows(system, start, square, confidence)
        rows = all_rows
        equations = form_equations(rows[:, :4].unbind(1), rows[:, 4:8].unbind(1))
        total = rows.new_zeros(3, rows.shape[-1])
        offset = total.clone()
        moving = torch.arange(rows.shape[-1], device=rows.device)
        active = torch.ones_like(moving, dtype=torch.bool)
        for _ in range(self.iterations - 1):
            previous = offset
            offset = self._step(equations, rows, previous, active)
            change = (offset - previous).abs().amax(0)
            active = change > _SETTLED * self.tolerance
            remaining = torch.nonzero(active)[:, 0]
            if 4 * len(remaining) < 3 * len(active):
                total[:, moving] = offset
                rows = rows[..., remaining]
                equations = equations[..., remaining]
                offset = offset[:, remaining]
                moving = moving[remaining]
                active = active[remaining]
            if not len(remaining):
                break
        total[:, moving] = offset
        shape = square.shape[1:]
        end = start + total.unflatten(1, shape)
        weights = _weights(all_rows, total, self.weigh)
        return end, weights.unflatten(1, shape)

    def _step(
        self,
        equations: Float[Tensor, "V 9 N"],
        rows: Float[Tensor, "V 14 N"],
        offset: Float[Tensor, "3 N"],
        active: Bool[Tensor, " N"],
    ) -> Float[Tensor, "3 N"]:
        """Return the next offsets; those that are not active, or have no solution, stay."""
        sums = weighted_sum(equations, _weights(rows, offset, self.weigh))
        x, y, z, cond = solve_symmetric(sums.unbind(0))
        solved = active & torch.isfinite(cond)
        return torch.where(solved, torch.stack((x, y, z)), offset)


def _stack_rows(
    system: System,
    start: Float[Tensor, "3 J B"],
    square: Float[Tensor, "V J B"],
    confidence: Float[Tensor, "V J B"],
) -> Float[Tensor, "V 14 N"]:
    """Return both rows, axis, depth, squared scale and confidence of each view, from ``start``."""
    a = _move_origin(system.a, start)
    b = _move_origin(system.b, start)
    axis = [r.expand_as(system.used) for r in system.views.axis]
    depth = system.views.depth(*start)
    stacked = torch.stack((*a, *b, *axis, depth, square, confidence), dim=1)
    return stacked.flatten(2)


def _move_origin(row: Row, origin: Float[Tensor, "3 J B"]) -> Row:
    """Return the row as an equation of the offset from ``origin``."""
    kx, ky, kz, right = row
    x, y, z = origin
    return kx, ky, kz, right - (kx * x + ky * y + kz * z)


def _weights(
    rows: Float[Tensor, "V 14 N"],
    offset: Float[Tensor, "3 N"],
    weigh: Weigh,
) -> Float[Tensor, "V N"]:
    ax, ay, az, right_a, bx, by, bz, right_b, *view = rows.unbind(1)
    rx, ry, rz, depth, square, confidence = view
    x, y, z = offset
    over = right_a.addcmul(ax, x, value=-1)
    over.addcmul_(ay, y, value=-1).addcmul_(az, z, value=-1)
    down = right_b.addcmul(bx, x, value=-1)
    down.addcmul_(by, y, value=-1).addcmul_(bz, z, value=-1)
    depth = depth.addcmul(rx, x)
    depth.addcmul_(ry, y).addcmul_(rz, z).clamp_(min=0)
    square_depth = depth.mul_(depth)
    square_scale = square_depth * square
    square_error = over.mul_(over).addcmul_(down, down)
    near = square_scale / square_error.add_(square_scale).add_(_TINY)
    return weigh(near).mul(confidence) / square_depth.add_(_TINY)
