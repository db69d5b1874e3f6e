"""Left and right exchanged in a view: found by what the other views say, and undone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.estimators.classical import Estimator, person_scale
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import JOINTS, MIRROR

_LIMB_PARTS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
LIMBS = tuple(
    tuple(joint for joint, name in enumerate(JOINTS) if name.split("_")[-1] in parts)
    for parts in _LIMB_PARTS
)
"""The joints that detectors flip together: those of the legs, those of the arms."""


_HYPOTHESES = ((True, True), (True, False), (False, True))
"""What may be flipped in a view: (legs, arms)."""


@dataclass(frozen=True)
class LeftRightFlips:
    """How left-right flips are looked for.

    A pose's cost is the sum over views and limb joints of ``log(1 + r^2)``, r the reprojection
    error in ``scale`` (a fraction of the person's scale) of the pose that ``estimator`` gives: its
    Cauchy loss. Legs, arms or both are flipped in a view where estimating the pose anew lowers its
    cost by more than ``gain``. In each of ``rounds`` one view of a frame, out of the ``views`` that
    fit worst.
    """

    estimator: Estimator
    scale: float
    gain: float
    rounds: int
    views: int

    def __post_init__(self) -> None:
        for name in ("scale", "gain", "rounds", "views"):
            value = getattr(self, name)
            check(value > 0, name, f"is {value}", "It must be > 0.")


@torch.no_grad()
def undo_flips(
    batch: Observations, flips: LeftRightFlips, estimate: PoseEstimate | None = None
) -> tuple[Observations, Bool[Tensor, "B V"]]:
    """Undo left-right flips. Returns the corrected batch and the mask of flipped views.

    Only in frames with three views or more, and in fewer than half of these: of views that stand
    two against two neither side is the flipped one. ``estimate``: what ``flips.estimator`` makes of
    the batch, if that is known; frames in which no view fits it badly cost nothing more.
    """
    frames, views = batch.valid.shape[:2]
    device = batch.valid.device
    flipped = torch.zeros(frames, views, len(LIMBS), dtype=torch.bool, device=device)
    seen_views = batch.valid.any(-1).sum(-1)
    most = (seen_views - 1) // 2
    if not len(batch) or int(most.max()) < 1:
        return batch, flipped.any(-1)
    estimate = estimate or flips.estimator(batch)
    cost = _view_costs(batch, estimate, flips.scale)
    # a view that is right in a pose that is nearly right is far from its mirror image
    mirrored = _view_costs(_flip(batch, ~flipped), estimate, flips.scale)
    fits_badly = cost > flips.gain / 2
    may_be_flipped = mirrored < cost + flips.gain
    doubtful = (fits_badly & may_be_flipped).any(-1)
    rows = torch.nonzero(doubtful & (most > 0))[:, 0]
    for _ in range(flips.rounds):
        if not len(rows):
            break
        candidates = _candidates(flipped[rows], cost[rows], min(flips.views, views))
        costs = _candidate_costs(batch.rows(rows), candidates, flips)
        flipped_views = candidates.any(-1).sum(-1)
        allowed = flipped_views <= most[rows, None]
        total = torch.where(allowed, costs.sum(-1), torch.inf)
        best = total.argmin(-1)
        row = torch.arange(len(best), device=device)
        best_cost = costs[row, best]
        gain = cost[rows].sum(-1) - best_cost.sum(-1)
        better = allowed[row, best] & (gain > flips.gain)
        rows = rows[better]
        flipped[rows] = candidates[row, best][better]
        cost[rows] = best_cost[better]
    return _flip(batch, flipped), flipped.any(-1)


def _candidates(
    flipped: Bool[Tensor, "S V G"], costs: Float[Tensor, "S V"], views: int
) -> Bool[Tensor, "S H V G"]:
    """Return the flips with one more of the worst views flipped, in every way that it can be."""
    worst = costs.topk(views, dim=-1).indices
    kinds = torch.tensor(_HYPOTHESES, device=costs.device)
    view = torch.nn.functional.one_hot(worst, costs.shape[1])
    change = view.bool()[:, :, None, :, None] & kinds[:, None]
    change = change.flatten(1, 2)
    return flipped[:, None] ^ change


def _candidate_costs(
    batch: Observations, candidates: Bool[Tensor, "S H V G"], flips: LeftRightFlips
) -> Float[Tensor, "S H V"]:
    """Return each view's cost of the poses that are estimated anew with the candidates undone."""
    frames, count = candidates.shape[:2]
    frame = torch.arange(frames, device=candidates.device)
    repeated = batch.rows(frame.repeat_interleave(count))
    hypotheses = _flip(repeated, candidates.flatten(0, 1))
    costs = _view_costs(hypotheses, flips.estimator(hypotheses), flips.scale)
    return costs.unflatten(0, (-1, count))


def _flip(batch: Observations, flipped: Bool[Tensor, "B V G"]) -> Observations:
    """Return the batch with left and right of these limbs exchanged."""
    device = flipped.device
    joints = torch.arange(len(JOINTS), device=device)
    order = joints.expand(*flipped.shape[:2], -1).clone()
    mirror = torch.tensor(MIRROR, device=device)
    for group, limb_joints in enumerate(LIMBS):
        limbs = torch.tensor(limb_joints, device=device)
        mask = flipped[..., group, None]
        order[..., limbs] = torch.where(mask, mirror[limbs], order[..., limbs])
    coordinates = order[..., None].expand(-1, -1, -1, 2)
    return replace(
        batch,
        key_points=batch.key_points.gather(2, coordinates),
        confidence=batch.confidence.gather(2, order),
        valid=batch.valid.gather(2, order),
    )


def _view_costs(batch: Observations, estimate: PoseEstimate, scale: float) -> Float[Tensor, "B V"]:
    """Return each view's share of its frame's cost.

    It is that of the joints that the view sees and the frame estimates, with their mirrors.
    """
    size = scale * person_scale(batch.key_points, batch.valid).double()
    size = size.clamp(min=1e-12)[..., None]
    error = reprojection_error(batch.cameras, batch.key_points, estimate.points) / size
    mirror = list(MIRROR)
    estimated = estimate.estimated & estimate.estimated[:, mirror]
    valid = batch.valid & batch.valid[:, :, mirror]
    square = error.clamp(max=1e6) ** 2
    measured = valid & estimated[:, None]
    loss = torch.where(measured, torch.log1p(square), 0.0)
    limbs = [joint for group in LIMBS for joint in group]
    return loss[..., limbs].sum(-1)
