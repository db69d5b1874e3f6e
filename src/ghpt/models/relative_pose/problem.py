"""The camera problem (paper, section 3.2): a hypothesis is the relative pose of two cameras from T
correspondences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt import randomness
from ghpt.data.datasets.pairs import PairSettings
from ghpt.errors import check
from ghpt.geometry.cameras import project
from ghpt.geometry.epipolar import (
    MINIMUM,
    depths,
    eight_point_subsets,
    homogeneous,
    normalise,
    poses_in_front,
    ray_distances,
    robust_weights,
)
from ghpt.geometry.rotations import average_rotation
from ghpt.models.problem import Hypotheses
from ghpt.observations import PairObservations, PairTruth, RelativePoseEstimate

CHEIRALITY = 256
"""Correspondences, evenly over all, that tell which of four poses has them in front: more would
only repeat it.
"""


@dataclass(frozen=True)
class RelativePoseHypotheses(Hypotheses):
    """H relative poses for each of B pairs, and the correspondences that all are judged by."""

    shared = ("estimated", "a", "b", "both")

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

    ``frames``, ``draws``, ``points``: see ``PairSettings``. ``sample``: T, the correspondences of a
    hypothesis; at most half of those that both cameras see, but 8 at least. ``refine``: how often
    all correspondences, weighted by how well the hypothesis explains them, are solved again (0: the
    paper). ``features``: number of quantiles of the ray distances. ``scale``: what gives t its
    length. ``largest_error``: mm, no point counts for more (one almost at infinity would drown the
    pool).
    """

    measures = "E_3D"

    def __init__(
        self,
        frames: int,
        draws: int,
        points: int,
        sample: int,
        refine: int,
        features: int,
        scale: Callable[[RelativePoseEstimate, PairObservations], Tensor],
        largest_error: float,
    ) -> None:
        check(
            sample >= MINIMUM, "sample", f"is {sample}", f"The 8-point algorithm needs {MINIMUM}."
        )
        check(refine >= 0, "refine", f"is {refine}", "It must be >= 0 (0: the paper).")
        check(features >= 2, "features", f"is {features}", "It must be >= 2.")
        check(largest_error > 0, "largest_error", f"is {largest_error}", "It must be > 0 (mm).")
        self.pairs = PairSettings(frames, draws, points)
        self.sample = sample
        self.refine = refine
        self.feature_size = features
        self.scale = scale
        self.largest_error = largest_error

    @torch.no_grad()
    def generate(
        self, batch: PairObservations, count: int, keys: Int[Tensor, " B"]
    ) -> RelativePoseHypotheses:
        """The normalised 8-point algorithm on T random correspondences, then ``refine`` times on
        all, reweighted.

        Where they are degenerate or no pose has most points in front, all correspondences stand in
        for them.
        """
        a, b, both = batch.correspondences()
        subsets = torch.cat((random_subsets(both, count, self.sample, keys), both[:, None]), dim=1)
        E, determined = eight_point_subsets(a, b, subsets.double())
        for _ in range(self.refine):
            E, determined = eight_point_subsets(
                a, b, robust_weights(E, a, b, both) * determined[..., None]
            )
        some = slice(None, None, -(-a.shape[1] // CHEIRALITY))
        R, t, ok = poses_in_front(
            E, a[:, some], b[:, some], both[:, None, some] & determined[..., None]
        )
        R = torch.where(ok[..., None, None], R, R[:, -1:])[:, :-1]
        t = torch.where(ok[..., None], t, t[:, -1:])[:, :-1]
        estimated = ok[:, -1]
        length = self.scale(RelativePoseEstimate(R, t, estimated[:, None].expand(-1, count)), batch)
        return RelativePoseHypotheses(R, t * length[..., None], estimated, a, b, both)

    @torch.no_grad()
    def featurize(self, hypotheses: RelativePoseHypotheses) -> Float[Tensor, "B H D"]:
        """The distances (mm) between corresponding rays, sorted: D evenly spaced quantiles of them,
        so that missing joints and another number of frames change nothing but their precision.
        """
        h = hypotheses
        length = h.t.norm(dim=-1, keepdim=True)
        direction = h.t / torch.where(length > 0, length, 1.0)
        distances = ray_distances(h.R, direction, h.a, h.b).float() * length.float()
        return quantiles(distances, h.both[:, None].expand_as(distances), self.feature_size)

    def aggregate(
        self, hypotheses: RelativePoseHypotheses, weights: Float[Tensor, "B H"]
    ) -> RelativePoseEstimate:
        """Weighted average of the rotations' quaternions and of the translations.

        The quaternions are sign-aligned and summed (``average_rotation``). The direction of t is
        that of the weighted sum, its length the weighted mean of the lengths: a sum of unequal
        directions would be too short.
        """
        weights = weights.double()
        R = average_rotation(hypotheses.R, weights)
        total = torch.einsum("bh,bhc->bc", weights, hypotheses.t)
        length = (weights * hypotheses.t.norm(dim=-1)).sum(-1, keepdim=True)
        norm = total.norm(dim=-1, keepdim=True)
        return RelativePoseEstimate(
            R, total * length / torch.where(norm > 0, norm, 1.0), hypotheses.estimated
        )

    def as_estimates(self, hypotheses: RelativePoseHypotheses) -> RelativePoseEstimate:
        estimated = hypotheses.estimated[:, None].expand(hypotheses.t.shape[:-1])
        return RelativePoseEstimate(hypotheses.R, hypotheses.t, estimated)

    def error(
        self, estimate: RelativePoseEstimate, truth: PairTruth
    ) -> tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]:
        """E_3D (eq:reprojection-3d-error), mm: the mean distance of random points from what the
        estimated pair makes of their true images. A point that it cannot see in front of both
        cameras has ``largest_error``.
        """
        cameras = truth.cameras
        pixels, depth = project(cameras, truth.points)
        x = normalise(cameras.K, pixels)
        in_a = truth.points @ cameras.R[:, 0].mT + cameras.t[:, 0, None]
        # linear triangulation counts a ray's distance by its camera's focal length
        focal = torch.linalg.det(cameras.K)
        share_a = (focal[:, 0] / focal.sum(-1))[:, None, None]
        extra = (None,) * (estimate.t.dim() - 2)
        a, b, in_a, share_a = (v[:, *extra] for v in (x[:, 0], x[:, 1], in_a, share_a))
        alpha, beta = depths(estimate.R, estimate.t, a, b)
        on_a = homogeneous(a) * alpha[..., None]
        on_b = (homogeneous(b) * beta[..., None] - estimate.t[..., None, :]) @ estimate.R
        distance = (
            (share_a * on_a + (1 - share_a) * on_b - in_a)
            .norm(dim=-1)
            .clamp(max=self.largest_error)
        )
        distance = torch.where((alpha > 0) & (beta > 0), distance, self.largest_error)
        visible = (depth > 0).all(dim=1)
        share = visible / visible.sum(-1, keepdim=True).clamp_min(1)
        error = (distance * share[:, *extra]).sum(-1)
        return error, visible.any(-1) & (
            estimate.estimated.all(-1) if extra else estimate.estimated
        )


def random_subsets(
    both: Bool[Tensor, "B N"], count: int, size: int, keys: Int[Tensor, " B"]
) -> Bool[Tensor, "B H N"]:
    """For each hypothesis ``size`` random usable correspondences: at most half of them, 8 at least,
    all if fewer.
    """
    number = both.shape[-1]
    size = (both.sum(-1) // 2).clamp(MINIMUM, max(size, MINIMUM)).clamp_max(number)
    # a hash of 64 bits makes two numbers to order the correspondences by
    order = randomness.bits(keys, (count, -(-number // 2))).view(torch.int32)[..., :number]
    order = torch.where(both[:, None], order, torch.iinfo(torch.int32).max)
    chosen = order.topk(int(size.max()) if len(size) else 0, dim=-1, largest=False).indices
    first = (torch.arange(chosen.shape[-1], device=both.device) < size[:, None, None]).expand_as(
        chosen
    )
    return torch.zeros_like(order, dtype=torch.bool).scatter(-1, chosen, first) & both[:, None]


def quantiles(
    values: Float[Tensor, "*B N"], mask: Bool[Tensor, "*B N"], count: int
) -> Float[Tensor, "*B D"]:
    """``count`` evenly spaced quantiles (0 to 1, linear between order statistics) of the values in
    the mask; else 0.
    """
    ordered = _sorted(torch.where(mask, values, torch.inf))
    number = mask.sum(-1, keepdim=True)
    place = torch.linspace(0, 1, count, dtype=values.dtype, device=values.device) * (
        number - 1
    ).clamp_min(0)
    low = place.floor().long()
    high = torch.minimum(low + 1, (number - 1).clamp_min(0))
    below = ordered.gather(-1, low)
    above = ordered.gather(-1, high)
    found = torch.where(high > low, torch.lerp(below, above, place - low), below)
    return torch.where(number > 0, found, 0.0)


def _sorted(values: Float[Tensor, "*B N"]) -> Float[Tensor, "*B N"]:
    if values.device.type != "cpu":
        return values.sort(dim=-1).values
    return torch.from_numpy(
        np.sort(values.numpy(), axis=-1)
    )  # torch also makes the indices, 8 times slower
