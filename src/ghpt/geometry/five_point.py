"""Essential matrices of five correspondences, which is the least that determines them."""

from __future__ import annotations

from itertools import combinations_with_replacement, permutations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.epipolar import correspondence_rows, homogeneous

SAMPLE = 5
"""Correspondences of a minimal sample."""
SOLUTIONS = 10
"""The most essential matrices of one sample, complex ones among them."""

_ONE = 3
"""Place of 1 in (x, y, z, 1)."""
_REAL = 1e-8
"""Imaginary part, relative to the whole, up to which an eigenvalue is real."""
_Monomial = tuple[int, ...]
"""A product of three of (x, y, z, 1), by their places in the order of size."""


def _monomial(*factors: int) -> _Monomial:
    return tuple(sorted(factors))


_ALL: list[_Monomial] = list(combinations_with_replacement(range(4), 3))
_CUBIC = [monomial for monomial in _ALL if _ONE not in monomial]
_LOWER = [monomial for monomial in _ALL if _ONE in monomial]
"""Those of degree 2 and less: a basis of all polynomials modulo the ten equations."""
_PLACE = {monomial: place for place, monomial in enumerate(_CUBIC + _LOWER)}
_OF_TRIPLE = torch.tensor(
    [_PLACE[_monomial(i, j, k)] for i in range(4) for j in range(4) for k in range(4)]
)
"""Place of each product of three, in the order of a tensor [4 4 4]."""
_TIMES_X = torch.tensor([_PLACE[_monomial(0, *monomial[:2])] for monomial in _LOWER])
"""Place of x times each monomial of the basis, the last factor of which is 1."""
_XYZ1 = [_PLACE[_monomial(i, _ONE, _ONE)] - len(_CUBIC) for i in range(4)]
"""Places of x, y, z and 1 in the basis."""


def five_point(
    a: Float[Tensor, "*B 5 2"], b: Float[Tensor, "*B 5 2"]
) -> tuple[Float[Tensor, "*B 10 3 3"], Bool[Tensor, "*B 10"]]:
    """Return up to ten essential matrices of five correspondences each, and which of them exist.

    ``a``, ``b``: normalised image coordinates, finite. The matrices have norm 1 and fulfil b^T E a
    = 0 exactly; those that do not exist are 0. E is x X + y Y + z Z + W, with the four matrices of
    the null space of the epipolar equations (Nister 2004). The ten cubic equations det E = 0 and 2
    E E^T E = tr(E E^T) E leave polynomials of ten monomials, on which the multiplication by x is a
    matrix; its eigenvectors hold the solutions (Stewenius, Engels and Nister 2006).
    """
    lead = a.shape[:-2]
    null_space = _null_space(a.reshape(-1, SAMPLE, 2), b.reshape(-1, SAMPLE, 2))
    equations = _equations(null_space)
    left = equations[..., : len(_CUBIC)]
    cubic, failed = torch.linalg.solve_ex(left, -equations[..., len(_CUBIC) :])
    finite = (failed == 0) & cubic.isfinite().all(-1).all(-1)
    identity = torch.eye(SOLUTIONS, dtype=cubic.dtype, device=cubic.device).expand_as(cubic)
    cubic = torch.where(finite[:, None, None], cubic, 0.0)
    action = torch.cat((cubic, identity), dim=1)[:, _TIMES_X.to(cubic.device)]
    values, vectors = torch.linalg.eig(action)
    one = vectors[:, _XYZ1[_ONE]]
    exists = one.abs() > torch.finfo(cubic.dtype).eps
    solution = vectors[:, _XYZ1] / torch.where(exists, one, 1.0)[:, None]
    E = torch.einsum("sijp,spr->srij", null_space, solution.real)
    norm = torch.linalg.matrix_norm(E)
    real = values.imag.abs() <= _REAL * values.abs().clamp_min(_REAL)
    exists &= real & finite[:, None] & norm.isfinite() & (norm > 0)
    E = torch.where(exists[..., None, None], E / norm[..., None, None], 0.0)
    return E.reshape(*lead, SOLUTIONS, 3, 3), exists.reshape(*lead, SOLUTIONS)


def _null_space(a: Float[Tensor, "S 5 2"], b: Float[Tensor, "S 5 2"]) -> Float[Tensor, "S 3 3 4"]:
    """Return an orthonormal basis of the matrices that fulfil the epipolar equations."""
    rows = correspondence_rows(homogeneous(a.double()), homogeneous(b.double()))
    Q, _ = torch.linalg.qr(rows.mT, mode="complete")
    return Q[..., SAMPLE:].unflatten(-2, (3, 3))


def _equations(basis: Float[Tensor, "S 3 3 4"]) -> Float[Tensor, "S 10 20"]:
    """Return the coefficients of the cubic equations, in the order of ``_PLACE``."""
    square = torch.einsum("sikp,sjkq->sijpq", basis, basis)
    trace = torch.einsum("siipq->spq", square)
    product = torch.einsum("sijpq,sjkr->sikpqr", square, basis)
    traced = torch.einsum("spq,sikr->sikpqr", trace, basis)
    first, second, third = basis.unbind(1)
    signs = _permutation_signs().to(basis)
    determinant = torch.einsum("ijk,sip,sjq,skr->spqr", signs, first, second, third)
    cubic = torch.cat(((2 * product - traced).flatten(1, 2), determinant[:, None]), dim=1)
    coefficients = cubic.new_zeros(*cubic.shape[:2], len(_ALL))
    return coefficients.index_add(2, _OF_TRIPLE.to(cubic.device), cubic.flatten(2))


def _permutation_signs() -> Float[Tensor, "3 3 3"]:
    """Return the sign of each permutation of three; 0 elsewhere."""
    signs = torch.zeros(3, 3, 3, dtype=torch.float64)
    for i, j, k in permutations(range(3)):
        signs[i, j, k] = (j - i) * (k - j) * (k - i) / 2
    return signs
