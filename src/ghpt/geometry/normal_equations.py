"""Normal equations of linear triangulation: one 3x3 system for each view and joint, free of the unit of length.

A view that sees the joint at pixel (u, v) gives two rows, ``a = (u - c_x) r_3 - f_x r_1 - s r_2`` and
``b = (v - c_y) r_3 - f_y r_2`` (r_i the rows of R), whose residuals are depth x pixel error. So unequal cameras are
weighted by pixels, and the matrix ``a a^T + b b^T`` holds no length: its conditioning is that of the rays alone.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import is_rotation

LARGEST = 1e12
"""A pixel or millimetre beyond this is no measurement; its square would spoil float64's precision or range."""
LARGEST_CONDITION = 1e13
"""Of tr(M) tr(M^-1). Two equal cameras reach it at rays 1e-6 rad apart; rounding alone gives 1e15 and more."""


def valid_cameras(cameras: Cameras) -> Bool[Tensor, "*B V"]:
    """Which cameras are cameras: finite and not absurd, R a rotation within 1e-3, positive focal lengths, last
    row of K (0, 0, 1)."""
    K, R, t = cameras.K, cameras.R, cameras.t
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


def local_cameras(cameras: Cameras) -> tuple[Cameras, Float[Tensor, "*B 3"]]:
    """Float64 cameras in a world whose origin is the rig's (component-wise median) centre, and that origin.

    Far from the world's origin the squares of coordinates would cost digits, and a median is not moved by one
    camera with absurd numbers. Invalid cameras are replaced by one at the origin.
    """
    valid = valid_cameras(cameras)
    K, R, t = (x.to(torch.float64) for x in (cameras.K, cameras.R, cameras.t))
    identity = torch.eye(3, dtype=torch.float64, device=K.device)
    K = torch.where(valid[..., None, None], K, identity)
    R = torch.where(valid[..., None, None], R, identity)
    t = torch.where(valid[..., None], t, 0.0)
    centre = torch.where(valid[..., None], Cameras(K, R, t).centre, torch.nan)
    origin = centre.nanmedian(dim=-2).values.nan_to_num(0.0)
    return Cameras(K, R, t + (R @ origin[..., None, :, None])[..., 0]), origin


def view_rows(
    cameras: Cameras, key_points: Float[Tensor, "*B V J 2"]
) -> tuple[Float[Tensor, "*B V J 2 3"], Float[Tensor, "*B V J 2"]]:
    """The two rows of each view and joint and their right-hand sides; residuals are depth x pixel error."""
    K, R, t = cameras.K, cameras.R, cameras.t
    offset = key_points - K[..., None, :2, 2]
    rows = offset[..., None] * R[..., None, 2:, :] - (K[..., :2, :2] @ R[..., :2, :])[..., None, :, :]
    right = (K[..., :2, :2] @ t[..., :2, None])[..., None, :, 0] - offset * t[..., None, 2:]
    return rows, right


def view_equations(
    cameras: Cameras, key_points: Float[Tensor, "*B V J 2"], usable: Bool[Tensor, "*B V J"]
) -> Float[Tensor, "*B V J 9"]:
    """Normal equations of each view alone, float64: the matrix (xx xy xz yy yz zz) and its right-hand side (3);
    all 0 where the view is not usable. ``cameras`` are used as they are: pass valid ones near the origin."""
    safe = torch.where(usable[..., None], key_points.to(torch.float64), 0.0)
    rows, right = view_rows(cameras, safe)
    x, y, z = rows.unbind(-1)
    columns = (x * x, x * y, x * z, y * y, y * z, z * z, x * right, y * right, z * right)
    return torch.where(usable[..., None], torch.stack(columns, dim=-1).sum(-2), 0.0)


def minors(m: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Cofactors (xx xy xz yy yz zz) of symmetric 3x3 matrices."""
    xx, xy, xz, yy, yz, zz = m
    return (
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy,
    )  # fmt: skip


def solve_symmetric(equations: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve batched symmetric 3x3 systems by cofactors.

    ``equations``: nine equal shapes, the matrix (xx xy xz yy yz zz) and the right-hand side (x y z). Returns
    x, y, z and tr(M) tr(M^-1); where that exceeds ``LARGEST_CONDITION`` it is inf and the solution 0.
    """
    matrix, (p, q, r) = equations[:6], equations[6:]
    cxx, cxy, cxz, cyy, cyz, czz = minors(matrix)
    determinant = matrix[0] * cxx + matrix[1] * cxy + matrix[2] * cxz
    numerator = (matrix[0] + matrix[3] + matrix[5]) * (cxx + cyy + czz)
    good = numerator < LARGEST_CONDITION * determinant
    safe = torch.where(good, determinant, 1.0)
    x = torch.where(good, (cxx * p + cxy * q + cxz * r) / safe, 0.0)
    y = torch.where(good, (cxy * p + cyy * q + cyz * r) / safe, 0.0)
    z = torch.where(good, (cxz * p + cyz * q + czz * r) / safe, 0.0)
    return x, y, z, torch.where(good, numerator / safe, torch.inf)
