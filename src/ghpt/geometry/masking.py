"""Masks of whole vectors and matrices, and the product of a matrix with a vector."""

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor


def where(
    mask: Bool[Tensor, "*B"],
    value: Tensor,
    fallback: Tensor | float,
) -> Shaped[Tensor, "..."]:
    """Return ``value`` where ``mask`` holds and ``fallback`` elsewhere.

    ``mask`` has the first dimensions of ``value``: each of its elements decides on a whole vector
    or matrix.
    """
    for _ in range(value.ndim - mask.ndim):
        mask = mask.unsqueeze(-1)
    return torch.where(mask, value, fallback)


def finite_vectors(x: Tensor) -> Bool[Tensor, "..."]:
    """Return whether all elements of each vector (the last dimension) are finite."""
    return torch.isfinite(x).all(-1)


def finite_matrices(x: Tensor) -> Bool[Tensor, "..."]:
    """Return whether all elements of each matrix (the last two dimensions) are finite."""
    return torch.isfinite(x).all(-1).all(-1)


def identity_like(x: Tensor) -> Tensor:
    """Return the identity matrix of the last dimension, data type and device of ``x``."""
    return torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the product of matrices ``[..., M, N]`` with vectors ``[..., N]``: ``[..., M]``."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
