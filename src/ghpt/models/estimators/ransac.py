"""RANSAC over the pairs of views of each joint.

Its threshold is fixed, or follows the frame's noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.triangulation import (
    System,
    Triangulation,
    flat_cameras,
    select_frames,
    solve_in_parts,
    triangulate_subsets,
)
from ghpt.models.estimators.classical import ConfidenceWeighted, fill_frames, person_scale
from ghpt.observations import Observations
from ghpt.randomness import key, uniform


@dataclass(frozen=True)
class Ransac(ConfidenceWeighted):
    """For each joint the pair of views whose point has the most inliers, then the inliers together.

    Among equals the pair with the least residuals is taken; where confidence says something, the
    one whose inliers have the most of it as well: a detector that gives every joint guesses those
    that it does not see, with little confidence.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's scale in
    that view. ``pairs``: where the views make more pairs than this, so many random ones are tried
    for each joint, keyed by ``seed`` and the sample.
    """

    threshold: float
    pairs: int
    seed: int

    def __post_init__(self) -> None:
        check_positive(threshold=self.threshold, pairs=self.pairs)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        return fill_frames(self.threshold, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        rig = flat_cameras(batch.cameras, batch.valid.shape[:1])
        scale = person_scale(batch.key_points, batch.valid)
        pairs = self._pairs(batch)
        weights = self.confidence_weights(batch)
        trust = _trust(weights, batch.valid)

        def solve(rows: slice) -> Triangulation:
            candidates = _Candidates(
                cameras=select_frames(rig, rows),
                key_points=batch.key_points[rows],
                trust=trust[rows],
                valid=batch.valid[rows],
                scale=scale[rows],
                pairs=pairs[rows],
            )
            weight = weights[rows].permute(1, 2, 0)
            return candidates.assess(self._inliers(candidates), weight)

        frames, views, joints = batch.valid.shape
        shape = torch.Size((frames, max(views, pairs.shape[1]), joints))
        return solve_in_parts(solve, shape)

    def _inliers(self, candidates: _Candidates) -> Bool[Tensor, "V J B"]:
        frames = candidates.residual.shape[-1]
        thresholds = candidates.residual.new_full((frames,), self.threshold)
        return candidates.inliers(thresholds)

    def _pairs(self, batch: Observations) -> Bool[Tensor, "B P J V"]:
        """Return pairs of valid views: each pair of the rig if they are few, else random ones."""
        frames, views, joints = batch.valid.shape
        device = batch.valid.device
        if views * (views - 1) // 2 <= self.pairs:
            one, other = torch.triu_indices(views, views, offset=1, device=device)
            eye = torch.eye(views, dtype=torch.bool, device=device)
            pairs = eye[one] | eye[other]
            return pairs[None, :, None].expand(frames, -1, joints, -1)
        valid = batch.valid.mT[:, None]
        count = valid.sum(-1)
        draw_key = key(self.seed, "ransac", batch.index, device=device)
        draw = uniform(draw_key, (self.pairs, joints, 2))
        one = (draw[..., 0] * count).long()
        other = (draw[..., 1] * (count - 1)).long()
        other = other + (other >= one)
        rank = valid.cumsum(-1) - 1
        is_one = rank == one[..., None]
        is_other = rank == other[..., None]
        return valid & (is_one | is_other)


@dataclass(frozen=True)
class AdaptiveRansac(Ransac):
    """RANSAC whose threshold follows the noise of each frame.

    It is at least ``adapt`` times the ``quantile`` of the residuals that it leaves in the frame.

    Where the whole frame is noisy or the cameras are off, views that are as good as the others are
    outliers to a fixed threshold, and what remains are pairs that agree by chance. The threshold
    grows in at most ``rounds`` rounds. The quantile is above the median, because two of four views
    that agree by chance make half of the residuals small; outliers do not move it as long as they
    are fewer than the rest.
    """

    adapt: float
    quantile: float
    rounds: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(adapt=self.adapt, rounds=self.rounds)
        hint = "It must be between 0 and 1."
        check(0 < self.quantile < 1, "quantile", f"is {self.quantile}", hint)

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        scale = person_scale(batch.key_points, batch.valid).clamp(min=1e-12)
        error = reprojection_error(batch.cameras, batch.key_points, points)
        residual = error / scale[..., None]
        return self._thresholds(residual.permute(1, 2, 0), batch.valid.permute(1, 2, 0))

    def _thresholds(
        self, residual: Float[Tensor, "V J B"], valid: Bool[Tensor, "V J B"]
    ) -> Float[Tensor, " B"]:
        """Return each frame's threshold, of residuals as fractions of the person's scale."""
        enough = valid.sum(0) >= 2
        measured = valid & enough & ~residual.isnan()
        measured = measured.flatten(0, 1)
        residual = torch.where(measured, residual.flatten(0, 1), torch.inf)
        ordered = residual.sort(dim=0).values
        last = (measured.sum(0) - 1).clamp(min=0)
        rank = (self.quantile * last).long()
        noise = ordered.gather(0, rank[None])[0]
        adapted = torch.where(torch.isfinite(noise), self.adapt * noise, 0.0)
        return adapted.clamp(min=self.threshold)

    def _inliers(self, candidates: _Candidates) -> Bool[Tensor, "V J B"]:
        inlier = super()._inliers(candidates)
        thresholds = candidates.residual.new_full(inlier.shape[-1:], self.threshold)
        for _ in range(self.rounds):
            residual = candidates.residuals(candidates.point(inlier))
            wider = self._thresholds(residual, candidates.system.used)
            rows = torch.nonzero(wider > thresholds)[:, 0]
            if not len(rows):
                break
            thresholds = torch.maximum(thresholds, wider)
            inlier[..., rows] = candidates.inliers(thresholds[rows], rows)
        return inlier


class _Candidates:
    """The points of the pairs of views of a few frames, and how far each is from every key point.

    Arrays are [V, P, J, B] and [V, J, B], residuals are fractions of the person's ``scale``.
    """

    def __init__(
        self,
        cameras: Cameras,
        key_points: Float[Tensor, "B V J 2"],
        trust: Float[Tensor, "B V J"],
        valid: Bool[Tensor, "B V J"],
        scale: Float[Tensor, "B V"],
        pairs: Bool[Tensor, "B P J V"],
    ) -> None:
        frames = len(valid)
        each = Cameras(
            cameras.K.expand(frames, *cameras.K.shape[1:]),
            cameras.R.expand(frames, *cameras.R.shape[1:]),
            cameras.t.expand(frames, *cameras.t.shape[1:]),
        )
        points, ok = triangulate_subsets(each, key_points, valid, pairs)
        self.valid = valid.permute(1, 2, 0)
        self.trust = trust.permute(1, 2, 0)
        self.system = System(cameras, key_points, self.valid)
        scale = scale.double().clamp(min=1e-12)
        square = scale.mT[:, None] ** 2
        self.square = torch.where(self.system.used, square, 0.0)
        local = points - self.system.origin[:, None, None]
        points = torch.where(ok[..., None], local, torch.nan)
        self.residual = self.residuals(points.permute(3, 1, 2, 0).contiguous())

    @cached_property
    def full(self) -> tuple[Float[Tensor, "3 J B"], Float[Tensor, "J B"]]:
        """The solution of all views together; seldom needed."""
        return self.system.solve(self.system.used.double())

    def residuals(self, points: Float[Tensor, "3 *P J B"]) -> Float[Tensor, "V *P J B"]:
        """Return the residuals of points of the local world.

        They are inf where there is no point, and in views that do not see it or have it behind.
        """
        system = self.system
        views = range(len(self.square))
        squares = [system.square_residuals(points, self.square, view) for view in views]
        return torch.stack(squares).sqrt()

    def inliers(
        self, thresholds: Float[Tensor, " B"], rows: Tensor | None = None
    ) -> Bool[Tensor, "V J B"]:
        """Return the views within the frame's threshold of each joint's best point.

        The best point has the most of them, and among equals the greatest sum of trust times what
        is left of the threshold. ``rows``: of some of the frames.
        """
        residual = self.residual if rows is None else self.residual[..., rows]
        trusts = self.trust if rows is None else self.trust[..., rows]
        # what divides equals sums up to less than one more inlier
        share = 1 / (len(residual) + 1)
        slope = share / thresholds
        score = torch.zeros_like(residual[0])
        for of_view, trust in zip(residual, trusts, strict=True):
            loss = share * (1 - trust) + trust * (of_view * slope)
            score = score + torch.where(of_view <= thresholds, 1 - loss, 0.0)
        best = score.argmax(0).expand(len(residual), 1, -1, -1)
        own = residual.gather(1, best)[:, 0]
        return own <= thresholds

    def point(self, inlier: Bool[Tensor, "V J B"]) -> Float[Tensor, "3 J B"]:
        """Return the points of the inliers; of all views where those do not fix one."""
        point, cond = self.system.solve(inlier.double())
        fixed = torch.isfinite(cond)
        if fixed.all():
            return point
        fallback, _ = self.full
        return torch.where(fixed, point, fallback)

    def assess(
        self, inlier: Bool[Tensor, "V J B"], weight: Float[Tensor, "V J B"]
    ) -> Triangulation:
        """Return the Triangulation of the inliers; of all views where those have no point.

        ``weight``: of the squared residuals, > 0.
        """
        system = self.system
        point, cond = system.solve(inlier * weight)
        robust = system.assess(point, cond, inlier, torch.zeros_like(inlier[0]))
        if robust.ok.all():
            return robust
        point, cond = self.full
        rejected = (self.valid & ~system.used).any(0)
        linear = system.assess(point, cond, system.used, rejected)
        return robust.with_fallback(robust.ok, linear)


def _trust(weight: Float[Tensor, "B V J"], valid: Bool[Tensor, "B V J"]) -> Float[Tensor, "B V J"]:
    """Return each view's weight as a share of the largest one of the joint's views."""
    known = torch.where(valid, weight, 0.0)
    return known / known.amax(1, keepdim=True).clamp(min=1e-12)
