"""Kannala-Brandt's fisheye lens, as OpenCV's ``fisheye`` module has it.

A ray at the angle theta from the optical axis is seen at the radius
``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`` in normalised image coordinates,
in its own direction. An ideal pinhole sees it at tan(theta), so nothing at 90 degrees or beyond.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm

from ghpt.geometry.polynomials import largest_inverse_root

_STEPS = 100
_CONVERGED = 1e-13
"""In radians."""
_WIDEST = 1.4
"""The largest angle (radians, 80 degrees) that is undone: there a pinhole already sees a pixel 35
times as large as at its centre.
"""
_INSIDE = 1 - 1e-9


def distort_fisheye(
    ideal: Float[Tensor, "*B N 2"], lens: Float[Tensor, "*B 1 4"]
) -> Float[Tensor, "*B N 2"]:
    """Return where the lens shows ideal points; both in normalised coordinates."""
    radius = vector_norm(ideal, dim=-1)
    seen, _ = _seen_radius(torch.atan(radius), lens)
    return ideal * _ratio(seen, radius)[..., None]


def undistort_fisheye(
    seen: Float[Tensor, "*B N 2"], lens: Float[Tensor, "*B 1 4"]
) -> tuple[Float[Tensor, "*B N 2"], Bool[Tensor, "*B N"]]:
    """Return the ideal points of what the lens shows, and whether they exist.

    There is none beyond the angle where the lens folds the image over, nor beyond 80 degrees.
    """
    radius = vector_norm(seen, dim=-1)
    high = _largest_angle(lens)[..., None].expand_as(radius)
    reached, _ = _seen_radius(high, lens)
    exists = radius <= reached
    low = torch.zeros_like(radius)
    angle = torch.minimum(radius, high)
    for _ in range(_STEPS):
        found, slope = _seen_radius(angle, lens)
        error = found - radius
        low = torch.where(error < 0, angle, low)
        high = torch.where(error > 0, angle, high)
        newton = angle - error / torch.where(slope == 0, 1.0, slope)
        inside = (newton >= low) & (newton <= high)
        following = torch.where(inside, newton, (low + high) / 2)
        done = error.abs() <= _CONVERGED * (1 + radius)
        if (done | ~exists).all():
            break
        # those that are done stay: the digits of a point must not depend on those beside it
        angle = torch.where(done, angle, following)
    return seen * _ratio(torch.tan(angle), radius)[..., None], exists


def _seen_radius(
    angle: Float[Tensor, "*B N"], lens: Float[Tensor, "*B 1 4"]
) -> tuple[Float[Tensor, "*B N"], Float[Tensor, "*B N"]]:
    """Return the radius at which the lens shows an angle, and its derivative."""
    k1, k2, k3, k4 = lens.unbind(-1)
    s = angle * angle
    radius = angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    slope = 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))
    return radius, slope


def _largest_angle(lens: Float[Tensor, "*B 1 4"]) -> Float[Tensor, "*B"]:
    """Return the angle up to which the radius grows with it, at most 80 degrees."""
    finite = torch.where(torch.isfinite(lens), lens, 0.0)
    k1, k2, k3, k4 = finite[..., 0, :].unbind(-1)
    inverse_square = largest_inverse_root([torch.ones_like(k1), 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    fold = inverse_square.clamp(min=1e-300) ** -0.5
    return fold.clamp(max=_WIDEST) * _INSIDE


def _ratio(
    radius: Float[Tensor, "*B N"], old_radius: Float[Tensor, "*B N"]
) -> Float[Tensor, "*B N"]:
    """Return by how much a point's radius changes; 1 at the centre."""
    at_centre = old_radius == 0
    return torch.where(at_centre, 1.0, radius / torch.where(at_centre, 1.0, old_radius))
