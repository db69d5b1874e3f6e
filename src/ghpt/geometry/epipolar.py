"""Two views: the 8-point algorithm, the essential matrix, its four poses, distances of rays.

Points are normalised image coordinates, ``(x, y, 1) = K^-1 (u, v, 1)``, of the reference camera a
and the target camera b: ``x_b = R x_a + t``, ``E = [t]x R``, ``b^T E a = 0``. t has length 1.
Everything is batched and never raises on values: what a set of points does not determine is masked.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.masking import (
    apply,
    finite_matrices,
    finite_vectors,
    identity_like,
    where,
)

MINIMUM = 8
"""Correspondences that the 8-point algorithm needs."""
DEGENERATE = 1e-10
"""The second smallest eigenvalue of the (normalised) equations over the largest, below which they
have more than one solution: collinear points, a plane, coinciding cameras, a pure rotation.

Exact points of such scenes give up to 1e-13, pixels in float32 1e-12; a person in one pose 1e-4 and
more, 8 random joints 1e-8 (one sample in thousands falls below the limit and is lost). Key-point
noise hides the degenerate scenes: at 3 pixels they too give 1e-5 to 1e-3, so this eigenvalue cannot
tell them, and the pose that comes of them means nothing.
"""

_OUTLIER = 3.0
_MEDIAN_SAMPLES = 256
"""A median of residuals needs no more of them."""
_PARALLEL = 1e-14
"""Squared sine of the angle between two rays below which they have no nearest points."""


def normalise(
    K: Float[Tensor, "*B 3 3"],
    pixels: Float[Tensor, "*B N 2"],
) -> Float[Tensor, "*B N 2"]:
    """Return pixels as normalised image coordinates, float64.

    K is upper triangular with last row (0, 0, 1).
    """
    K = K.double()[..., None, :, :]
    u, v = pixels.double().unbind(-1)
    y = (v - K[..., 1, 2]) / K[..., 1, 1]
    x = (u - K[..., 0, 2] - K[..., 0, 1] * y) / K[..., 0, 0]
    return torch.stack((x, y), dim=-1)


def homogeneous(points: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 3"]:
    """Return (x, y, 1) of (x, y)."""
    one = torch.ones_like(points[..., :1])
    return torch.cat((points, one), dim=-1)


def cross_matrix(t: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return [t]x, with ``[t]x v = t x v``."""
    x, y, z = t.unbind(-1)
    zero = torch.zeros_like(x)
    elements = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(elements, dim=-1).unflatten(-1, (3, 3))


def essential(R: Float[Tensor, "*B 3 3"], t: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return E = [t]x R of a relative pose."""
    return cross_matrix(t) @ R


def fundamental(
    K: Float[Tensor, "*B 3 3"],
    K_other: Float[Tensor, "*B 3 3"],
    R: Float[Tensor, "*B 3 3"],
    t: Float[Tensor, "*B 3"],
) -> Float[Tensor, "*B 3 3"]:
    """Return F of ``x_other^T F x = 0``, in pixels, of cameras with ``X_other = R X + t``."""
    return torch.linalg.inv(K_other).mT @ essential(R, t) @ torch.linalg.inv(K)


def _hartley(
    points: Float[Tensor, "*B N 2"],
    weights: Float[Tensor, "*B N"],
) -> tuple[Float[Tensor, "*B N 2"], Float[Tensor, "*B 3 3"]]:
    """Return points with mean 0 and mean distance sqrt(2), and the matrix that makes them so.

    This is the normalisation of Hartley (1997).
    """
    tiny = torch.finfo(weights.dtype).tiny
    total = weights.sum(-1, keepdim=True)
    share = weights / total.clamp_min(tiny)
    mean = (share[..., None] * points).sum(-2)
    centred = points - mean[..., None, :]
    distance = (share * centred.norm(dim=-1)).sum(-1)
    scale = 2**0.5 / torch.where(distance > 0, distance, 1.0)
    diagonal = (scale, scale, torch.ones_like(scale))
    T = torch.diag_embed(torch.stack(diagonal, dim=-1))
    T[..., :2, 2] = -scale[..., None] * mean
    return centred * scale[..., None, None], T


def correspondence_rows(
    a: Float[Tensor, "*B N d"],
    b: Float[Tensor, "*B N d"],
) -> Float[Tensor, "*B N d*d"]:
    """Return the rows r with ``r . vec(E) = b^T E a`` of homogeneous points a and b."""
    outer = b[..., :, None] * a[..., None, :]
    return outer.flatten(-2)


def eight_point(
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    weights: Float[Tensor, "*B N"],
) -> tuple[Float[Tensor, "*B 3 3"], Bool[Tensor, "*B"]]:
    """Return the essential matrix that minimises the weighted sum of (b^T E a)^2, and its validity.

    The matrix (singular values 1, 1, 0) is that of the normalised 8-point algorithm. It is valid if
    the points determine one, so at least 8 have a weight; otherwise it is 0. A point with weight 0
    is not used, whatever its numbers are.
    """
    finite = finite_vectors(a) & finite_vectors(b)
    used = (weights > 0) & finite
    weights = torch.where(used, weights, 0.0).double()
    safe_a = where(used, a, 0.0).double()
    safe_b = where(used, b, 0.0).double()
    normalised_a, Ta = _hartley(safe_a, weights)
    normalised_b, Tb = _hartley(safe_b, weights)
    rows = correspondence_rows(homogeneous(normalised_a), homogeneous(normalised_b))
    normal = rows.mT @ (weights[..., None] * rows)
    return _solve_essential(normal, used.sum(-1), Ta, Tb)


def eight_point_subsets(
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    weights: Float[Tensor, "*B H N"],
) -> tuple[Float[Tensor, "*B H 3 3"], Bool[Tensor, "*B H"]]:
    """Return ``eight_point`` under each of H weightings of the same points, which must be finite.

    The points are normalised once, by all that any weighting uses; the normal equations of all
    weightings are one product of matrices.
    """
    weights = weights.double()
    used_by_any = (weights > 0).any(-2).double()
    normalised_a, Ta = _hartley(a.double(), used_by_any)
    normalised_b, Tb = _hartley(b.double(), used_by_any)
    rows = correspondence_rows(homogeneous(normalised_a), homogeneous(normalised_b))
    i, j = torch.triu_indices(9, 9, device=rows.device)
    upper = weights @ (rows[..., i] * rows[..., j])
    shape = (*weights.shape[:-1], 9, 9)
    normal = torch.empty(shape, dtype=rows.dtype, device=rows.device)
    normal[..., i, j] = upper
    normal[..., j, i] = upper
    count = (weights > 0).sum(-1)
    return _solve_essential(normal, count, Ta.unsqueeze(-3), Tb.unsqueeze(-3))


def robust_weights(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B N"],
) -> Float[Tensor, "*B H N"]:
    """Return weights of (b^T E a)^2 that make it Geman and McClure's loss of the Sampson distance.

    With r that distance, they are ``1 / (1 + (r / s)^2)^2`` over its squared gradient, with s three
    times the median of r, about four standard deviations of the inliers. The largest is 1, those of
    unused points are 0.
    """
    tiny = torch.finfo(E.dtype).tiny
    residual, gradient = _sampson_terms(E, homogeneous(a), homogeneous(b))
    gradient = gradient.clamp_min(tiny)
    square = residual.square() / gradient
    stride = -(-a.shape[-2] // _MEDIAN_SAMPLES)
    sampled_used = used[..., None, ::stride]
    sampled_square = torch.where(sampled_used, square[..., ::stride], torch.nan)
    median = sampled_square.nanmedian(dim=-1, keepdim=True).values
    scale = (_OUTLIER**2 * median).nan_to_num(1.0).clamp_min(tiny)
    weights = 1 / ((1 + square / scale).square() * gradient)
    weights = torch.where(used[..., None, :], weights, 0.0)
    largest = weights.amax(dim=-1, keepdim=True)
    return weights / largest.clamp_min(tiny)


def _solve_essential(
    normal: Float[Tensor, "*B 9 9"],
    count: Int[Tensor, "*B"],
    Ta: Float[Tensor, "*#B 3 3"],
    Tb: Float[Tensor, "*#B 3 3"],
) -> tuple[Float[Tensor, "*B 3 3"], Bool[Tensor, "*B"]]:
    """Return the essential matrix of normal equations, and whether they have one solution."""
    finite = finite_matrices(normal)
    safe_normal = where(finite, normal, 0.0)
    values, vectors = torch.linalg.eigh(safe_normal)
    unique = values[..., 1] > DEGENERATE * values[..., -1]
    valid = finite & (count >= MINIMUM) & unique
    solution = vectors[..., 0].unflatten(-1, (3, 3))
    F = Tb.mT @ solution @ Ta
    safe_F = where(valid, F, identity_like(F))
    U, _, Vt = torch.linalg.svd(safe_F)
    E = U[..., :2] @ Vt[..., :2, :]
    return where(valid, E, 0.0), valid


def decompose(
    E: Float[Tensor, "*B 3 3"],
) -> tuple[Float[Tensor, "*B 4 3 3"], Float[Tensor, "*B 4 3"]]:
    """Return the four relative poses of an essential matrix: (R1, t), (R1, -t), (R2, t), (R2, -t).

    t has length 1. The poses are finite and meaningless where E is not finite.
    """
    safe_E = where(finite_matrices(E), E, 0.0)
    U, _, Vt = torch.linalg.svd(safe_E)
    U = _with_positive_determinant(U)
    Vt = _with_positive_determinant(Vt)
    W = E.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    R1 = U @ W @ Vt
    R2 = U @ W.mT @ Vt
    t = U[..., 2]
    rotations = torch.stack((R1, R1, R2, R2), dim=-3)
    translations = torch.stack((t, -t, t, -t), dim=-2)
    return rotations, translations


def _with_positive_determinant(M: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    sign = torch.where(torch.linalg.det(M) < 0, -1.0, 1.0)
    return M * sign[..., None, None]


def depths(
    R: Float[Tensor, "*#B 3 3"],
    t: Float[Tensor, "*#B 3"],
    a: Float[Tensor, "*#B N 2"],
    b: Float[Tensor, "*#B N 2"],
) -> tuple[Float[Tensor, "*#B N"], Float[Tensor, "*#B N"]]:
    """Return, in units of t, the depths in a and in b of the points where their rays are nearest.

    The points are at ``alpha R a`` and ``beta b - t`` in b's axes (all from a's centre). Depths are
    0 for parallel rays.
    """
    u = homogeneous(a) @ R.mT
    v = homogeneous(b)
    uu = (u * u).sum(-1)
    vv = (v * v).sum(-1)
    uv = (u * v).sum(-1)
    ut = apply(u, t)
    vt = apply(v, t)
    determinant = uu * vv - uv * uv
    crossing = determinant > _PARALLEL * uu * vv
    safe = torch.where(crossing, determinant, 1.0)
    alpha = (uv * vt - vv * ut) / safe
    beta = (uu * vt - uv * ut) / safe
    return torch.where(crossing, alpha, 0.0), torch.where(crossing, beta, 0.0)


def in_front(
    R: Float[Tensor, "*#B 3 3"],
    t: Float[Tensor, "*#B 3"],
    a: Float[Tensor, "*#B N 2"],
    b: Float[Tensor, "*#B N 2"],
) -> Bool[Tensor, "*#B N"]:
    """Return which points lie in front of both cameras."""
    alpha, beta = depths(R, t, a, b)
    return (alpha > 0) & (beta > 0)


def pose_in_front(
    E: Float[Tensor, "*B 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B N"],
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"], Bool[Tensor, "*B"]]:
    """Return ``poses_in_front`` of one essential matrix for each set of points."""
    R, t, valid = poses_in_front(E[..., None, :, :], a, b, used[..., None, :])
    return R[..., 0, :, :], t[..., 0, :], valid[..., 0]


def poses_in_front(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B H N"],
) -> tuple[Float[Tensor, "*B H 3 3"], Float[Tensor, "*B H 3"], Bool[Tensor, "*B H"]]:
    """Return the pose of each of H essential matrices with most of its used points in front.

    Also returns whether one of its four poses has more of them than the others; the pose is the
    identity and t = 0 where none has.
    """
    rotations, translations = decompose(E)
    # the poses of +t; those of -t are counted by their signs
    R = rotations[..., ::2, :, :]
    t = translations[..., ::2, :]
    count = _count_in_front(R, t, a, b, used)
    top = count.topk(2, dim=-1)
    best = top.indices[..., 0]
    valid = top.values[..., 0] > top.values[..., 1]
    index = (best // 2)[..., None, None]
    R_index = index[..., None].expand(*best.shape, 1, 3, 3)
    best_R = R.gather(-3, R_index)[..., 0, :, :]
    best_t = t.gather(-2, index.expand(*best.shape, 1, 3))[..., 0, :]
    sign = 1 - 2 * (best % 2)
    best_t = best_t * sign[..., None]
    best_R = where(valid, best_R, identity_like(best_R))
    best_t = where(valid, best_t, 0.0)
    return best_R, best_t, valid


def _count_in_front(
    R: Float[Tensor, "*B H 2 3 3"],
    t: Float[Tensor, "*B H 2 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B H N"],
) -> Int[Tensor, "*B H 4"]:
    """Count the used points in front of both cameras under (R1, t), (R1, -t), (R2, t), (R2, -t).

    Only signs are needed: with unit rays f, those of the depths' numerators (see ``depths``), and
    -t flips both.
    """
    fa = _unit_rays(a)
    fb = _unit_rays(b)
    pairs = correspondence_rows(fa, fb).mT
    R_rows = R.flatten(-2).flatten(-3, -2)
    uv = (R_rows @ pairs).unflatten(-2, (-1, 2))
    t_in_a = apply(R.mT, t)
    ut = (t_in_a.flatten(-3, -2) @ fa.mT).unflatten(-2, (-1, 2))
    vt = (t.flatten(-3, -2) @ fb.mT).unflatten(-2, (-1, 2))
    alpha = uv * vt - ut
    beta = vt - uv * ut
    used = used[..., None, :]
    forward = (alpha > 0) & (beta > 0) & used
    backward = (alpha < 0) & (beta < 0) & used
    counts = (forward.sum(-1), backward.sum(-1))
    return torch.stack(counts, dim=-1).flatten(-2)


def _unit_rays(points: Float[Tensor, "*B N 2"]) -> Float[Tensor, "*B N 3"]:
    ray = homogeneous(points)
    return ray / ray.norm(dim=-1, keepdim=True)


def ray_distances(
    R: Float[Tensor, "*B H 3 3"],
    t: Float[Tensor, "*B H 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
) -> Float[Tensor, "*B H N"]:
    """Return the distances between corresponding rays (as lines) under each of H poses.

    Distances are in units of t (of length 1). With unit rays f each is |f_b^T E f_a| / |R f_a x
    f_b|: two products of matrices for all poses and points. Rays closer than 1e-6 rad to parallel
    have no well-defined distance and get at most 1.
    """
    pairs = correspondence_rows(_unit_rays(a), _unit_rays(b)).mT
    E = essential(R, t)
    numerator = (E.flatten(-2) @ pairs).abs()
    cosine = R.flatten(-2) @ pairs
    square_sine = (1 - cosine * cosine).clamp_min(1e-12)
    distance = numerator / square_sine.sqrt()
    return distance.clamp(max=1)


def sampson_error(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
) -> Float[Tensor, "*B H N"]:
    """Return the first-order distance of correspondences from each of H epipolar geometries.

    It is in normalised image coordinates and >= 0.
    """
    tiny = torch.finfo(E.dtype).tiny
    residual, gradient = _sampson_terms(E, homogeneous(a), homogeneous(b))
    return residual.abs() / gradient.clamp_min(tiny).sqrt()


def sampson_jacobian(
    E: Float[Tensor, "*B 3 3"],
    a: Float[Tensor, "*B N 3"],
    b: Float[Tensor, "*B N 3"],
) -> tuple[Float[Tensor, "*B N"], Float[Tensor, "*B N 9"]]:
    """Return signed Sampson distances of homogeneous points, and their derivatives by vec(E)."""
    tiny = torch.finfo(E.dtype).tiny
    lines_a = a @ E.mT
    lines_b = b @ E
    residual = (b * lines_a).sum(-1)
    normals_a = torch.cat((lines_a[..., :2], torch.zeros_like(lines_a[..., :1])), dim=-1)
    normals_b = torch.cat((lines_b[..., :2], torch.zeros_like(lines_b[..., :1])), dim=-1)
    gradient = (normals_a.square() + normals_b.square()).sum(-1).clamp_min(tiny)
    distance = residual / gradient.sqrt()
    of_residual = correspondence_rows(a, b) / gradient.sqrt()[..., None]
    of_gradient = correspondence_rows(a, normals_a) + correspondence_rows(normals_b, b)
    return distance, of_residual - (distance / gradient)[..., None] * of_gradient


def _sampson_terms(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 3"],
    b: Float[Tensor, "*B N 3"],
) -> tuple[Float[Tensor, "*B H N"], Float[Tensor, "*B H N"]]:
    """Return the residual b^T E a and its squared gradient in image coordinates."""
    residual = E.flatten(-2) @ correspondence_rows(a, b).mT
    square_a = _square_line_normals(E, a)
    square_b = _square_line_normals(E.mT, b)
    return residual, square_a + square_b


def _square_line_normals(
    E: Float[Tensor, "*B H 3 3"],
    points: Float[Tensor, "*B N 3"],
) -> Float[Tensor, "*B H N"]:
    """Return the squared norm of the first two components of the epipolar lines ``E x``."""
    rows = E[..., :2, :].flatten(-3, -2)
    normals = (rows @ points.mT).unflatten(-2, (-1, 2))
    return normals.square().sum(-2)
