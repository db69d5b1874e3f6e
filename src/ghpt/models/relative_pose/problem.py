"""The camera problem (paper, section 3.2): relative poses of two cameras.

A hypothesis is the relative pose from T random correspondences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt import randomness
from ghpt.data.datasets.frames import Sampling
from ghpt.data.datasets.pairs import Pairs, PairSettings
from ghpt.errors import check
from ghpt.extras import build_installed
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
from ghpt.models.problem import (
    BaselineSettings,
    Errors,
    Features,
    Hypotheses,
    Keys,
    Problem,
    Weights,
)
from ghpt.models.relative_pose.evaluation import PairsMeasured, evaluate_pairs
from ghpt.models.relative_pose.schema import PAIRS, PairPredictions, PairSample, RigTables
from ghpt.observations import (
    Labelled,
    LabelledRecording,
    PairObservations,
    PairTruth,
    RelativePoseEstimate,
)
from ghpt.report.report import Report

CHEIRALITY = 256
"""Correspondences, evenly over all, that tell which of four poses has them in front.

More would only repeat it."""


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


class RelativePose(Problem):
    """Relative poses of two cameras, each from random correspondences; compared by E_3D.

    ``frames``, ``draws``, ``points``: see ``PairSettings``. ``sample``: T, the correspondences of a
    hypothesis; at most half of those that both cameras see, but 8 at least. ``refine``: how often
    all correspondences, weighted by how well the hypothesis explains them, are solved again (0: the
    paper). ``features``: number of quantiles of the ray distances. ``scale``: what gives t its
    length. ``largest_error``: mm, no point counts for more (one almost at infinity would drown the
    pool).
    """

    measures = "E_3D"
    schema = PAIRS

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
        hint = f"The 8-point algorithm needs {MINIMUM}."
        check(sample >= MINIMUM, "sample", f"is {sample}", hint)
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
        self, observations: PairObservations, count: int, keys: Keys
    ) -> RelativePoseHypotheses:
        """Apply the normalised 8-point algorithm to T random correspondences.

        Then ``refine`` times to all of them, reweighted. Where they are degenerate or no pose has
        most points in front, all correspondences stand in for them.
        """
        a, b, both = observations.correspondences()
        drawn = random_subsets(both, count, self.sample, keys)
        subsets = torch.cat((drawn, both[:, None]), dim=1)  # the last one: all of them
        E, determined = eight_point_subsets(a, b, subsets.double())
        for _ in range(self.refine):
            weights = robust_weights(E, a, b, both) * determined[..., None]
            E, determined = eight_point_subsets(a, b, weights)
        some = slice(None, None, -(-a.shape[1] // CHEIRALITY))
        used = both[:, None, some] & determined[..., None]
        R, t, ok = poses_in_front(E, a[:, some], b[:, some], used)
        R = torch.where(ok[..., None, None], R, R[:, -1:])[:, :-1]
        t = torch.where(ok[..., None], t, t[:, -1:])[:, :-1]
        estimated = ok[:, -1]
        unscaled = RelativePoseEstimate(R, t, estimated[:, None].expand(-1, count))
        length = self.scale(unscaled, observations)
        return RelativePoseHypotheses(R, t * length[..., None], estimated, a, b, both)

    @torch.no_grad()
    def featurize(self, hypotheses: RelativePoseHypotheses) -> Features:
        """Return the distances (mm) between corresponding rays, sorted.

        They are D evenly spaced quantiles, so that missing joints and another number of frames
        change nothing but their precision.
        """
        t = hypotheses.t
        length = t.norm(dim=-1, keepdim=True)
        direction = t / torch.where(length > 0, length, 1.0)
        unit_distances = ray_distances(hypotheses.R, direction, hypotheses.a, hypotheses.b)
        distances = unit_distances.float() * length.float()
        both = hypotheses.both[:, None].expand_as(distances)
        return quantiles(distances, both, self.feature_size)

    def aggregate(
        self, hypotheses: RelativePoseHypotheses, weights: Weights
    ) -> RelativePoseEstimate:
        """Return the weighted average of the rotations' quaternions and of the translations.

        The quaternions are sign-aligned and summed (``average_rotation``). The direction of t is
        that of the weighted sum, its length the weighted mean of the lengths: a sum of unequal
        directions would be too short.
        """
        weights = weights.double()
        R = average_rotation(hypotheses.R, weights)
        total = torch.einsum("bh,bhc->bc", weights, hypotheses.t)
        length = (weights * hypotheses.t.norm(dim=-1)).sum(-1, keepdim=True)
        norm = total.norm(dim=-1, keepdim=True)
        t = total * length / torch.where(norm > 0, norm, 1.0)
        return RelativePoseEstimate(R, t, hypotheses.estimated)

    def as_estimates(self, hypotheses: RelativePoseHypotheses) -> RelativePoseEstimate:
        """Return all hypotheses as estimates with leading dimensions B H."""
        estimated = hypotheses.estimated[:, None].expand(hypotheses.t.shape[:-1])
        return RelativePoseEstimate(hypotheses.R, hypotheses.t, estimated)

    def error(self, estimate: RelativePoseEstimate, truth: PairTruth) -> Errors:
        """Return E_3D (eq:reprojection-3d-error), mm, and which pairs can be compared.

        It is the mean distance of random points from what the estimated pair makes of their true
        images. A point that it cannot see in front of both cameras has ``largest_error``.
        """
        cameras = truth.cameras
        pixels, depth = project(cameras, truth.points)
        images = normalise(cameras.K, pixels)
        in_a = truth.points @ cameras.R[:, 0].mT + cameras.t[:, 0, None]
        # linear triangulation counts a ray's distance by its camera's focal length
        focal = torch.linalg.det(cameras.K)
        share_a = (focal[:, 0] / focal.sum(-1))[:, None, None]
        extra = (None,) * (estimate.t.dim() - 2)
        a = images[:, 0][:, *extra]
        b = images[:, 1][:, *extra]
        in_a = in_a[:, *extra]
        share_a = share_a[:, *extra]
        alpha, beta = depths(estimate.R, estimate.t, a, b)
        on_a = homogeneous(a) * alpha[..., None]
        on_b = (homogeneous(b) * beta[..., None] - estimate.t[..., None, :]) @ estimate.R
        between = share_a * on_a + (1 - share_a) * on_b
        distance = (between - in_a).norm(dim=-1).clamp(max=self.largest_error)
        in_front = (alpha > 0) & (beta > 0)
        distance = torch.where(in_front, distance, self.largest_error)
        visible = (depth > 0).all(dim=1)
        share = visible / visible.sum(-1, keepdim=True).clamp_min(1)
        error = (distance * share[:, *extra]).sum(-1)
        estimated = estimate.estimated.all(-1) if extra else estimate.estimated
        return error, visible.any(-1) & estimated

    def dataset(self, recordings: Sequence[LabelledRecording], sampling: Sampling) -> Pairs:
        """Return pairs of cameras with random frames of their rig."""
        return Pairs(recordings, self.pairs, sampling.seed, sampling.train_samples)

    def baselines(
        self, settings: BaselineSettings, model: Any
    ) -> Mapping[str, Callable[[PairObservations], RelativePoseEstimate]]:
        """Return the other estimators; those that need the model have it."""
        built = build_installed(settings.camera_baselines, "camera_baselines")
        return {
            name: one(model=model) if isinstance(one, partial) else one
            for name, one in built.items()
        }

    def from_baseline(
        self, estimate: RelativePoseEstimate, observations: PairObservations
    ) -> RelativePoseEstimate:
        """Return the estimate with the length of t that the problem's ``scale`` gives it."""
        length = self.scale(estimate, observations)
        return replace(estimate, t=estimate.t * length[..., None])

    def record(self, batch: Labelled[PairObservations, PairTruth], dataset: Pairs) -> PairSample:
        """Return the pairs' true relative poses, rigs, draws and views."""
        R, t = batch.truth.relative_pose()
        observations = batch.observations
        return PairSample(R, t, observations.rig, observations.draw, observations.pair)

    def tables(self, dataset: Pairs) -> RigTables:
        """Return the true rigs."""
        return RigTables.from_rigs(dataset.rigs)

    def meta(self) -> dict[str, Any]:
        """Return the number of frames of a pair."""
        return {"frames": self.pairs.frames}

    def metrics(self, predictions: PairPredictions) -> PairsMeasured:
        """Return what a test run measured."""
        return evaluate_pairs(predictions)

    def report(self) -> Report:
        """Return the tables and figures; imported here, since drawing is slow to import."""
        from ghpt.report.pair_tensorboard import REPORT

        return REPORT


def random_subsets(
    both: Bool[Tensor, "B N"], count: int, size: int, keys: Keys
) -> Bool[Tensor, "B H N"]:
    """Return for each hypothesis ``size`` random correspondences that both views see.

    There are at most half of all, but 8 at least; all where there are fewer.
    """
    total = both.shape[-1]
    half = both.sum(-1) // 2
    sizes = half.clamp(MINIMUM, max(size, MINIMUM)).clamp_max(total)
    # a hash of 64 bits makes two numbers to order the correspondences by
    bits = randomness.bits(keys, (count, -(-total // 2)))
    order = bits.view(torch.int32)[..., :total]
    order = torch.where(both[:, None], order, torch.iinfo(torch.int32).max)
    most = int(sizes.max()) if len(sizes) else 0
    chosen = order.topk(most, dim=-1, largest=False).indices
    within = torch.arange(most, device=both.device) < sizes[:, None, None]
    none = torch.zeros_like(order, dtype=torch.bool)
    return none.scatter(-1, chosen, within.expand_as(chosen)) & both[:, None]


def quantiles(
    values: Float[Tensor, "*B N"], mask: Bool[Tensor, "*B N"], count: int
) -> Float[Tensor, "*B D"]:
    """Return ``count`` evenly spaced quantiles, from 0 to 1, of the values in the mask.

    They are linear between order statistics, and 0 where the mask is empty.
    """
    ordered = _sort(torch.where(mask, values, torch.inf))
    number = mask.sum(-1, keepdim=True)
    last = (number - 1).clamp_min(0)
    levels = torch.linspace(0, 1, count, dtype=values.dtype, device=values.device)
    place = levels * last
    low = place.floor().long()
    high = torch.minimum(low + 1, last)
    below = ordered.gather(-1, low)
    above = ordered.gather(-1, high)
    between = torch.lerp(below, above, place - low)
    found = torch.where(high > low, between, below)
    return torch.where(number > 0, found, 0.0)


def _sort(values: Float[Tensor, "*B N"]) -> Float[Tensor, "*B N"]:
    if values.device.type != "cpu":
        return values.sort(dim=-1).values
    # torch also makes the indices, 8 times slower
    return torch.from_numpy(np.sort(values.numpy(), axis=-1))
