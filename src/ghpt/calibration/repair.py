"""What would make a camera agree with the others: the mistakes that users make, each undone and
tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.observations import Observations, observe
from ghpt.calibration.pairs import PairTable
from ghpt.calibration.resection import Resection, Rig
from ghpt.skeleton import MIRROR

RESOLUTIONS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of the resolutions that cameras and encoders offer."""


@dataclass(frozen=True)
class Repair:
    """A mistake by name, what it is and its mend; ``share`` of the camera's key points agree once
    it is undone.
    """

    code: str
    text: str
    share: float


def find_repair(
    names: tuple[str, ...],
    K: Float[Tensor, "V 3 3"],
    key_points: Float[Tensor, "T V J 2"],
    valid: Bool[Tensor, "T V J"],
    sizes: Int[Tensor, "V 2"] | None,
    noise: float,
    table: PairTable,
    view: int,
    resection: Resection,
    seed: int,
) -> Repair | None:
    """The mistake whose undoing makes the view agree best with the people that the other views
    triangulate, if its squared errors (cut off at the threshold) are then half of what they are as
    it stands and most of its key points agree. Needs two other placed views. ``noise``: share of
    the person's size.
    """
    plain = observe(K, key_points, valid, noise)
    rest = _rest(plain, table, {view}, resection, seed)
    if rest is None:
        return None
    cost = _fit(plain, rest, view, resection, seed)[0]
    best = None
    for code, text, intrinsics, pixels in _undone(names, K, key_points, sizes, view):
        tried = observe(
            intrinsics, pixels, valid[:, :, list(MIRROR)] if code in _LABELS else valid, noise
        )
        new, share = _fit(
            replace(plain, **_of_view(plain, tried, view)), rest, view, resection, seed
        )
        if share >= 0.6 and new < 0.5 * cost:
            best = Repair(code, text, share)
            cost = 2 * new
    return best or _exchange(
        names, K, plain, key_points, valid, noise, table, view, resection, seed
    )


def _rest(
    seen_by: Observations, table: PairTable, without: set[int], resection: Resection, seed: int
) -> Rig | None:
    """The rig of the other views alone, which these cannot have spoilt; None where no two are
    linked.
    """
    kept = torch.tensor([view not in without for view in range(len(seen_by.valid))])
    table = table.among(kept)
    if not table.linked.any():
        return None
    edge = int(torch.where(table.linked, table.expected, torch.inf).argmin())
    return resection.grow(seen_by, table, resection.begin(seen_by, table, edge, seed), seed)


def _exchange(
    names: tuple[str, ...],
    K: Tensor,
    plain: Observations,
    key_points: Tensor,
    valid: Tensor,
    noise: float,
    table: PairTable,
    view: int,
    resection: Resection,
    seed: int,
) -> Repair | None:
    """Two cameras with each other's intrinsics, judged together against the rest: each spoils what
    judges the other.
    """
    for other, whose in enumerate(names):
        both = K[[view, other]]
        intact = bool(torch.isfinite(both).all() & (both.diagonal(dim1=-2, dim2=-1) > 0).all())
        if other == view or not intact or torch.allclose(K[other], K[view], rtol=0.01):
            continue
        exchanged = K.clone()
        exchanged[[view, other]] = K[[other, view]]
        tried = observe(exchanged, key_points, valid, noise)
        people = _rest(plain, table, {view, other}, resection, seed)
        if people is None:
            continue
        before, after = (
            [_fit(x, people, v, resection, seed) for v in (view, other)] for x in (plain, tried)
        )
        share = min(fit[1] for fit in after)
        if share >= 0.6 and sum(fit[0] for fit in after) < 0.75 * sum(fit[0] for fit in before):
            text = f"key points of {names[view]} fit the intrinsics of {whose}, and the reverse; exchange the two names"
            return Repair("names_swapped", text, share)
    return None


_LABELS = ("sides_swapped", "mirrored_image")
"""Those that exchange left and right joints."""


def _of_view(plain: Observations, tried: Observations, view: int) -> dict[str, Tensor]:
    changed = {}
    for field in ("xy", "noise", "valid"):
        values = getattr(plain, field).clone()
        values[view] = getattr(tried, field)[view]
        changed[field] = values
    return changed


def _fit(
    seen_by: Observations, rest: Rig, view: int, resection: Resection, seed: int
) -> tuple[float, float]:
    """Mean squared error, cut off at the threshold (1), and share of inliers of the view's known
    key points.
    """
    found = resection.place(seen_by, rest, view, seed)
    known = seen_by.valid[view] & rest.inlier.any(0)
    if found is None or not known.any():
        return 1.0, 0.0
    R = rest.R.clone()
    t = rest.t.clone()
    R[view], t[view] = found
    error = seen_by.error(R, t, rest.points)[view][known] / resection.threshold
    return float(error.square().clamp(max=1).mean()), float((error <= 1).double().mean())


def _undone(
    names: tuple[str, ...], K: Tensor, key_points: Tensor, sizes: Tensor | None, view: int
) -> Iterator[tuple[str, str, Tensor, Tensor]]:
    name = names[view]
    mirror = list(MIRROR)
    width = float(sizes[view, 0] if sizes is not None else 2 * K[view, 0, 2] + 1)
    flipped = key_points.clone()
    flipped[..., 0] = width - 1 - flipped[..., 0]
    yield (
        "sides_swapped",
        f"left and right joints of {name} are exchanged; exchange them back",
        K,
        key_points[:, :, mirror],
    )
    mended = "; turn its mirroring off, or give u as width - 1 - u"
    yield (
        "mirrored_key_points",
        f"key points of {name} are those of a mirrored image{mended}",
        K,
        flipped,
    )
    yield (
        "mirrored_image",
        f"the image of {name} is mirrored{mended} with left and right joints exchanged",
        K,
        flipped[:, :, mirror],
    )
    for ratio in RESOLUTIONS:
        scaled = K.clone()
        scaled[view, :2] *= ratio
        text = f"intrinsics of {name} fit its key points when scaled by {ratio:.3g}; give both at one resolution"
        yield "resolution", text, scaled, key_points
