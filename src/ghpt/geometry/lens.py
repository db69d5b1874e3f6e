"""Lens distortion: OpenCV's Brown-Conrady model, undone where the key points enter.

Coefficients are k1 k2 p1 p2 [k3 [k4 k5 k6]]: in normalised image coordinates with s = x^2 + y^2,
``x_d = x (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) + 2 p1 x y + p2 (s + 2 x^2)``
and y likewise.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_STEPS = 100
_CONVERGED = 1e-12
"""In normalised coordinates, so 1e-9 pixels or less."""


def distort(
    pixels: Float[Tensor, "*B N 2"], K: Float[Tensor, "*B 3 3"], coefficients: Float[Tensor, "*B C"]
) -> Float[Tensor, "*B N 2"]:
    """Where the lens shows the points whose ideal pinhole pixels are given; float64. C is 4, 5 or
    8.
    """
    ideal = _normalise(pixels, K)
    return _to_pixels(_lens(ideal, _eight(coefficients))[0], K)


def undistort(
    pixels: Float[Tensor, "*B N 2"], K: Float[Tensor, "*B 3 3"], coefficients: Float[Tensor, "*B C"]
) -> tuple[Float[Tensor, "*B N 2"], Bool[Tensor, "*B N"]]:
    """The ideal pinhole pixels (same K, float64) of pixels seen through the lens, and whether they
    exist.

    A pixel that no ray of the lens's invertible region reaches (or that is not finite) has no such
    point: its mask is False and the pixel comes back as it was (0 if not finite). C is 4, 5 or 8.
    """
    given = torch.isfinite(pixels).all(-1)
    safe = torch.where(given[..., None], pixels.to(torch.float64), 0.0)
    lens = _eight(coefficients)
    valid = _normalise(safe, K)
    # just inside: on the limit itself the Jacobian is singular or the model has its pole
    limit = _largest_radius(lens)[..., None] * (1 - 1e-9)
    point = _within(valid, limit)
    done = torch.zeros_like(given)
    for _ in range(_STEPS):
        value, (xx, xy, yx, yy) = _lens(point, lens)
        error = value - valid
        done = done | (error.abs().amax(-1) <= _CONVERGED * (1 + valid.abs().amax(-1)))
        if done.all():
            break
        determinant = xx * yy - xy * yx
        u, v = error.unbind(-1)
        step = torch.stack((yy * u - xy * v, xx * v - yx * u), dim=-1)
        step = step / torch.where(determinant == 0, 1.0, determinant)[..., None]
        # those that are done stay: the digits of a point must not depend on the points beside it
        point = torch.where(done[..., None], point, _within(point - step, limit))
    xx, xy, yx, yy = _lens(point, lens)[1]
    exists = (
        given & done & (xx * yy - xy * yx > 0) & (torch.linalg.vector_norm(point, dim=-1) <= limit)
    )
    return torch.where(exists[..., None], _to_pixels(point, K), safe), exists


def _eight(coefficients: Float[Tensor, "*B C"]) -> Float[Tensor, "*B 1 8"]:
    count = coefficients.shape[-1]
    if count not in (4, 5, 8):
        raise ValueError(f"OpenCV's lens model has 4, 5 or 8 coefficients here, not {count}")
    return torch.nn.functional.pad(coefficients.to(torch.float64), (0, 8 - count))[..., None, :]


def _normalise(pixels: Tensor, K: Tensor) -> Tensor:
    K = K.to(torch.float64)[..., None, :, :]
    x, y = (pixels.to(torch.float64) - K[..., :2, 2]).unbind(-1)
    y = y / K[..., 1, 1]
    return torch.stack(((x - K[..., 0, 1] * y) / K[..., 0, 0], y), dim=-1)


def _to_pixels(point: Tensor, K: Tensor) -> Tensor:
    K = K.to(torch.float64)
    return point @ K[..., :2, :2].mT + K[..., None, :2, 2]


def _lens(point: Tensor, lens: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The distorted points and the four elements of the Jacobian, row by row."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.unbind(-1)
    x, y = point.unbind(-1)
    s = x * x + y * y
    above = 1 + s * (k1 + s * (k2 + s * k3))
    below = 1 + s * (k4 + s * (k5 + s * k6))
    below = torch.where(below == 0, torch.finfo(below.dtype).tiny, below)
    radial = above / below
    slope = (k1 + s * (2 * k2 + s * 3 * k3) - radial * (k4 + s * (2 * k5 + s * 3 * k6))) / below
    distorted = torch.stack(
        (
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y),
        ),
        dim=-1,
    )
    across = 2 * (slope * x * y + p1 * x + p2 * y)
    return distorted, (
        radial + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x,
        across,
        across,
        radial + 2 * slope * y * y + 2 * p2 * x + 6 * p1 * y,
    )


def _within(point: Tensor, limit: Tensor) -> Tensor:
    """Pull points back onto the circle of radius ``limit``, beyond which the lens folds the image
    over.
    """
    radius = torch.linalg.vector_norm(point, dim=-1)
    beyond = radius > limit
    return torch.where(
        beyond[..., None], point * (limit / torch.where(beyond, radius, 1.0))[..., None], point
    )


def _largest_radius(lens: Float[Tensor, "*B 1 8"]) -> Float[Tensor, "*B"]:
    """Up to where the distorted radius grows with the ideal one (normalised coordinates; inf if
    everywhere)."""
    k1, k2, _, _, k3, k4, k5, k6 = torch.where(torch.isfinite(lens), lens, 0.0)[..., 0, :].unbind(
        -1
    )
    one = torch.ones_like(k1)
    above = (one, k1, k2, k3)
    below = (one, k4, k5, k6)
    # numerator of d r_d / d r in powers of s: (N + 2 s N') D - 2 s N D', with N and D the two
    # polynomials
    growth = [torch.zeros_like(k1) for _ in range(7)]
    for i, n in enumerate(above):
        for j, d in enumerate(below):
            growth[i + j] = growth[i + j] + (1 + 2 * i - 2 * j) * n * d
    inverse = torch.maximum(_largest_inverse_root(growth), _largest_inverse_root(list(below)))
    return torch.where(inverse > 0, inverse.clamp(min=1e-300) ** -0.5, torch.inf)


def _largest_inverse_root(polynomial: list[Tensor]) -> Tensor:
    """1 / (smallest positive real root) of polynomials with constant term 1, 0 where there is none.

    The inverse roots are those of the reversed polynomial, which is monic whatever its other
    coefficients are.
    """
    degree = len(polynomial) - 1
    companion = torch.zeros((*polynomial[0].shape, degree, degree), dtype=torch.float64)
    companion[..., 0, :] = -torch.stack(polynomial[1:], dim=-1).cpu()
    companion[..., range(1, degree), range(degree - 1)] = 1
    roots = torch.linalg.eigvals(companion)
    real = (roots.imag.abs() <= 1e-9 * roots.abs()) & (roots.real > 0)
    return torch.where(real, roots.real, 0.0).amax(-1).to(polynomial[0].device)
