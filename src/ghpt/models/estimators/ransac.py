"""RANSAC over the pairs of views of each joint, with a fixed threshold or with one that follows the
frame's noise.
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
from ghpt.models.estimators.classical import Estimator, everywhere, person_scale
from ghpt.observations import Observations
from ghpt.randomness import key, uniform


@dataclass(frozen=True)
class Ransac(Estimator):
    """For each joint the pair of views whose point has the most inliers (least residual among
    equals), then the inliers together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's size in
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
        return everywhere(self.threshold, batch)

    def triangulate(self, batch: Observations) -> Triangulation:
        rig = flat_cameras(batch.cameras, batch.valid.shape[:1])
        size = person_scale(batch.key_points, batch.valid)
        pairs = self._pairs(batch)

        def solve(rows: slice) -> Triangulation:
            own = select_frames(rig, rows)
            candidates = _Candidates(
                own, batch.key_points[rows], batch.valid[rows], size[rows], pairs[rows]
            )
            return candidates.assess(self._inliers(candidates))

        frames, views, joints = batch.valid.shape
        shape = torch.Size((frames, max(views, pairs.shape[1]), joints))
        return solve_in_parts(solve, shape)

    def _inliers(self, candidates: _Candidates) -> Bool[Tensor, "V J B"]:
        return candidates.inliers(
            candidates.residual.new_full((candidates.residual.shape[-1],), self.threshold)
        )

    def _pairs(self, batch: Observations) -> Bool[Tensor, "B P J V"]:
        """Pairs of seen views: each pair of the rig if they are few, else random ones."""
        frames, views, joints = batch.valid.shape
        device = batch.valid.device
        if views * (views - 1) // 2 <= self.pairs:
            one, other = torch.triu_indices(views, views, offset=1, device=device)
            eye = torch.eye(views, dtype=torch.bool, device=device)
            return (eye[one] | eye[other])[None, :, None].expand(frames, -1, joints, -1)
        valid = batch.valid.mT[:, None]
        count = valid.sum(-1)
        draw = uniform(
            key(self.seed, "ransac", batch.index, device=device), (self.pairs, joints, 2)
        )
        one = (draw[..., 0] * count).long()
        other = (draw[..., 1] * (count - 1)).long()
        other = other + (other >= one)
        place = valid.cumsum(-1) - 1
        return valid & ((place == one[..., None]) | (place == other[..., None]))


@dataclass(frozen=True)
class AdaptiveRansac(Ransac):
    """RANSAC whose threshold in a frame is at least ``adapt`` times the ``quantile`` of the
    residuals that it leaves there.

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
        check(
            0 < self.quantile < 1, "quantile", f"is {self.quantile}", "It must be between 0 and 1."
        )

    def inlier_threshold(
        self, batch: Observations, points: Float[Tensor, "B J 3"]
    ) -> Float[Tensor, " B"]:
        size = person_scale(batch.key_points, batch.valid).clamp(min=1e-12)[..., None]
        residual = reprojection_error(batch.cameras, batch.key_points, points) / size
        return self._reach(residual.permute(1, 2, 0), batch.valid.permute(1, 2, 0))

    def _reach(
        self, residual: Float[Tensor, "V J B"], valid: Bool[Tensor, "V J B"]
    ) -> Float[Tensor, " B"]:
        """From residuals of the points, as fractions of the person's size."""
        counted = (valid & (valid.sum(0) >= 2) & ~residual.isnan()).flatten(0, 1)
        ordered = torch.where(counted, residual.flatten(0, 1), torch.inf).sort(dim=0).values
        place = (self.quantile * (counted.sum(0) - 1).clamp(min=0)).long()
        noise = ordered.gather(0, place[None])[0]
        return torch.where(torch.isfinite(noise), self.adapt * noise, 0.0).clamp(min=self.threshold)

    def _inliers(self, candidates: _Candidates) -> Bool[Tensor, "V J B"]:
        inlier = super()._inliers(candidates)
        thresholds = candidates.residual.new_full(inlier.shape[-1:], self.threshold)
        for _ in range(self.rounds):
            wider = self._reach(
                candidates.residuals(candidates.point(inlier)), candidates.system.used
            )
            rows = torch.nonzero(wider > thresholds)[:, 0]
            if not len(rows):
                break
            thresholds = torch.maximum(thresholds, wider)
            inlier[..., rows] = candidates.inliers(thresholds[rows], rows)
        return inlier


class _Candidates:
    """The points of the pairs of views of a few frames, and how far each is from every key point.

    Arrays are [V, P, J, B] and [V, J, B], residuals are fractions of the person's ``size``.
    """

    def __init__(
        self,
        cameras: Cameras,
        key_points: Float[Tensor, "B V J 2"],
        valid: Bool[Tensor, "B V J"],
        size: Float[Tensor, "B V"],
        pairs: Bool[Tensor, "B P J V"],
    ) -> None:
        whole = Cameras(
            *(x.expand(len(valid), *x.shape[1:]) for x in (cameras.K, cameras.R, cameras.t))
        )
        points, ok = triangulate_subsets(whole, key_points, valid, pairs)
        self.valid = valid.permute(1, 2, 0)
        self.system = System(cameras, key_points, self.valid)
        self.square = torch.where(
            self.system.used, size.double().clamp(min=1e-12).mT[:, None] ** 2, 0.0
        )
        points = torch.where(ok[..., None], points - self.system.origin[:, None, None], torch.nan)
        self.residual = self.residuals(points.permute(3, 1, 2, 0).contiguous())

    @cached_property
    def of_all_views(self) -> tuple[Float[Tensor, "3 J B"], Float[Tensor, "J B"]]:
        """The solution of all views together; seldom needed."""
        return self.system.solve(self.system.used.double())

    def residuals(self, points: Float[Tensor, "3 *P J B"]) -> Float[Tensor, "V *P J B"]:
        """Of points of the local world; inf where there is none, and for views that do not see it
        or have it behind.
        """
        views = range(len(self.square))
        return torch.stack(
            [self.system.square_residuals(points, self.square, view) for view in views]
        ).sqrt()

    def inliers(
        self, thresholds: Float[Tensor, " B"], rows: Tensor | None = None
    ) -> Bool[Tensor, "V J B"]:
        """The views within the frame's threshold of each joint's best point: that with the most of
        them, and with the least sum of residuals among equals. ``rows``: of some of the frames.
        """
        residual = self.residual if rows is None else self.residual[..., rows]
        # the residuals sum up to less than one more inlier
        slope = 1 / (thresholds * (len(residual) + 1))
        score = 0.0
        for of_view in residual:
            score = score + torch.where(of_view <= thresholds, 1 - of_view * slope, 0.0)
        best = score.argmax(0).expand(len(residual), 1, -1, -1)
        return residual.gather(1, best)[:, 0] <= thresholds

    def point(self, inlier: Bool[Tensor, "V J B"]) -> Float[Tensor, "3 J B"]:
        """Of the inliers; of all views where those do not fix one."""
        point, cond = self.system.solve(inlier.double())
        fixed = torch.isfinite(cond)
        if fixed.all():
            return point
        fallback, _ = self.of_all_views
        return torch.where(fixed, point, fallback)

    def assess(self, inlier: Bool[Tensor, "V J B"]) -> Triangulation:
        """Return the Triangulation of the inliers; of all views where those have no point."""
        system = self.system
        point, cond = system.solve(inlier.double())
        robust = system.assess(point, cond, inlier, torch.zeros_like(inlier[0]))
        if robust.ok.all():
            return robust
        point, cond = self.of_all_views
        rejected = (self.valid & ~system.used).any(0)
        linear = system.assess(point, cond, system.used, rejected)
        return robust.with_fallback(robust.ok, linear)
