"""Left and right exchanged in a view: found by what the other views say, and undone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.baselines import Baseline, person_size
from ghpt.recording import KeyPointBatch
from ghpt.skeleton import JOINTS, MIRROR

LIMBS = tuple(
    tuple(j for j, name in enumerate(JOINTS) if name.split("_")[-1] in kinds)
    for kinds in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
)
"""What detectors exchange together: the legs, the arms."""


@dataclass(frozen=True)
class Swaps:
    """How swaps are looked for.

    A view's cost is the sum over joints of ``log(1 + r^2)``, r the reprojection error of the estimate from all views
    in ``scale`` (a fraction of the person's size): the Cauchy loss of the pose. Legs, arms or both are exchanged where
    that lowers the cost by more than ``gain``; ``rounds``: how often, since each swap undone betters the estimate.
    """

    estimator: Baseline
    scale: float
    gain: float
    rounds: int

    def __post_init__(self) -> None:
        for name in ("scale", "gain", "rounds"):
            check(getattr(self, name) > 0, name, f"is {getattr(self, name)}", "It must be > 0.")


@torch.no_grad()
def undo_swaps(batch: KeyPointBatch, swaps: Swaps) -> tuple[KeyPointBatch, Bool[Tensor, "B V"]]:
    """The batch with left and right put right, and in which views of which frames they were not.

    Only in frames with three views or more: of two that disagree neither is the swapped one. In each round the views
    of a frame whose exchange gains most, fewer than half of them, are exchanged.
    """
    exchanged = torch.zeros(*batch.seen.shape[:2], len(LIMBS), dtype=torch.bool, device=batch.seen.device)
    current = batch
    for _ in range(swaps.rounds):
        gain = _gains(current, swaps)
        both = gain.sum(-1, keepdim=True) > swaps.gain
        wanted = (gain > swaps.gain) | (both & (gain > 0))
        views = batch.seen.any(-1).sum(-1)
        total = torch.where(wanted, gain, 0.0).sum(-1)
        order = total.argsort(dim=-1, descending=True).argsort(dim=-1)
        wanted &= (order < ((views - 1) // 2)[:, None])[..., None]
        if not wanted.any():
            break
        exchanged ^= wanted
        current = _exchange(batch, exchanged)
    return current, exchanged.any(-1)


def _exchange(batch: KeyPointBatch, which: Bool[Tensor, "B V G"]) -> KeyPointBatch:
    """The batch with the limbs of the views exchanged."""
    order = torch.arange(len(JOINTS), device=which.device).expand(*which.shape[:2], -1).clone()
    mirror = torch.tensor(MIRROR, device=which.device)
    for group, limbs in enumerate(LIMBS):
        joints = torch.tensor(limbs, device=which.device)
        order[..., joints] = torch.where(which[..., group, None], mirror[joints], order[..., joints])
    points = batch.key_points.gather(2, order[..., None].expand(-1, -1, -1, 2))
    return replace(
        batch, key_points=points, confidence=batch.confidence.gather(2, order), seen=batch.seen.gather(2, order)
    )


def _gains(batch: KeyPointBatch, swaps: Swaps) -> Float[Tensor, "B V G"]:
    """By how much exchanging each group of limbs lowers each view's cost; 0 where it cannot be told."""
    result = swaps.estimator.triangulate(batch)
    placed = swaps.estimator(batch).estimated
    scale = (swaps.scale * person_size(batch.key_points, batch.seen).double()).clamp(min=1e-12)[..., None]
    every = torch.ones(*batch.seen.shape[:2], len(LIMBS), dtype=torch.bool, device=batch.seen.device)
    mirrored = _exchange(batch, every)
    mirror = list(MIRROR)
    known = placed & placed[:, mirror]
    costs = []
    for one in (batch, mirrored):
        error = reprojection_error(one.cameras, one.key_points, result.points) / scale
        counted = one.seen & one.seen[:, :, mirror] & known[:, None]
        costs.append(torch.where(counted, torch.log1p(error.clamp(max=1e6) ** 2), 0.0))
    difference = costs[0] - costs[1]
    return torch.stack([difference[..., list(limbs)].sum(-1) for limbs in LIMBS], dim=-1)
