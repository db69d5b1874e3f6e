"""Normal equations of linear triangulation: one 3x3 system for each view and joint, free of the
unit of length.

A view that sees the joint at pixel (u, v) gives two rows, ``a = (u - c_x) r_3 - f_x r_1 - s r_2``
and ``b = (v - c_y) r_3 - f_y r_2`` (r_i the rows of R), whose residuals are depth x pixel error. So
unequal cameras are weighted by pixels, and the matrix ``a a^T + b b^T`` holds no length: its
conditioning is that of the rays alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import is_rotation

LARGEST = 1e12
"""A pixel or millimetre beyond this is no measurement; its square would spoil float64's precision
or range.
"""
LARGEST_CONDITION = 1e13
"""Of tr(M) tr(M^-1). Two equal cameras reach it at rays 1e-6 rad apart; rounding alone gives 1e15
and more.
"""


def valid_cameras(cameras: Cameras) -> Bool[Tensor, "*B V"]:
    """Which cameras are cameras: finite and not absurd, R a rotation within 1e-3, positive focal
    lengths, last row of K (0, 0, 1).
    """
    K = cameras.K
    R = cameras.R
    t = cameras.t
    values = torch.cat((K.flatten(-2), R.flatten(-2), t), dim=-1)
    focal = torch.stack((K[..., 0, 0], K[..., 1, 1]), dim=-1)
    last_row = K[..., 2, :] - K.new_tensor([0.0, 0.0, 1.0])
    return (
        (values.abs() <= LARGEST).all(-1)
        & (focal >= 1 / LARGEST).all(-1)
        & (last_row.abs() <= 1e-6).all(-1)
        & is_rotation(R, 1e-3)
    )


def usable_views(cameras: Cameras, key_points: Float[Tensor, "*B V J 2"]) -> Bool[Tensor, "*B V J"]:
    """Which key points can be triangulated from: finite, not absurd, and of a valid camera."""
    return (key_points.abs() <= LARGEST).all(-1) & valid_cameras(cameras)[..., None]


def local_cameras(
    cameras: Cameras, valid: Bool[Tensor, "*B V"] | None = None
) -> tuple[Cameras, Float[Tensor, "*B 3"]]:
    """Float64 cameras in a world whose origin is the rig's (component-wise median) centre, and that
    origin.

    Far from the world's origin the squares of coordinates would cost digits, and a median is not
    moved by one camera with absurd numbers. Invalid cameras are replaced by one at the origin.
    ``valid``: ``valid_cameras``.
    """
    valid = valid_cameras(cameras) if valid is None else valid
    K, R, t = (x.to(torch.float64) for x in (cameras.K, cameras.R, cameras.t))
    identity = torch.eye(3, dtype=torch.float64, device=K.device)
    K = torch.where(valid[..., None, None], K, identity)
    R = torch.where(valid[..., None, None], R, identity)
    t = torch.where(valid[..., None], t, 0.0)
    centre = torch.where(valid[..., None], Cameras(K, R, t).centre, torch.nan)
    origin = centre.nanmedian(dim=-2).values.nan_to_num(0.0)
    return Cameras(K, R, t + (R @ origin[..., None, :, None])[..., 0]), origin


class Views(NamedTuple):
    """Cameras and key points with their components apart and the frames last, so that each
    operation runs along memory: key points are [V, J, B], what is a camera's is [V, 1, B]; float64.
    """

    first: tuple[Tensor, Tensor, Tensor]
    """The first row of ``K[:2, :2] R[:2]``."""
    second: tuple[Tensor, Tensor, Tensor]
    axis: tuple[Tensor, Tensor, Tensor]
    """The optical axis, r_3."""
    shift: tuple[Tensor, Tensor, Tensor]
    """``K[:2, :2] t[:2]`` and t_3."""
    u: Tensor
    """Horizontal pixels from the principal point; 0 where the view is not usable."""
    v: Tensor

    def rows(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """The rows a and b of each view and joint, their right-hand sides the last of four."""
        (p, q, tz) = self.shift
        a = [self.u * r - k for r, k in zip(self.axis, self.first, strict=True)]
        b = [self.v * r - k for r, k in zip(self.axis, self.second, strict=True)]
        return (*a, p - self.u * tz), (*b, q - self.v * tz)

    def depth(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Of points [J, B] in each view, mm."""
        (rx, ry, rz) = self.axis
        shift = self.shift[2]
        return torch.addcmul(torch.addcmul(torch.addcmul(shift, rx, x), ry, y), rz, z)


def views_of(
    cameras: Cameras, key_points: Float[Tensor, "B V J 2"], usable: Bool[Tensor, "V J B"]
) -> Views:
    """``cameras`` are used as they are: pass valid ones near the origin, [B, V] or [1, V] for all
    frames.
    """
    R = cameras.R.permute(2, 3, 1, 0)[..., None, :].contiguous()
    t = cameras.t.permute(2, 1, 0)[..., None, :]
    K = cameras.K.permute(2, 3, 1, 0)[:2, :, :, None].contiguous()
    pixels = torch.where(usable, key_points.permute(3, 1, 2, 0).to(torch.float64), 0.0)
    u, v = (torch.where(usable, pixels[i] - K[i, 2], 0.0) for i in range(2))
    first, second = (
        tuple(K[i, 0] * R[0, j] + K[i, 1] * R[1, j] for j in range(3)) for i in range(2)
    )
    shift = tuple(K[i, 0] * t[0] + K[i, 1] * t[1] for i in range(2))
    return Views(first, second, tuple(R[2]), (*shift, t[2].contiguous()), u, v)


def products(a: Sequence[Tensor], b: Sequence[Tensor]) -> Float[Tensor, "V 9 ..."]:
    """Normal equations of each view alone from its two rows: the matrix (xx xy xz yy yz zz) and its
    right-hand side (3).
    """
    pairs = [(i, j) for i in range(3) for j in range(i, 3)] + [(i, 3) for i in range(3)]
    return torch.stack([torch.addcmul(a[i] * a[j], b[i], b[j]) for i, j in pairs], dim=1)


def weighted_sum(
    equations: Float[Tensor, "V E ..."], weights: Float[Tensor, "V ..."]
) -> Float[Tensor, "E ..."]:
    """Over the views, in their order: each frame's sum is the same in any batch, as ``torch.sum``'s
    is not.
    """
    total = equations.new_zeros(equations.shape[1:])
    for equation, weight in zip(equations, weights, strict=True):
        total = torch.addcmul(total, equation, weight)
    return total


def view_equations(
    cameras: Cameras, key_points: Float[Tensor, "B V J 2"], usable: Bool[Tensor, "B V J"]
) -> Float[Tensor, "B V J 9"]:
    """Normal equations of each view alone, float64: the matrix (xx xy xz yy yz zz) and its
    right-hand side (3); all 0 where the view is not usable. ``cameras`` are used as they are: pass
    valid ones near the origin.
    """
    usable = usable.permute(1, 2, 0)
    each = products(*views_of(cameras, key_points, usable).rows())
    return torch.where(usable[:, None], each, 0.0).permute(3, 0, 2, 1).contiguous()


def minors(m: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Cofactors (xx xy xz yy yz zz) of symmetric 3x3 matrices."""
    xx, xy, xz, yy, yz, zz = m
    return (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )


def solve_symmetric(equations: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve batched symmetric 3x3 systems by cofactors.

    ``equations``: nine equal shapes, the matrix (xx xy xz yy yz zz) and the right-hand side (x y
    z). Returns x, y, z and tr(M) tr(M^-1); where that exceeds ``LARGEST_CONDITION`` it is inf and
    the solution 0.
    """
    matrix = equations[:6]
    (p, q, r) = equations[6:]
    cxx, cxy, cxz, cyy, cyz, czz = minors(matrix)
    determinant = matrix[0] * cxx + matrix[1] * cxy + matrix[2] * cxz
    numerator = (matrix[0] + matrix[3] + matrix[5]) * (cxx + cyy + czz)
    good = numerator < LARGEST_CONDITION * determinant
    inverse = torch.where(good, 1 / torch.where(good, determinant, 1.0), 0.0)
    x = (cxx * p + cxy * q + cxz * r) * inverse
    y = (cxy * p + cyy * q + cyz * r) * inverse
    z = (cxz * p + cyz * q + czz * r) * inverse
    return x, y, z, torch.where(good, numerator * inverse, torch.inf)
