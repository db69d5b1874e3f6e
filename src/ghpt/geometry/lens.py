"""Lens distortion, undone where the key points enter: OpenCV's Brown-Conrady and fisheye models.

Coefficients are k1 k2 p1 p2 [k3 [k4 k5 k6]]: in normalised image coordinates with s = x^2 + y^2,
``x_d = x (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) + 2 p1 x y + p2 (s + 2 x^2)``
and y likewise. A ninth number says which model they are of: 0 for this one, 1 for the fisheye
(``ghpt.geometry.fisheye``), whose k1 k2 k3 k4 are then the first four. So the lenses of a rig of
both kinds are one tensor [V 9].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vector_norm

from ghpt.geometry.fisheye import distort_fisheye, undistort_fisheye
from ghpt.geometry.masking import finite_vectors, where
from ghpt.geometry.polynomials import largest_inverse_root

COEFFICIENTS = 9
"""Numbers that hold a lens of either model."""
_STEPS = 100
_CONVERGED = 1e-12
"""In normalised coordinates, so 1e-9 pixels or less."""
_INSIDE = 1 - 1e-9
"""Share of the largest radius: on the limit itself the Jacobian is singular or the model has its
pole.
"""


def fisheye_lens(k: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 9"]:
    """Return the coefficients of a fisheye lens (k1 k2 k3 k4)."""
    lens = pad_lens(k)
    lens[..., -1] = 1.0
    return lens


def is_fisheye(coefficients: Float[Tensor, "*B C"]) -> Bool[Tensor, "*B"]:
    """Return which lenses are fisheyes."""
    return pad_lens(coefficients)[..., -1] != 0


def pad_lens(coefficients: Float[Tensor, "*B C"]) -> Float[Tensor, "*B 9"]:
    """Return all nine numbers of lenses, float64; those that are not given are 0.

    Raises ValueError unless C is 4, 5, 8 or 9.
    """
    count = coefficients.shape[-1]
    if count not in (4, 5, 8, COEFFICIENTS):
        raise ValueError(f"a lens has 4, 5, 8 or 9 coefficients here, not {count}")
    return torch.nn.functional.pad(coefficients.double(), (0, COEFFICIENTS - count))


def distort(
    pixels: Float[Tensor, "*B N 2"],
    K: Float[Tensor, "*B 3 3"],
    coefficients: Float[Tensor, "*B C"],
) -> Float[Tensor, "*B N 2"]:
    """Return where the lens shows the points whose ideal pinhole pixels are given, float64.

    C is 4, 5, 8 or 9.
    """
    ideal = _normalise(pixels, K)
    fisheye, lens, brown = _models(coefficients)
    distorted, _ = _apply_lens(ideal, brown)
    if fisheye.any():
        seen = distort_fisheye(ideal, lens[..., :4])
        distorted = torch.where(fisheye[..., None, None], seen, distorted)
    return _to_pixels(distorted, K)


def undistort(
    pixels: Float[Tensor, "*B N 2"],
    K: Float[Tensor, "*B 3 3"],
    coefficients: Float[Tensor, "*B C"],
) -> tuple[Float[Tensor, "*B N 2"], Bool[Tensor, "*B N"]]:
    """Return the ideal pinhole pixels of pixels seen through the lens, and whether they exist.

    Ideal pixels have the same K and are float64. A pixel that no ray of the lens's invertible
    region reaches (or that is not finite) has no such point: its mask is False and the pixel comes
    back as it was (0 if not finite). C is 4, 5, 8 or 9.
    """
    finite = finite_vectors(pixels)
    safe = where(finite, pixels.double(), 0.0)
    target = _normalise(safe, K)
    fisheye, lens, brown = _models(coefficients)
    point, exists = _undistort_brown(target, brown)
    if fisheye.any():
        ideal, shown = undistort_fisheye(target, lens[..., :4])
        point = torch.where(fisheye[..., None, None], ideal, point)
        exists = torch.where(fisheye[..., None], shown, exists)
    exists = finite & exists
    return where(exists, _to_pixels(point, K), safe), exists


def _models(
    coefficients: Float[Tensor, "*B C"],
) -> tuple[Bool[Tensor, "*B"], Float[Tensor, "*B 1 9"], Float[Tensor, "*B 1 8"]]:
    """Return which lenses are fisheyes, all their numbers, and those of the Brown-Conrady model,
    which are 0 for a fisheye.
    """
    lens = pad_lens(coefficients)
    fisheye = lens[..., -1] != 0
    brown = torch.where(fisheye[..., None], 0.0, lens[..., :-1])
    return fisheye, lens.unsqueeze(-2), brown.unsqueeze(-2)


def _undistort_brown(
    target: Float[Tensor, "*B N 2"], lens: Float[Tensor, "*B 1 8"]
) -> tuple[Float[Tensor, "*B N 2"], Bool[Tensor, "*B N"]]:
    limit = _largest_radius(lens)[..., None] * _INSIDE
    point, converged = _invert_lens(target, lens, limit)
    _, jacobian = _apply_lens(point, lens)
    radius = vector_norm(point, dim=-1)
    invertible = (jacobian.determinant > 0) & (radius <= limit)
    return point, converged & invertible


def _invert_lens(
    target: Float[Tensor, "*B N 2"],
    lens: Float[Tensor, "*B 1 8"],
    limit: Float[Tensor, "*B 1"],
) -> tuple[Float[Tensor, "*B N 2"], Bool[Tensor, "*B N"]]:
    """Return the points that the lens takes to ``target``, and which of them have converged.

    Newton's steps are kept within the radius ``limit``.
    """
    largest = target.abs().amax(-1)
    tolerance = _CONVERGED * (1 + largest)
    point = _clamp_radius(target, limit)
    converged = torch.zeros_like(largest, dtype=torch.bool)
    for _ in range(_STEPS):
        distorted, jacobian = _apply_lens(point, lens)
        error = distorted - target
        converged = converged | (error.abs().amax(-1) <= tolerance)
        if converged.all():
            break
        step = jacobian.solve(error)
        # those that are done stay: the digits of a point must not depend on the points beside it
        point = where(converged, point, _clamp_radius(point - step, limit))
    return point, converged


def _normalise(
    pixels: Float[Tensor, "*B N 2"],
    K: Float[Tensor, "*B 3 3"],
) -> Float[Tensor, "*B N 2"]:
    K = K.double()[..., None, :, :]
    x, y = (pixels.double() - K[..., :2, 2]).unbind(-1)
    y = y / K[..., 1, 1]
    x = (x - K[..., 0, 1] * y) / K[..., 0, 0]
    return torch.stack((x, y), dim=-1)


def _to_pixels(
    point: Float[Tensor, "*B N 2"],
    K: Float[Tensor, "*B 3 3"],
) -> Float[Tensor, "*B N 2"]:
    K = K.double()
    principal_point = K[..., None, :2, 2]
    return point @ K[..., :2, :2].mT + principal_point


@dataclass(frozen=True)
class _Jacobian:
    """The derivative of distorted by ideal points; it is symmetric."""

    xx: Float[Tensor, "*B N"]
    xy: Float[Tensor, "*B N"]
    yy: Float[Tensor, "*B N"]

    @property
    def determinant(self) -> Float[Tensor, "*B N"]:
        return self.xx * self.yy - self.xy * self.xy

    def solve(self, error: Float[Tensor, "*B N 2"]) -> Float[Tensor, "*B N 2"]:
        """Return the step whose distorted length is ``error``; where singular it has no meaning."""
        u, v = error.unbind(-1)
        du = self.yy * u - self.xy * v
        dv = self.xx * v - self.xy * u
        adjugate = torch.stack((du, dv), dim=-1)
        determinant = self.determinant
        safe = torch.where(determinant == 0, 1.0, determinant)
        return adjugate / safe[..., None]


def _apply_lens(
    point: Float[Tensor, "*B N 2"],
    lens: Float[Tensor, "*B 1 8"],
) -> tuple[Float[Tensor, "*B N 2"], _Jacobian]:
    """Return the distorted points and the Jacobian."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.unbind(-1)
    x, y = point.unbind(-1)
    s = x * x + y * y
    numerator = 1 + s * (k1 + s * (k2 + s * k3))
    denominator = 1 + s * (k4 + s * (k5 + s * k6))
    tiny = torch.finfo(denominator.dtype).tiny
    denominator = torch.where(denominator == 0, tiny, denominator)
    radial = numerator / denominator
    numerator_slope = k1 + s * (2 * k2 + s * 3 * k3)
    denominator_slope = k4 + s * (2 * k5 + s * 3 * k6)
    slope = (numerator_slope - radial * denominator_slope) / denominator
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    distorted_y = y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y)
    jacobian = _Jacobian(
        xx=radial + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x,
        xy=2 * (slope * x * y + p1 * x + p2 * y),
        yy=radial + 2 * slope * y * y + 2 * p2 * x + 6 * p1 * y,
    )
    return torch.stack((distorted_x, distorted_y), dim=-1), jacobian


def _clamp_radius(
    point: Float[Tensor, "*B N 2"],
    limit: Float[Tensor, "*B 1"],
) -> Float[Tensor, "*B N 2"]:
    """Pull points back onto the circle of radius ``limit``, where the lens folds the image over."""
    radius = vector_norm(point, dim=-1)
    beyond = radius > limit
    safe = torch.where(beyond, radius, 1.0)
    scale = (limit / safe)[..., None]
    return where(beyond, point * scale, point)


def _largest_radius(lens: Float[Tensor, "*B 1 8"]) -> Float[Tensor, "*B"]:
    """Return the radius up to which the distorted radius grows with the ideal one.

    It is in normalised coordinates, and inf if it grows everywhere.
    """
    finite = torch.where(torch.isfinite(lens), lens, 0.0)
    k1, k2, _, _, k3, k4, k5, k6 = finite[..., 0, :].unbind(-1)
    one = torch.ones_like(k1)
    numerator = [one, k1, k2, k3]
    denominator = [one, k4, k5, k6]
    growth = _growth(numerator, denominator)
    growth_root = largest_inverse_root(growth)
    pole = largest_inverse_root(denominator)
    inverse_square = torch.maximum(growth_root, pole)
    radius = inverse_square.clamp(min=1e-300) ** -0.5
    return torch.where(inverse_square > 0, radius, torch.inf)


def _growth(numerator: list[Tensor], denominator: list[Tensor]) -> list[Tensor]:
    """Return the numerator of d r_d / d r in powers of s.

    It is (N + 2 s N') D - 2 s N D', with N and D the two polynomials.
    """
    growth = [torch.zeros_like(numerator[0]) for _ in range(7)]
    for i, n in enumerate(numerator):
        for j, d in enumerate(denominator):
            factor = 1 + 2 * i - 2 * j
            growth[i + j] = growth[i + j] + factor * n * d
    return growth
