"""Blocks on the diagonal of the inverse of a block tridiagonal matrix, by cyclic reduction."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def tridiagonal_inverse(
    diagonal: Float[Tensor, "N *B n n"], upper: Float[Tensor, "M *B n n"]
) -> tuple[Float[Tensor, "N *B n n"], Float[Tensor, "M *B n n"]]:
    """Return the blocks of the inverse that lie where the matrix has blocks.

    The matrix is symmetric and positive definite; ``upper``: its M = N - 1 blocks (i, i + 1).

    Every second block is eliminated, all at once: what is left of the others is tridiagonal again,
    and its inverse is theirs (Schur complement). With x = A_oo^-1 A_oe of an eliminated block o and
    its neighbours e, the blocks of o are C_oe = -x C_ee and C_oo = A_oo^-1 - C_oe x^T.
    """
    count = len(diagonal)
    if count == 1:
        return torch.linalg.inv(diagonal), upper
    odd = count // 2
    alone = torch.linalg.inv(diagonal[1::2])
    before = upper[0::2]
    after = upper[1::2]
    both = len(after)  # eliminated blocks with a neighbour on either side
    to_before = alone @ before.mT
    to_after = alone[:both] @ after
    kept = diagonal[0::2].clone()
    kept[:odd] -= before @ to_before
    kept[1:] -= after.mT @ to_after
    inverse, beside = tridiagonal_inverse(kept, -(before[:both] @ to_after))
    with_before = -(to_before @ inverse[:odd])
    with_before[:both] -= to_after @ beside.mT
    with_after = -(to_before[:both] @ beside + to_after @ inverse[1:])
    eliminated = alone - with_before @ to_before.mT
    eliminated[:both] -= with_after @ to_after.mT
    return _interleave(inverse, eliminated), _interleave(with_before.mT, with_after)


def _interleave(
    first: Float[Tensor, "K *B n n"], second: Float[Tensor, "L *B n n"]
) -> Float[Tensor, "N *B n n"]:
    both = first.new_empty(len(first) + len(second), *first.shape[1:])
    both[0::2] = first
    both[1::2] = second
    return both
