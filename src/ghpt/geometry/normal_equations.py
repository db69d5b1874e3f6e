"""Normal equations of linear triangulation: a 3x3 system for each view and joint, without units.

A view that sees the joint at pixel (u, v) gives two rows, ``a = (u - c_x) r_3 - f_x r_1 - s r_2``
and ``b = (v - c_y) r_3 - f_y r_2`` (r_i the rows of R), whose residuals are depth x pixel error. So
unequal cameras are weighted by pixels, and the matrix ``a a^T + b b^T`` holds no length: its
conditioning is that of the rays alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.masking import apply, identity_like, where
from ghpt.geometry.rotations import is_rotation

LARGEST = 1e12
"""A pixel or millimetre beyond this is no measurement; its square would spoil float64's precision
or range.
"""
LARGEST_CONDITION = 1e13
"""Of tr(M) tr(M^-1). Two equal cameras reach it at rays 1e-6 rad apart; rounding alone gives 1e15
and more.
"""

Vector = tuple[Tensor, Tensor, Tensor]
"""The components of a 3-vector, each an array of its own."""
Row = tuple[Tensor, Tensor, Tensor, Tensor]
"""An equation of a point: its three coefficients and its right-hand side."""
Symmetric = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""The elements xx xy xz yy yz zz of a symmetric 3x3 matrix."""


def valid_cameras(cameras: Cameras) -> Bool[Tensor, "*B V"]:
    """Return which cameras are cameras.

    Their numbers are finite and not absurd, R is a rotation within 1e-3, focal lengths are
    positive, and the last row of K is (0, 0, 1).
    """
    K = cameras.K
    R = cameras.R
    numbers = (K.flatten(-2), R.flatten(-2), cameras.t)
    largest = torch.cat(numbers, dim=-1).abs()
    bounded = (largest <= LARGEST).all(-1)
    focal = K.diagonal(dim1=-2, dim2=-1)[..., :2]
    positive = (focal >= 1 / LARGEST).all(-1)
    last_row = K[..., 2, :] - K.new_tensor([0.0, 0.0, 1.0])
    ideal = (last_row.abs() <= 1e-6).all(-1)
    return bounded & positive & ideal & is_rotation(R, 1e-3)


def valid_key_points(
    cameras: Cameras,
    key_points: Float[Tensor, "*B V J 2"],
) -> Bool[Tensor, "*B V J"]:
    """Return which key points can be triangulated: finite, not absurd, and of a valid camera."""
    bounded = (key_points.abs() <= LARGEST).all(-1)
    return bounded & valid_cameras(cameras)[..., None]


def local_cameras(
    cameras: Cameras,
    valid: Bool[Tensor, "*B V"] | None = None,
    shared: bool = False,
) -> tuple[Cameras, Float[Tensor, "*B 3"]]:
    """Return float64 cameras in a world whose origin is the rig's median centre, and that origin.

    Far from the world's origin the squares of coordinates would cost digits, and a (component-wise)
    median is not moved by one camera with absurd numbers. Invalid cameras are replaced by one at
    the origin. ``valid``: ``valid_cameras``. ``shared``: all rigs get the origin of the first one.
    """
    if valid is None:
        valid = valid_cameras(cameras)
    double = cameras.to(torch.float64)
    identity = identity_like(double.K)
    K = where(valid, double.K, identity)
    R = where(valid, double.R, identity)
    t = where(valid, double.t, 0.0)
    centre = where(valid, Cameras(K, R, t).centre, torch.nan)
    origin = centre.nanmedian(dim=-2).values.nan_to_num(0.0)
    if shared:
        origin = origin[:1].expand_as(origin)
    shift = apply(R, origin.unsqueeze(-2))
    return Cameras(K, R, t + shift), origin


@dataclass(frozen=True)
class ViewComponents:
    """Cameras and key points with their components in separate arrays and the frames last.

    So each operation runs along memory: key points are [V, J, B], what is a camera's is [V, 1, B];
    float64.
    """

    first: Vector
    """The first row of ``K[:2, :2] R[:2]``."""
    second: Vector
    axis: Vector
    """The optical axis, r_3."""
    shift: Vector
    """``K[:2, :2] t[:2]`` and t_3."""
    u: Tensor
    """Horizontal pixels from the principal point; 0 where the key point is not valid."""
    v: Tensor

    def rows(self) -> tuple[Row, Row]:
        """Return the rows a and b of each view and joint."""
        shift_u, shift_v, shift_z = self.shift
        ax, ay, az = (self.u * r - k for r, k in zip(self.axis, self.first, strict=True))
        bx, by, bz = (self.v * r - k for r, k in zip(self.axis, self.second, strict=True))
        right_a = shift_u - self.u * shift_z
        right_b = shift_v - self.v * shift_z
        return (ax, ay, az, right_a), (bx, by, bz, right_b)

    def depth(self, x: Tensor, y: Tensor, z: Tensor) -> Float[Tensor, "V J B"]:
        """Return the depth of points [J, B] in each view, mm."""
        rx, ry, rz = self.axis
        depth = torch.addcmul(self.shift[2], rx, x)
        depth = torch.addcmul(depth, ry, y)
        return torch.addcmul(depth, rz, z)


def view_components(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "V J B"],
) -> ViewComponents:
    """Return the components of cameras and key points.

    ``cameras`` are used as they are: pass valid ones near the origin, [B, V] or [1, V] for all
    frames.
    """
    R = cameras.R.permute(2, 3, 1, 0)[..., None, :].contiguous()
    t = cameras.t.permute(2, 1, 0)[..., None, :]
    K = cameras.K.permute(2, 3, 1, 0)[:2, :, :, None].contiguous()
    pixels = key_points.permute(3, 1, 2, 0).double()
    pixels = torch.where(valid, pixels, 0.0)
    return ViewComponents(
        first=_combine(K[0], R),
        second=_combine(K[1], R),
        axis=(R[2, 0], R[2, 1], R[2, 2]),
        shift=(_mix(K[0], t), _mix(K[1], t), t[2].contiguous()),
        u=torch.where(valid, pixels[0] - K[0, 2], 0.0),
        v=torch.where(valid, pixels[1] - K[1, 2], 0.0),
    )


def _combine(k: Float[Tensor, "3 V 1 B"], R: Float[Tensor, "3 3 V 1 B"]) -> Vector:
    return _mix(k, R[:, 0]), _mix(k, R[:, 1]), _mix(k, R[:, 2])


def _mix(k: Float[Tensor, "3 V 1 B"], x: Float[Tensor, "3 V 1 B"]) -> Float[Tensor, "V 1 B"]:
    return k[0] * x[0] + k[1] * x[1]


def form_equations(a: Sequence[Tensor], b: Sequence[Tensor]) -> Float[Tensor, "V 9 ..."]:
    """Return the normal equations of each view alone from its two rows.

    They are the matrix (xx xy xz yy yz zz) and its right-hand side (3).
    """
    matrix = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    right = [(0, 3), (1, 3), (2, 3)]
    products = [torch.addcmul(a[i] * a[j], b[i], b[j]) for i, j in matrix + right]
    return torch.stack(products, dim=1)


def weighted_sum(
    equations: Float[Tensor, "V E ..."],
    weights: Float[Tensor, "V ..."],
) -> Float[Tensor, "E ..."]:
    """Return the sum over the views, in their order.

    So each frame's sum is the same in any batch, as ``torch.sum``'s is not.
    """
    total = equations.new_zeros(equations.shape[1:])
    for equation, weight in zip(equations, weights, strict=True):
        total = torch.addcmul(total, equation, weight)
    return total


def view_equations(
    cameras: Cameras,
    key_points: Float[Tensor, "B V J 2"],
    valid: Bool[Tensor, "B V J"],
) -> Float[Tensor, "B V J 9"]:
    """Return the normal equations of each view alone, float64; all 0 where a key point is invalid.

    They are the matrix (xx xy xz yy yz zz) and its right-hand side (3). ``cameras`` are used as
    they are: pass valid ones near the origin.
    """
    valid = valid.permute(1, 2, 0)
    components = view_components(cameras, key_points, valid)
    a, b = components.rows()
    equations = form_equations(a, b)
    equations = torch.where(valid[:, None], equations, 0.0)
    return equations.permute(3, 0, 2, 1).contiguous()


def minors(matrix: Sequence[Tensor]) -> Symmetric:
    """Return the cofactors (xx xy xz yy yz zz) of symmetric 3x3 matrices."""
    xx, xy, xz, yy, yz, zz = matrix
    return (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )


def solve_symmetric(equations: Sequence[Tensor]) -> Row:
    """Solve batched symmetric 3x3 systems by cofactors.

    ``equations``: nine equal shapes, the matrix (xx xy xz yy yz zz) and the right-hand side (x y
    z). Returns x, y, z and tr(M) tr(M^-1); where that exceeds ``LARGEST_CONDITION`` it is inf and
    the solution 0.
    """
    xx, xy, xz, yy, _, zz, p, q, r = equations
    cxx, cxy, cxz, cyy, cyz, czz = minors(equations[:6])
    determinant = xx * cxx + xy * cxy + xz * cxz
    trace = xx + yy + zz
    cofactor_trace = cxx + cyy + czz
    numerator = trace * cofactor_trace
    regular = numerator < LARGEST_CONDITION * determinant
    safe = torch.where(regular, determinant, 1.0)
    inverse = torch.where(regular, 1 / safe, 0.0)
    x = (cxx * p + cxy * q + cxz * r) * inverse
    y = (cxy * p + cyy * q + cyz * r) * inverse
    z = (cxz * p + cyz * q + czz * r) * inverse
    condition = torch.where(regular, numerator * inverse, torch.inf)
    return x, y, z, condition
