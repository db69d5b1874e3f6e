"""Left and right exchanged in a view: found by what the other views say, and undone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.estimators.classical import Estimator, person_scale
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, Skeleton

_LIMB_PARTS = (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
"""The joints that detectors flip together: those of the legs, those of the arms."""
_FOOT_AND_HAND = (
    ("heel", "toe"),
    ("hand", "thumb", "finger", "forefinger", "index", "pinky"),
)
"""Words in the names of what is flipped with them, and says nothing of whether they are."""
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
    skeleton: Skeleton = HUMAN36M
    """Of the batches."""

    def __post_init__(self) -> None:
        for name in ("scale", "gain", "rounds", "views"):
            value = getattr(self, name)
            check(value > 0, name, f"is {value}", "It must be > 0.")

    def for_skeleton(self, skeleton: Skeleton) -> LeftRightFlips:
        """Return the same for batches of another skeleton; it has no limbs but a person's."""
        return replace(self, skeleton=skeleton)

    @cached_property
    def limbs(self) -> tuple[tuple[int, ...], ...]:
        """The joints of the legs and of the arms, without feet and hands."""
        return tuple(self._key_points_of_side(words) for words in _LIMB_PARTS)

    @cached_property
    def flipped_together(self) -> tuple[tuple[int, ...], ...]:
        """What is exchanged with the legs and with the arms: all of their key points."""
        ends = [self._key_points_of_side(words) for words in _FOOT_AND_HAND]
        return tuple((*limb, *end) for limb, end in zip(self.limbs, ends, strict=True))

    def _key_points_of_side(self, words: tuple[str, ...]) -> tuple[int, ...]:
        """Return the key points of a side with one of these words in their name."""
        names = self.skeleton.key_points
        sided = sorted(joint for pair in self.skeleton.pairs for joint in pair)
        return tuple(joint for joint in sided if _has_word(names[joint], words))


def _has_word(name: str, words: tuple[str, ...]) -> bool:
    found = {word.rstrip("0123456789") for word in name.split("_")}
    return not found.isdisjoint(words)


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
    flipped = torch.zeros(frames, views, len(_LIMB_PARTS), dtype=torch.bool, device=device)
    seen_views = batch.valid.any(-1).sum(-1)
    most = (seen_views - 1) // 2
    if not len(batch) or int(most.max()) < 1:
        return batch, flipped.any(-1)
    estimate = estimate or flips.estimator(batch)
    cost = _view_costs(batch, estimate, flips)
    # a view that is right in a pose that is nearly right is far from its mirror image
    mirrored = _view_costs(_flip(batch, ~flipped, flips), estimate, flips)
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
    return _flip(batch, flipped, flips), flipped.any(-1)


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
    hypotheses = _flip(repeated, candidates.flatten(0, 1), flips)
    costs = _view_costs(hypotheses, flips.estimator(hypotheses), flips)
    return costs.unflatten(0, (-1, count))


def _flip(
    batch: Observations, flipped: Bool[Tensor, "B V G"], flips: LeftRightFlips
) -> Observations:
    """Return the batch with left and right of these limbs exchanged."""
    device = flipped.device
    joints = torch.arange(len(flips.skeleton), device=device)
    order = joints.expand(*flipped.shape[:2], -1).clone()
    mirror = torch.tensor(flips.skeleton.mirror, device=device)
    for group, limb_joints in enumerate(flips.flipped_together):
        limbs = torch.tensor(limb_joints, dtype=torch.long, device=device)
        mask = flipped[..., group, None]
        order[..., limbs] = torch.where(mask, mirror[limbs], order[..., limbs])
    coordinates = order[..., None].expand(-1, -1, -1, 2)
    return replace(
        batch,
        key_points=batch.key_points.gather(2, coordinates),
        confidence=batch.confidence.gather(2, order),
        valid=batch.valid.gather(2, order),
    )


def _view_costs(
    batch: Observations, estimate: PoseEstimate, flips: LeftRightFlips
) -> Float[Tensor, "B V"]:
    """Return each view's share of its frame's cost.

    It is that of the joints that the view sees and the frame estimates, with their mirrors.
    """
    size = flips.scale * person_scale(batch.key_points, batch.valid).double()
    size = size.clamp(min=1e-12)[..., None]
    error = reprojection_error(batch.cameras, batch.key_points, estimate.points) / size
    mirror = list(flips.skeleton.mirror)
    estimated = estimate.estimated & estimate.estimated[:, mirror]
    valid = batch.valid & batch.valid[:, :, mirror]
    square = error.clamp(max=1e6) ** 2
    measured = valid & estimated[:, None]
    loss = torch.where(measured, torch.log1p(square), 0.0)
    limbs = [joint for limb in flips.limbs for joint in limb]
    return loss[..., limbs].sum(-1)
