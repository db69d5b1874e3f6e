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

LIMBS = tuple(
    tuple(j for j, name in enumerate(JOINTS) if name.split("_")[-1] in kinds)
    for kinds in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
)
"""What detectors exchange together: the legs, the arms."""


_HYPOTHESES = ((True, True), (True, False), (False, True))
"""What may be exchanged in a view."""


@dataclass(frozen=True)
class LeftRightFlips:
    """How swaps are looked for.

    A pose's cost is the sum over views and limb joints of ``log(1 + r^2)``, r the reprojection
    error in ``scale`` (a fraction of the person's size) of the pose that ``estimator`` gives: its
    Cauchy loss. Legs, arms or both are exchanged in a view where estimating the pose anew lowers
    its cost by more than ``gain``. In each of ``rounds`` one view of a frame, out of the ``views``
    that fit worst.
    """

    estimator: Estimator
    scale: float
    gain: float
    rounds: int
    views: int

    def __post_init__(self) -> None:
        for name in ("scale", "gain", "rounds", "views"):
            check(getattr(self, name) > 0, name, f"is {getattr(self, name)}", "It must be > 0.")


@torch.no_grad()
def undo_flips(
    batch: Observations, flips: LeftRightFlips, estimate: PoseEstimate | None = None
) -> tuple[Observations, Bool[Tensor, "B V"]]:
    """The batch with left and right put right, and in which views of which frames they were not.

    Only in frames with three views or more, and in fewer than half of these: of views that stand
    two against two neither side is the swapped one. ``estimate``: what ``flips.estimator`` makes of
    the batch, if that is known; frames in which no view fits it badly cost nothing more.
    """
    exchanged = torch.zeros(
        *batch.valid.shape[:2], len(LIMBS), dtype=torch.bool, device=batch.valid.device
    )
    most = (batch.valid.any(-1).sum(-1) - 1) // 2
    if not len(batch) or int(most.max()) < 1:
        return batch, exchanged.any(-1)
    estimate = estimate or flips.estimator(batch)
    before = _costs(batch, estimate, flips.scale)
    # a view that is right in a pose that is nearly right is far from its mirror image
    mirrored = _costs(_exchange(batch, ~exchanged), estimate, flips.scale)
    doubtful = ((before > flips.gain / 2) & (mirrored < before + flips.gain)).any(-1)
    doubtful = torch.nonzero(doubtful & (most > 0))[:, 0]
    for _ in range(flips.rounds):
        if not len(doubtful):
            break
        own = exchanged[doubtful]
        candidates = _candidates(own, before[doubtful], min(flips.views, batch.valid.shape[1]))
        count = candidates.shape[1]
        hypotheses = _exchange(
            batch.rows(doubtful.repeat_interleave(count)), candidates.flatten(0, 1)
        )
        costs = _costs(hypotheses, flips.estimator(hypotheses), flips.scale).unflatten(
            0, (-1, count)
        )
        allowed = candidates.any(-1).sum(-1) <= most[doubtful, None]
        best = torch.where(allowed, costs.sum(-1), torch.inf).argmin(-1)
        row = torch.arange(len(best), device=best.device)
        better = allowed[row, best] & (
            before[doubtful].sum(-1) - costs[row, best].sum(-1) > flips.gain
        )
        changed = doubtful[better]
        exchanged[changed] = candidates[row, best][better]
        before[changed] = costs[row, best][better]
        doubtful = changed
    return _exchange(batch, exchanged), exchanged.any(-1)


def _candidates(
    exchanged: Bool[Tensor, "S V G"], costs: Float[Tensor, "S V"], views: int
) -> Bool[Tensor, "S H V G"]:
    """What is exchanged if one more of the worst views is."""
    worst = costs.topk(views, dim=-1).indices
    kinds = torch.tensor(_HYPOTHESES, device=costs.device)
    one = (
        torch.nn.functional.one_hot(worst, costs.shape[1]).bool()[:, :, None, :, None]
        & kinds[:, None]
    )
    return exchanged[:, None] ^ one.flatten(1, 2)


def _exchange(batch: Observations, which: Bool[Tensor, "B V G"]) -> Observations:
    """The batch with the limbs of the views exchanged."""
    order = torch.arange(len(JOINTS), device=which.device).expand(*which.shape[:2], -1).clone()
    mirror = torch.tensor(MIRROR, device=which.device)
    for group, limbs in enumerate(LIMBS):
        joints = torch.tensor(limbs, device=which.device)
        order[..., joints] = torch.where(
            which[..., group, None], mirror[joints], order[..., joints]
        )
    points = batch.key_points.gather(2, order[..., None].expand(-1, -1, -1, 2))
    return replace(
        batch,
        key_points=points,
        confidence=batch.confidence.gather(2, order),
        valid=batch.valid.gather(2, order),
    )


def _costs(batch: Observations, estimate: PoseEstimate, scale: float) -> Float[Tensor, "B V"]:
    """Each view's share of its frame's cost: of the joints that it sees and the frame places, with
    their mirrors.
    """
    size = (scale * person_scale(batch.key_points, batch.valid).double()).clamp(min=1e-12)[
        ..., None
    ]
    error = reprojection_error(batch.cameras, batch.key_points, estimate.points) / size
    mirror = list(MIRROR)
    known = estimate.estimated & estimate.estimated[:, mirror]
    counted = batch.valid & batch.valid[:, :, mirror] & known[:, None]
    limbs = [joint for group in LIMBS for joint in group]
    return torch.where(counted, torch.log1p(error.clamp(max=1e6) ** 2), 0.0)[..., limbs].sum(-1)
