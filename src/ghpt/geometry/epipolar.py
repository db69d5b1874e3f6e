"""Two views: normalised 8-point algorithm, essential matrix, the four relative poses, distances of
rays.

Points are normalised image coordinates, ``(x, y, 1) = K^-1 (u, v, 1)``, of the reference camera a
and the target camera b: ``x_b = R x_a + t``, ``E = [t]x R``, ``b^T E a = 0``. t has length 1.
Everything is batched and never raises on values: what a set of points does not determine is masked.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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


def normalise(
    K: Float[Tensor, "*B 3 3"], pixels: Float[Tensor, "*B N 2"]
) -> Float[Tensor, "*B N 2"]:
    """Pixels as normalised image coordinates, float64; K is upper triangular with last row (0, 0,
    1).
    """
    K = K.double()[..., None, :, :]
    pixels = pixels.double()
    y = (pixels[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    x = (pixels[..., 0] - K[..., 0, 2] - K[..., 0, 1] * y) / K[..., 0, 0]
    return torch.stack((x, y), dim=-1)


def homogeneous(points: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 3"]:
    return torch.cat((points, torch.ones_like(points[..., :1])), dim=-1)


def cross_matrix(t: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """[t]x, with ``[t]x v = t x v``."""
    x, y, z = t.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))


def essential(R: Float[Tensor, "*B 3 3"], t: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """E = [t]x R of a relative pose."""
    return cross_matrix(t) @ R


def _hartley(
    points: Float[Tensor, "*B N 2"], weights: Float[Tensor, "*B N"]
) -> tuple[Tensor, Tensor]:
    """Points with mean 0 and mean distance sqrt(2) (Hartley 1997), and the 3x3 matrix that makes
    them so.
    """
    share = weights / weights.sum(-1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
    mean = (share[..., None] * points).sum(-2)
    centred = points - mean[..., None, :]
    distance = (share * centred.norm(dim=-1)).sum(-1)
    scale = 2**0.5 / torch.where(distance > 0, distance, 1.0)
    T = torch.diag_embed(torch.stack((scale, scale, torch.ones_like(scale)), dim=-1))
    T[..., :2, 2] = -scale[..., None] * mean
    return centred * scale[..., None, None], T


def eight_point(
    a: Float[Tensor, "*B N 2"], b: Float[Tensor, "*B N 2"], weights: Float[Tensor, "*B N"]
) -> tuple[Float[Tensor, "*B 3 3"], Bool[Tensor, "*B"]]:
    """The essential matrix (singular values 1, 1, 0) that minimises the weighted sum of (b^T E
    a)^2, by the normalised 8-point algorithm, and whether the points determine one (then at least 8
    have a weight); 0 where not.

    A point with weight 0 is not used, whatever its numbers are.
    """
    used = (weights > 0) & torch.isfinite(a).all(-1) & torch.isfinite(b).all(-1)
    weights = torch.where(used, weights, 0.0).double()
    (rows_a, Ta), (rows_b, Tb) = (
        _hartley(torch.where(used[..., None], x, 0.0).double(), weights) for x in (a, b)
    )
    rows = (homogeneous(rows_b)[..., :, None] * homogeneous(rows_a)[..., None, :]).flatten(-2)
    return _smallest(rows.mT @ (weights[..., None] * rows), used.sum(-1), Ta, Tb)


def eight_point_subsets(
    a: Float[Tensor, "*B N 2"], b: Float[Tensor, "*B N 2"], weights: Float[Tensor, "*B H N"]
) -> tuple[Float[Tensor, "*B H 3 3"], Bool[Tensor, "*B H"]]:
    """``eight_point`` under each of H weightings of the same points, which must be finite: one
    product of matrices.

    The points are normalised once, by all that any weighting uses.
    """
    weights = weights.double()
    anywhere = (weights > 0).any(-2).double()
    (a, Ta) = _hartley(a.double(), anywhere)
    (b, Tb) = _hartley(b.double(), anywhere)
    rows = (homogeneous(b)[..., :, None] * homogeneous(a)[..., None, :]).flatten(-2)
    i, j = torch.triu_indices(9, 9, device=rows.device)
    normal = torch.empty((*weights.shape[:-1], 9, 9), dtype=rows.dtype, device=rows.device)
    normal[..., i, j] = weights @ (rows[..., i] * rows[..., j])
    normal[..., j, i] = normal[..., i, j]
    return _smallest(normal, (weights > 0).sum(-1), Ta[..., None, :, :], Tb[..., None, :, :])


def robust_weights(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B N"],
) -> Float[Tensor, "*B H N"]:
    """Weights of (b^T E a)^2 that make it the squared Sampson distance r^2 under Geman and
    McClure's loss, ``1 / (1 + (r / s)^2)^2`` with s three times the median of r, about four
    standard deviations of what is no outlier; the largest is 1, of unused points 0.
    """
    ha = homogeneous(a)
    hb = homogeneous(b)
    residual = E.flatten(-2) @ (hb[..., :, None] * ha[..., None, :]).flatten(-2).mT
    gradient = (E[..., :2, :].flatten(-3, -2) @ ha.mT).square().unflatten(-2, (-1, 2)).sum(-2)
    gradient += (E.mT[..., :2, :].flatten(-3, -2) @ hb.mT).square().unflatten(-2, (-1, 2)).sum(-2)
    tiny = torch.finfo(E.dtype).tiny
    gradient = gradient.clamp_min(tiny)
    square = residual.square() / gradient
    few = slice(None, None, -(-a.shape[-2] // 256))  # a median needs no more
    some = torch.where(used[..., None, few], square[..., few], torch.nan)
    scale = (
        (_OUTLIER**2 * some.nanmedian(dim=-1, keepdim=True).values).nan_to_num(1.0).clamp_min(tiny)
    )
    weights = torch.where(used[..., None, :], 1 / ((1 + square / scale).square() * gradient), 0.0)
    return weights / weights.amax(dim=-1, keepdim=True).clamp_min(tiny)


def _smallest(normal: Tensor, count: Tensor, Ta: Tensor, Tb: Tensor) -> tuple[Tensor, Tensor]:
    """The essential matrix of normal equations, and whether they have one solution."""
    finite = torch.isfinite(normal).all(-1).all(-1)
    values, vectors = torch.linalg.eigh(torch.where(finite[..., None, None], normal, 0.0))
    ok = finite & (count >= MINIMUM) & (values[..., 1] > DEGENERATE * values[..., -1])
    F = Tb.mT @ vectors[..., 0].unflatten(-1, (3, 3)) @ Ta
    U, _, Vt = torch.linalg.svd(
        torch.where(ok[..., None, None], F, torch.eye(3, dtype=F.dtype, device=F.device))
    )
    E = U[..., :2] @ Vt[..., :2, :]
    return torch.where(ok[..., None, None], E, 0.0), ok


def decompose(
    E: Float[Tensor, "*B 3 3"],
) -> tuple[Float[Tensor, "*B 4 3 3"], Float[Tensor, "*B 4 3"]]:
    """The four relative poses of an essential matrix: (R1, t), (R1, -t), (R2, t), (R2, -t), t of
    length 1. Finite and meaningless where E is not finite.
    """
    finite = torch.isfinite(E).all(-1).all(-1)[..., None, None]
    U, _, Vt = torch.linalg.svd(torch.where(finite, E, 0.0))
    U, Vt = (M * torch.where(torch.linalg.det(M) < 0, -1.0, 1.0)[..., None, None] for M in (U, Vt))
    W = E.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    R1 = U @ W @ Vt
    R2 = U @ W.mT @ Vt
    t = U[..., 2]
    return torch.stack((R1, R1, R2, R2), dim=-3), torch.stack((t, -t, t, -t), dim=-2)


def depths(
    R: Float[Tensor, "*#B 3 3"],
    t: Float[Tensor, "*#B 3"],
    a: Float[Tensor, "*#B N 2"],
    b: Float[Tensor, "*#B N 2"],
) -> tuple[Float[Tensor, "*#B N"], Float[Tensor, "*#B N"]]:
    """Depths, in units of t: in a of the point of a's ray nearest to b's, in b of that of b's ray;
    0 for parallel rays.

    These points are at ``alpha R a`` and ``beta b - t`` in b's axes (all from a's centre).
    """
    u = homogeneous(a) @ R.mT
    v = homogeneous(b)
    uu = (u * u).sum(-1)
    vv = (v * v).sum(-1)
    uv = (u * v).sum(-1)
    ut = (u @ t[..., None])[..., 0]
    vt = (v @ t[..., None])[..., 0]
    determinant = uu * vv - uv * uv
    good = determinant > 1e-14 * uu * vv
    safe = torch.where(good, determinant, 1.0)
    alpha = (uv * vt - vv * ut) / safe
    beta = (uu * vt - uv * ut) / safe
    return torch.where(good, alpha, 0.0), torch.where(good, beta, 0.0)


def in_front(
    R: Float[Tensor, "*#B 3 3"],
    t: Float[Tensor, "*#B 3"],
    a: Float[Tensor, "*#B N 2"],
    b: Float[Tensor, "*#B N 2"],
) -> Bool[Tensor, "*#B N"]:
    """Which points lie in front of both cameras."""
    alpha, beta = depths(R, t, a, b)
    return (alpha > 0) & (beta > 0)


def pose_in_front(
    E: Float[Tensor, "*B 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B N"],
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"], Bool[Tensor, "*B"]]:
    """``poses_in_front`` of one essential matrix for each set of points."""
    R, t, ok = poses_in_front(E[..., None, :, :], a, b, used[..., None, :])
    return R[..., 0, :, :], t[..., 0, :], ok[..., 0]


def poses_in_front(
    E: Float[Tensor, "*B H 3 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
    used: Bool[Tensor, "*B H N"],
) -> tuple[Float[Tensor, "*B H 3 3"], Float[Tensor, "*B H 3"], Bool[Tensor, "*B H"]]:
    """Of the four poses of each of H essential matrices the one with most of its used points in
    front, and whether one has more than the others. Identity and t = 0 where none has.

    Only signs are needed: with unit rays f, those of the depths' numerators (see ``depths``), and
    -t flips both.
    """
    Rs, ts = (x[..., ::2, :, :] if x.dim() > E.dim() else x[..., ::2, :] for x in decompose(E))
    fa, fb = (homogeneous(x) / homogeneous(x).norm(dim=-1, keepdim=True) for x in (a, b))
    products = (fb[..., :, None] * fa[..., None, :]).flatten(-2).mT
    uv = (Rs.flatten(-2).flatten(-3, -2) @ products).unflatten(-2, (-1, 2))
    ut = ((Rs.mT @ ts[..., None])[..., 0].flatten(-3, -2) @ fa.mT).unflatten(-2, (-1, 2))
    vt = (ts.flatten(-3, -2) @ fb.mT).unflatten(-2, (-1, 2))
    alpha = uv * vt - ut
    beta = vt - uv * ut
    forward = (alpha > 0) & (beta > 0) & used[..., None, :]
    backward = (alpha < 0) & (beta < 0) & used[..., None, :]
    count = torch.stack((forward.sum(-1), backward.sum(-1)), dim=-1).flatten(-2)
    top = count.topk(2, dim=-1)
    best = top.indices[..., 0]
    ok = top.values[..., 0] > top.values[..., 1]
    index = (best // 2)[..., None, None]
    R = Rs.gather(-3, index[..., None].expand(*best.shape, 1, 3, 3))[..., 0, :, :]
    t = ts.gather(-2, index.expand(*best.shape, 1, 3))[..., 0, :] * (1 - 2 * (best % 2))[..., None]
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return torch.where(ok[..., None, None], R, eye), torch.where(ok[..., None], t, 0.0), ok


def ray_distances(
    R: Float[Tensor, "*B H 3 3"],
    t: Float[Tensor, "*B H 3"],
    a: Float[Tensor, "*B N 2"],
    b: Float[Tensor, "*B N 2"],
) -> Float[Tensor, "*B H N"]:
    """Distances, in units of t (of length 1), between the corresponding rays (as lines) under each
    of H poses.

    With unit rays f it is |f_b^T E f_a| / |R f_a x f_b|: two products of matrices for all poses and
    points. Rays closer than 1e-6 rad to parallel have no well-defined distance and get at most 1.
    """
    fa, fb = (homogeneous(x) / homogeneous(x).norm(dim=-1, keepdim=True) for x in (a, b))
    products = (fb[..., :, None] * fa[..., None, :]).flatten(-2).mT
    numerator = (essential(R, t).flatten(-2) @ products).abs()
    cosine = R.flatten(-2) @ products
    return (numerator / (1 - cosine * cosine).clamp_min(1e-12).sqrt()).clamp(max=1)


def sampson_error(
    E: Float[Tensor, "*B H 3 3"], a: Float[Tensor, "*B N 2"], b: Float[Tensor, "*B N 2"]
) -> Float[Tensor, "*B H N"]:
    """First-order distance of each correspondence from each of H epipolar geometries (normalised
    image coordinates, >= 0).
    """
    a = homogeneous(a)
    b = homogeneous(b)
    residual = E.flatten(-2) @ (b[..., :, None] * a[..., None, :]).flatten(-2).mT
    Ea = (E[..., :2, :].flatten(-3, -2) @ a.mT).unflatten(-2, (-1, 2))
    Eb = (E.mT[..., :2, :].flatten(-3, -2) @ b.mT).unflatten(-2, (-1, 2))
    square = Ea.square().sum(-2) + Eb.square().sum(-2)
    return residual.abs() / square.clamp_min(torch.finfo(E.dtype).tiny).sqrt()
