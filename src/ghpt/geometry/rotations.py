"""Rotations and alignment: pure batched functions; quaternions are w x y z with w >= 0, vectors are
radians."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def is_rotation(R: Float[Tensor, "*B 3 3"], tolerance: float) -> Bool[Tensor, "*B"]:
    """Whether every element of ``R R^T - I`` is within ``tolerance`` and det R > 0; False for NaN
    and inf.
    """
    rows = R.unbind(-2)
    identity = torch.eye(3, dtype=R.dtype, device=R.device)
    orthogonal = ((R @ R.mT - identity).abs() <= tolerance).all(-1).all(-1)
    return orthogonal & ((torch.linalg.cross(rows[0], rows[1]) * rows[2]).sum(-1) > 0)


def _signed_svd(M: Float[Tensor, "*B 3 3"]) -> tuple[Tensor, Tensor]:
    """The rotation R that maximises tr(R^T M), and tr(R^T M); identity and 0 where M is not finite."""
    finite = torch.isfinite(M).all(-1).all(-1)
    # one non-finite matrix would make LAPACK refuse the whole batch
    U, S, Vt = torch.linalg.svd(torch.where(finite[..., None, None], M, 0.0))
    sign = torch.ones_like(S)
    sign[..., 2] = torch.where(torch.linalg.det(U) * torch.linalg.det(Vt) < 0, -1.0, 1.0)
    return (U * sign[..., None, :]) @ Vt, (S * sign).sum(-1)


def nearest_rotation(M: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to M in the Frobenius norm; some rotation where it is not unique or M
    not finite.
    """
    return _signed_svd(M)[0]


def quaternion_to_matrix(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation of a quaternion (w x y z, of any length but 0; 0 gives the identity)."""
    w, x, y, z = q.unbind(-1)
    square = (q * q).sum(-1)
    s = 2 / torch.where(square > 0, square, 1.0)
    return torch.stack(
        (
            1 - s * (y * y + z * z),
            s * (x * y - z * w),
            s * (x * z + y * w),
            s * (x * y + z * w),
            1 - s * (x * x + z * z),
            s * (y * z - x * w),
            s * (x * z - y * w),
            s * (y * z + x * w),
            1 - s * (x * x + y * y),
        ),
        dim=-1,
    ).unflatten(-1, (3, 3))


def matrix_to_quaternion(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """The unit quaternion (w x y z, w >= 0) of a rotation."""
    a = R[..., 0, 0]
    b = R[..., 1, 1]
    c = R[..., 2, 2]
    x = R[..., 2, 1] - R[..., 1, 2]
    y = R[..., 0, 2] - R[..., 2, 0]
    z = R[..., 1, 0] - R[..., 0, 1]
    xy = R[..., 1, 0] + R[..., 0, 1]
    xz = R[..., 0, 2] + R[..., 2, 0]
    yz = R[..., 2, 1] + R[..., 1, 2]
    # 4 q q^T: any row is q up to its length, and the one with the largest diagonal is never near 0
    outer = torch.stack(
        (
            1 + a + b + c,
            x,
            y,
            z,
            x,
            1 + a - b - c,
            xy,
            xz,
            y,
            xy,
            1 - a + b - c,
            yz,
            z,
            xz,
            yz,
            1 - a - b + c,
        ),
        dim=-1,
    ).unflatten(-1, (4, 4))
    row = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = outer.gather(-2, row[..., None, None].expand(*row.shape, 1, 4))[..., 0, :]
    q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def average_rotation(
    R: Float[Tensor, "*B H 3 3"], weights: Float[Tensor, "*B H"]
) -> Float[Tensor, "*B 3 3"]:
    """The rotation of the weighted sum of quaternions, their signs aligned with the direction that
    fits all best.

    That direction is the first eigenvector of the sum of w q q^T (Markley et al. 2007), whose sign
    of each q is of no consequence; it is taken as given in gradients. For rotations near one
    another the sum and it agree.
    """
    q = matrix_to_quaternion(R)
    outer = torch.einsum("...h,...hi,...hj->...ij", weights, q, q).detach()
    main = torch.linalg.eigh(outer).eigenvectors[..., -1]
    sign = torch.where((q @ main[..., None])[..., 0] < 0, -1.0, 1.0)
    return quaternion_to_matrix(((weights * sign)[..., None] * q).sum(-2))


def vector_to_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation by \\|v\\| radians about v (Rodrigues)."""
    half = torch.linalg.vector_norm(v, dim=-1, keepdim=True) / 2
    # sinc keeps full precision through angle 0
    return quaternion_to_matrix(
        torch.cat((half.cos(), v / 2 * torch.sinc(half / torch.pi)), dim=-1)
    )


def matrix_to_vector(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3"]:
    """The rotation vector of R, of at most pi radians."""
    q = matrix_to_quaternion(R)
    sine = torch.linalg.vector_norm(q[..., 1:], dim=-1, keepdim=True)
    factor = torch.where(
        sine > 0, 2 * torch.atan2(sine, q[..., :1]) / torch.where(sine > 0, sine, 1.0), 2.0
    )
    return q[..., 1:] * factor


def rotation_between(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """The smallest rotation that takes the direction of a to that of b.

    Where they are opposite it is some half turn, where one of them is 0 or not finite the identity.
    """
    a = _directions(a)
    b = _directions(b)
    cosine = (a * b).sum(-1, keepdim=True)
    aside = b - cosine * a
    # an axis that a is not near to, for directions so near the line of a that they leave no side to
    # turn to
    other = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a.dtype)
    other = other - (other * a).sum(-1, keepdim=True) * a
    length = torch.linalg.vector_norm(aside, dim=-1, keepdim=True)
    sided = length > 16 * torch.finfo(a.dtype).eps
    n = _directions(torch.where(sided, aside, other))
    n = _directions(n - (n * a).sum(-1, keepdim=True) * a)
    sine = torch.where(sided, length, 0.0)
    norm = torch.hypot(cosine, sine)
    cosine, sine = (
        torch.where(norm > 0, x / torch.where(norm > 0, norm, 1.0), d)
        for x, d in ((cosine, 1.0), (sine, 0.0))
    )
    aa, nn, na = (x[..., :, None] * y[..., None, :] for x, y in ((a, a), (n, n), (n, a)))
    identity = torch.eye(3, dtype=a.dtype, device=a.device)
    defined = ((a != 0).any(-1) & (b != 0).any(-1))[..., None, None]
    return identity + defined * (
        (cosine - 1)[..., None] * (aa + nn) + sine[..., None] * (na - na.mT)
    )


def _directions(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Unit vectors; 0 where v is 0 or not finite. Scaled first, so that tiny and huge vectors have
    one too.
    """
    v = torch.where(torch.isfinite(v).all(-1, keepdim=True), v, 0.0)
    largest = v.abs().amax(-1, keepdim=True)
    v = v / torch.where(largest > 0, largest, 1.0)
    length = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return v / torch.where(length > 0, length, 1.0)


def procrustes(
    points: Float[Tensor, "*B J 3"], target: Float[Tensor, "*B J 3"], mask: Bool[Tensor, "*B J"]
) -> Float[Tensor, "*B J 3"]:
    """``points`` after the similarity (rotation, scale, translation; no reflection) that brings
    those in ``mask`` nearest to ``target`` in least squares (Umeyama 1991).

    Only the translation is fitted where fewer than 3 joints are in the mask or all of them
    coincide. The result is finite: joints that are not finite count as not in the mask and start at
    0. float64 inside.
    """
    finite = torch.isfinite(points).all(-1) & torch.isfinite(target).all(-1)
    mask = mask & finite
    source = torch.where(torch.isfinite(points).all(-1, keepdim=True), points, 0.0).to(
        torch.float64
    )
    goal = torch.where(mask[..., None], target, 0.0).to(torch.float64)
    weight = mask[..., None].to(torch.float64)
    count = weight.sum(-2, keepdim=True)
    share = weight / count.clamp(min=1)
    source_mean, goal_mean = ((x * share).sum(-2, keepdim=True) for x in (source, goal))
    a = (source - source_mean) * weight
    b = (goal - goal_mean) * weight
    R, trace = _signed_svd(b.mT @ a)
    variance = (a * a).sum((-2, -1))
    fits = (count[..., 0, 0] >= 3) & (variance > 0)
    scale = torch.where(fits, trace / torch.where(fits, variance, 1.0), 1.0)
    R = torch.where(fits[..., None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
    aligned = scale[..., None, None] * ((source - source_mean) @ R.mT) + goal_mean
    return torch.where(count > 0, aligned, source).to(points.dtype)
