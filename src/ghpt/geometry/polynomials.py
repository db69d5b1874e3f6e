"""Roots of polynomials, batched."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def largest_inverse_root(polynomial: Sequence[Tensor]) -> Float[Tensor, "*B"]:
    """Return 1 / (smallest positive real root) of polynomials with constant term 1.

    ``polynomial``: coefficients [*B], of rising powers. It is 0 where there is none. The inverse
    roots are those of the reversed polynomial, which is monic whatever its other coefficients are.
    """
    first, *others = polynomial
    degree = len(others)
    shape = (*first.shape, degree, degree)
    companion = torch.zeros(shape, dtype=torch.float64)
    companion[..., 0, :] = -torch.stack(others, dim=-1).cpu()
    companion[..., range(1, degree), range(degree - 1)] = 1
    roots = torch.linalg.eigvals(companion)
    real = roots.imag.abs() <= 1e-9 * roots.abs()
    positive = real & (roots.real > 0)
    largest = torch.where(positive, roots.real, 0.0).amax(-1)
    return largest.to(first.device)
