"""The camera problem (paper, section 3.2): a hypothesis is the relative pose of two cameras from T correspondences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt import randomness
from ghpt.data.pairs import PairSettings
from ghpt.errors import check
from ghpt.geometry.cameras import project
from ghpt.geometry.epipolar import (
    MINIMUM,
    depths,
    eight_point,
    homogeneous,
    normalise,
    pose_in_front,
    ray_distances,
)
from ghpt.geometry.rotations import average_rotation
from ghpt.recording import PairBatch, RelativePoseEstimate


@dataclass(frozen=True)
class RelativePoseHypotheses:
    """H relative poses for each of B pairs, and the correspondences that all of them are judged by."""

    R: Float[Tensor, "B H 3 3"]
    t: Float[Tensor, "B H 3"]
    """mm."""
    estimated: Bool[Tensor, " B"]
    """The pairs whose correspondences determine a pose."""
    a: Float[Tensor, "B N 2"]
    b: Float[Tensor, "B N 2"]
    """Normalised image coordinates in the reference and the target camera."""
    both: Bool[Tensor, "B N"]
    """The joints that both cameras see."""


class RelativePose:
    """Generate, describe, combine and measure relative camera poses.

    ``sample``: T, the correspondences of a hypothesis. ``features``: number of quantiles of the ray distances.
    ``frames``, ``draws``, ``points``: see ``PairSettings``. ``scale``: what gives t its length. ``largest_error``: mm,
    no point counts for more (one almost at infinity would drown the pool).
    """

    measures = "E_3D"

    def __init__(
        self,
        frames: int,
        draws: int,
        points: int,
        sample: int,
        features: int,
        scale: Callable[[RelativePoseEstimate, PairBatch], Tensor],
        largest_error: float,
    ) -> None:
        check(sample >= MINIMUM, "sample", f"is {sample}", f"The 8-point algorithm needs {MINIMUM}.")
        check(features >= 2, "features", f"is {features}", "It must be >= 2.")
        check(largest_error > 0, "largest_error", f"is {largest_error}", "It must be > 0 (mm).")
        self.pairs = PairSettings(frames, draws, points)
        self.sample, self.feature_size, self.scale = sample, features, scale
        self.largest_error = largest_error

    @torch.no_grad()
    def generate(self, batch: PairBatch, count: int, keys: Int[Tensor, " B"]) -> RelativePoseHypotheses:
        """The normalised 8-point algorithm on T random correspondences.

        Where they are degenerate or no pose has most points in front, all correspondences stand in for them.
        """
        a, b, both = batch.correspondences()
        whole_R, whole_t, whole = _solve(a, b, both)
        chosen = _subsets(both, count, self.sample, keys)
        index = chosen[..., None].expand(*chosen.shape, 2)
        used = both[:, None].expand(-1, count, -1).gather(2, chosen)
        some_a, some_b = (x[:, None].expand(-1, count, -1, -1).gather(2, index) for x in (a, b))
        R, t, ok = _solve(some_a, some_b, used)
        R = torch.where(ok[..., None, None], R, whole_R[:, None])
        t = torch.where(ok[..., None], t, whole_t[:, None])
        length = self.scale(RelativePoseEstimate(R, t, ok | whole[:, None]), batch)
        return RelativePoseHypotheses(R, t * length[..., None], whole, a, b, both)

    @torch.no_grad()
    def describe(self, hypotheses: RelativePoseHypotheses) -> Float[Tensor, "B H D"]:
        """The distances (mm) between corresponding rays, sorted: D evenly spaced quantiles of them, so that missing
        joints and another number of frames change nothing but their precision."""
        h = hypotheses
        length = h.t.norm(dim=-1, keepdim=True)
        direction = h.t / torch.where(length > 0, length, 1.0)
        distances = ray_distances(h.R, direction, h.a, h.b) * length
        return quantiles(distances, h.both[:, None].expand_as(distances), self.feature_size).float()

    def combine(self, hypotheses: RelativePoseHypotheses, weights: Float[Tensor, "B H"]) -> RelativePoseEstimate:
        """Weighted average of the rotations' quaternions and of the translations.

        The quaternions are sign-aligned and summed (``average_rotation``). The direction of t is that of the weighted
        sum, its length the weighted mean of the lengths: a sum of unequal directions would be too short.
        """
        weights = weights.double()
        R = average_rotation(hypotheses.R, weights)
        total = torch.einsum("bh,bhc->bc", weights, hypotheses.t)
        length = (weights * hypotheses.t.norm(dim=-1)).sum(-1, keepdim=True)
        norm = total.norm(dim=-1, keepdim=True)
        return RelativePoseEstimate(R, total * length / torch.where(norm > 0, norm, 1.0), hypotheses.estimated)

    def expand(self, hypotheses: RelativePoseHypotheses) -> RelativePoseEstimate:
        estimated = hypotheses.estimated[:, None].expand(hypotheses.t.shape[:-1])
        return RelativePoseEstimate(hypotheses.R, hypotheses.t, estimated)

    def error(
        self, estimate: RelativePoseEstimate, batch: PairBatch
    ) -> tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]:
        """E_3D (eq:reprojection-3d-error), mm: the mean distance of random points from what the estimated pair makes of
        their true images. A point that it cannot see in front of both cameras has ``largest_error``."""
        cameras = batch.pair_cameras()
        pixels, depth = project(cameras, batch.points)
        x = normalise(cameras.K, pixels)
        truth = batch.points @ cameras.R[:, 0].mT + cameras.t[:, 0, None]
        extra = (None,) * (estimate.t.dim() - 2)
        a, b, truth = (v[:, *extra] for v in (x[:, 0], x[:, 1], truth))
        alpha, beta = depths(estimate.R, estimate.t, a, b)
        back = (homogeneous(b) * beta[..., None] - estimate.t[..., None, :]) @ estimate.R
        middle = (homogeneous(a) * alpha[..., None] + back) / 2
        distance = (middle - truth).norm(dim=-1).clamp(max=self.largest_error)
        distance = torch.where((alpha > 0) & (beta > 0), distance, self.largest_error)
        visible = (depth > 0).all(dim=1)
        share = visible / visible.sum(-1, keepdim=True).clamp_min(1)
        error = (distance * share[:, *extra]).sum(-1)
        measured = visible.any(-1)
        return error, measured & (estimate.estimated.flatten(1).all(-1) if extra else estimate.estimated)


def _solve(
    a: Float[Tensor, "*B N 2"], b: Float[Tensor, "*B N 2"], used: Bool[Tensor, "*B N"]
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"], Bool[Tensor, "*B"]]:
    """The pose that has most of the used points in front, of the 8-point algorithm's essential matrix."""
    E, determined = eight_point(a, b, used.double())
    R, t, ok = pose_in_front(E, a, b, used & determined[..., None])
    return R, t, ok & determined


def _subsets(both: Bool[Tensor, "B N"], count: int, size: int, keys: Int[Tensor, " B"]) -> Int[Tensor, "B H T"]:
    """``size`` distinct random correspondences for each hypothesis, usable ones first."""
    size = min(size, both.shape[-1])
    order = randomness.uniform(keys, (count, both.shape[-1]), dtype=torch.float32)
    return torch.where(both[:, None], order, 2.0).topk(size, dim=-1, largest=False, sorted=False).indices


def quantiles(values: Float[Tensor, "*B N"], mask: Bool[Tensor, "*B N"], count: int) -> Float[Tensor, "*B D"]:
    """``count`` evenly spaced quantiles (0 to 1, linear between order statistics) of the values in the mask; else 0."""
    ordered = torch.where(mask, values, torch.inf).sort(dim=-1).values
    number = mask.sum(-1, keepdim=True)
    place = torch.linspace(0, 1, count, dtype=values.dtype, device=values.device) * (number - 1).clamp_min(0)
    low = place.floor().long()
    high = torch.minimum(low + 1, (number - 1).clamp_min(0))
    below, above = ordered.gather(-1, low), ordered.gather(-1, high)
    found = torch.where(high > low, torch.lerp(below, above, place - low), below)
    return torch.where(number > 0, found, 0.0)
