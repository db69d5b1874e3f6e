"""Rotations and alignment: pure batched functions.

Quaternions are w x y z with w >= 0; rotation vectors are in radians.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm

from ghpt.geometry.masking import (
    apply,
    finite_matrices,
    finite_vectors,
    identity_like,
    where,
)

_ALIGNED = 16
"""Two directions closer than this many roundings to one line leave no plane to rotate in."""


def is_rotation(R: Float[Tensor, "*B 3 3"], tolerance: float) -> Bool[Tensor, "*B"]:
    """Return whether every element of ``R R^T - I`` is within ``tolerance`` and det R > 0.

    NaN and inf give False.
    """
    deviation = R @ R.mT - identity_like(R)
    orthogonal = (deviation.abs() <= tolerance).all(-1).all(-1)
    first, second, third = R.unbind(-2)
    normal = torch.linalg.cross(first, second)
    determinant = (normal * third).sum(-1)
    return orthogonal & (determinant > 0)


def _signed_svd(M: Float[Tensor, "*B 3 3"]) -> tuple[Tensor, Tensor]:
    """Return the rotation R that maximises tr(R^T M), and tr(R^T M).

    They are the identity and 0 where M is not finite.
    """
    # one non-finite matrix would make LAPACK refuse the whole batch
    safe = where(finite_matrices(M), M, 0.0)
    U, S, Vt = torch.linalg.svd(safe)
    determinant = torch.linalg.det(U) * torch.linalg.det(Vt)
    sign = torch.ones_like(S)
    sign[..., 2] = torch.where(determinant < 0, -1.0, 1.0)
    R = (U * sign[..., None, :]) @ Vt
    trace = (S * sign).sum(-1)
    return R, trace


def nearest_rotation(M: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation nearest to M in the Frobenius norm.

    Where it is not unique, or M is not finite, it is some rotation.
    """
    R, _ = _signed_svd(M)
    return R


def quaternion_to_matrix(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation of a quaternion (w x y z, of any length but 0; 0 gives the identity)."""
    w, x, y, z = q.unbind(-1)
    square = (q * q).sum(-1)
    s = 2 / torch.where(square > 0, square, 1.0)
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    xz = x * z
    yz = y * z
    xw = x * w
    yw = y * w
    zw = z * w
    elements = (
        1 - s * (yy + zz),
        s * (xy - zw),
        s * (xz + yw),
        s * (xy + zw),
        1 - s * (xx + zz),
        s * (yz - xw),
        s * (xz - yw),
        s * (yz + xw),
        1 - s * (xx + yy),
    )
    return torch.stack(elements, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quaternion(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Return the unit quaternion (w x y z, w >= 0) of a rotation."""
    outer = _quaternion_outer_product(R)
    # any row is q up to its length, and the one with the largest diagonal is never near 0
    diagonal = outer.diagonal(dim1=-2, dim2=-1)
    row = diagonal.argmax(-1)
    index = row[..., None, None].expand(*row.shape, 1, 4)
    q = outer.gather(-2, index)[..., 0, :]
    q = q / vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def _quaternion_outer_product(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4 4"]:
    """Return 4 q q^T of the unit quaternion q of R."""
    elements = R.flatten(-2).unbind(-1)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = elements
    wx = r21 - r12
    wy = r02 - r20
    wz = r10 - r01
    xy = r10 + r01
    xz = r02 + r20
    yz = r21 + r12
    ww = 1 + r00 + r11 + r22
    xx = 1 + r00 - r11 - r22
    yy = 1 - r00 + r11 - r22
    zz = 1 - r00 - r11 + r22
    rows = (ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz)
    return torch.stack(rows, dim=-1).unflatten(-1, (4, 4))


def average_rotation(
    R: Float[Tensor, "*B H 3 3"],
    weights: Float[Tensor, "*B H"],
) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation of the weighted sum of quaternions, their signs aligned.

    They are aligned with the direction that fits all best: the first eigenvector of the sum of
    w q q^T (Markley et al. 2007), in which the sign of each q is of no consequence. It is taken as
    a constant in gradients. For rotations near one another the sum and it agree.
    """
    q = matrix_to_quaternion(R)
    outer = torch.einsum("...h,...hi,...hj->...ij", weights, q, q).detach()
    main = torch.linalg.eigh(outer).eigenvectors[..., -1]
    agreement = apply(q, main)
    sign = torch.where(agreement < 0, -1.0, 1.0)
    signed_weights = weights * sign
    weighted = signed_weights[..., None] * q
    return quaternion_to_matrix(weighted.sum(-2))


def vector_to_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation by \\|v\\| radians about v (Rodrigues)."""
    half = vector_norm(v, dim=-1, keepdim=True) / 2
    # sinc keeps full precision through angle 0
    axis = v / 2 * torch.sinc(half / torch.pi)
    q = torch.cat((half.cos(), axis), dim=-1)
    return quaternion_to_matrix(q)


def matrix_to_vector(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3"]:
    """Return the rotation vector of R, of at most pi radians."""
    q = matrix_to_quaternion(R)
    cosine = q[..., :1]
    axis = q[..., 1:]
    sine = vector_norm(axis, dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, cosine)
    safe_sine = torch.where(sine > 0, sine, 1.0)
    factor = torch.where(sine > 0, angle / safe_sine, 2.0)
    return axis * factor


def rotation_angle(
    one: Float[Tensor, "*B 3 3"], other: Float[Tensor, "*B 3 3"]
) -> Float[Tensor, "*B"]:
    """Return the angle of the rotation between the two, radians in [0, pi], float64."""
    difference = one.double() @ other.double().mT
    skew = (difference - difference.mT) / 2
    components = (skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0])
    sine = torch.linalg.vector_norm(torch.stack(components, dim=-1), dim=-1)
    trace = difference.diagonal(dim1=-2, dim2=-1).sum(-1)
    # acos loses half of the digits at 0 and 180 degrees; atan2 none.
    return torch.atan2(sine, (trace - 1) / 2)


def rotation_between(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return the smallest rotation that takes the direction of a to that of b.

    Where they are opposite it is some half rotation; where one of them is 0 or not finite it is the
    identity.
    """
    a = _unit(a)
    b = _unit(b)
    cosine = _dot(a, b)
    rejection = b - cosine * a
    length = vector_norm(rejection, dim=-1, keepdim=True)
    distinct = length > _ALIGNED * torch.finfo(a.dtype).eps
    n = _unit(torch.where(distinct, rejection, _perpendicular(a)))
    n = _unit(n - _dot(n, a) * a)
    sine = torch.where(distinct, length, 0.0)
    norm = torch.hypot(cosine, sine)
    cosine = _divide(cosine, norm, 1.0)
    sine = _divide(sine, norm, 0.0)
    na = _outer(n, a)
    along = (cosine - 1)[..., None] * (_outer(a, a) + _outer(n, n))
    across = sine[..., None] * (na - na.mT)
    has_directions = (a != 0).any(-1) & (b != 0).any(-1)
    change = has_directions[..., None, None] * (along + across)
    return identity_like(na) + change


def _perpendicular(a: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Return a vector perpendicular to the unit vector a, of no particular length."""
    axis = a.abs().argmin(-1)
    other = torch.nn.functional.one_hot(axis, 3).to(a.dtype)
    return other - _dot(other, a) * a


def _unit(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Return unit vectors; 0 where v is 0 or not finite.

    Vectors are scaled first, so that tiny and huge ones have a direction too.
    """
    v = where(finite_vectors(v), v, 0.0)
    largest = v.abs().amax(-1, keepdim=True)
    v = v / torch.where(largest > 0, largest, 1.0)
    length = vector_norm(v, dim=-1, keepdim=True)
    return v / torch.where(length > 0, length, 1.0)


def _dot(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 1"]:
    return (a * b).sum(-1, keepdim=True)


def _outer(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    return a[..., :, None] * b[..., None, :]


def _divide(
    numerator: Float[Tensor, "*B"],
    denominator: Float[Tensor, "*B"],
    fallback: float,
) -> Float[Tensor, "*B"]:
    """Return numerator / denominator, and ``fallback`` where the denominator is not positive."""
    positive = denominator > 0
    safe = torch.where(positive, denominator, 1.0)
    return torch.where(positive, numerator / safe, fallback)


def procrustes(
    points: Float[Tensor, "*B J 3"],
    target: Float[Tensor, "*B J 3"],
    mask: Bool[Tensor, "*B J"],
) -> Float[Tensor, "*B J 3"]:
    """Return ``points`` after the similarity that brings those in ``mask`` nearest to ``target``.

    The similarity (rotation, scale, translation; no reflection) is that of least squares (Umeyama
    1991), computed in float64. Only the translation is fitted where fewer than 3 joints are in the
    mask or all of them coincide. The result is finite: joints that are not finite count as not in
    the mask and start at 0.
    """
    finite_points = finite_vectors(points)
    finite_target = finite_vectors(target)
    mask = mask & finite_points & finite_target
    source = where(finite_points, points, 0.0).double()
    goal = where(mask, target, 0.0).double()
    weight = mask[..., None].double()
    count = weight.sum(-2, keepdim=True)
    share = weight / count.clamp(min=1)
    source_mean = (source * share).sum(-2, keepdim=True)
    goal_mean = (goal * share).sum(-2, keepdim=True)
    a = (source - source_mean) * weight
    b = (goal - goal_mean) * weight
    R, trace = _signed_svd(b.mT @ a)
    variance = (a * a).sum((-2, -1))
    determined = (count[..., 0, 0] >= 3) & (variance > 0)
    safe_variance = torch.where(determined, variance, 1.0)
    scale = torch.where(determined, trace / safe_variance, 1.0)
    R = where(determined, R, identity_like(R))
    rotated = (source - source_mean) @ R.mT
    aligned = scale[..., None, None] * rotated + goal_mean
    return torch.where(count > 0, aligned, source).to(points.dtype)
