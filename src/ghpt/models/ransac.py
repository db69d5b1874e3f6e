"""RANSAC over the pairs of views of each joint, with a fixed threshold or with one that follows the frame's noise."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check_positive
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.triangulation import (
    System,
    Triangulation,
    flat_cameras,
    in_parts,
    triangulate,
    triangulate_subsets,
)
from ghpt.models.baselines import Baseline, Linear, everywhere, otherwise, person_size
from ghpt.randomness import key, uniform
from ghpt.recording import KeyPointBatch


@dataclass(frozen=True)
class Ransac(Baseline):
    """For each joint the pair of views whose point has the most inliers (least residual among equals), then
    the inliers together.

    ``threshold``: an inlier's largest reprojection error, as a fraction of the person's size in that view.
    ``pairs``: where the views make more pairs than this, so many random ones are tried for each joint, keyed
    by ``seed`` and the sample.
    """

    threshold: float
    pairs: int
    seed: int

    def __post_init__(self) -> None:
        check_positive(threshold=self.threshold, pairs=self.pairs)

    def reach(self, batch: KeyPointBatch, points: Float[Tensor, "B J 3"]) -> Float[Tensor, " B"]:
        return everywhere(self.threshold, batch)

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        return self.at(batch, everywhere(self.threshold, batch))

    def at(self, batch: KeyPointBatch, thresholds: Float[Tensor, " B"]) -> Triangulation:
        """With a threshold for each frame."""
        rig = flat_cameras(batch.cameras, batch.seen.shape[:1])
        limit = (thresholds[:, None] * person_size(batch.key_points, batch.seen)).clamp(min=1e-12)
        candidates = self._pairs(batch)

        def part(rows: slice) -> tuple[Tensor, ...]:
            own = rig if len(rig.t) == 1 else rig.index(rows)
            return (self._inliers(own, batch.key_points[rows], batch.seen[rows], limit[rows], candidates[rows]),)

        frames, views, joints = batch.seen.shape
        (inlier,) = in_parts(part, torch.Size((frames, max(views, candidates.shape[1]), joints)))
        robust = triangulate(batch.cameras, batch.key_points, inlier.to(batch.key_points.dtype))
        return otherwise(robust, Linear().triangulate(batch))

    def _inliers(
        self, cameras: Cameras, key_points: Tensor, seen: Bool[Tensor, "B V J"], limit: Tensor, pairs: Tensor
    ) -> Bool[Tensor, "B V J"]:
        """The inliers of each joint's best pair."""
        whole = Cameras(*(x.expand(len(seen), *x.shape[1:]) for x in (cameras.K, cameras.R, cameras.t)))
        points, ok = triangulate_subsets(whole, key_points, seen, pairs)
        system = System(cameras, key_points, seen.permute(1, 2, 0))
        square = torch.where(system.used, limit.double().mT[:, None] ** 2, 0.0)
        ok, points = ok.permute(1, 2, 0), (points - system.origin[:, None, None]).permute(3, 1, 2, 0).contiguous()
        count, rest = torch.zeros(ok.shape, dtype=points.dtype, device=ok.device), 0.0
        for view in range(len(square)):
            residual = system.square_residuals(points, square, view)
            inlier = ok & (residual <= 1)
            count += inlier
            rest = rest + torch.where(inlier, residual.sqrt(), 0.0)
        # the residuals sum up to less than one more inlier
        best = (count - rest / (len(square) + 1)).argmax(0)[None]
        chosen, right = (x.gather(-3, best.expand(*x.shape[:-3], 1, -1, -1)).squeeze(-3) for x in (points, ok))
        return torch.stack(
            [right & (system.square_residuals(chosen, square, view) <= 1) for view in range(len(square))]
        ).permute(2, 0, 1)

    def _pairs(self, batch: KeyPointBatch) -> Bool[Tensor, "B P J V"]:
        """Pairs of seen views: each pair of the rig if they are few, else random ones."""
        frames, views, joints = batch.seen.shape
        device = batch.seen.device
        if views * (views - 1) // 2 <= self.pairs:
            one, other = torch.triu_indices(views, views, offset=1, device=device)
            eye = torch.eye(views, dtype=torch.bool, device=device)
            return (eye[one] | eye[other])[None, :, None].expand(frames, -1, joints, -1)
        seen = batch.seen.mT[:, None]
        count = seen.sum(-1)
        draw = uniform(key(self.seed, "ransac", batch.sample, device=device), (self.pairs, joints, 2))
        one = (draw[..., 0] * count).long()
        other = (draw[..., 1] * (count - 1)).long()
        other = other + (other >= one)
        place = seen.cumsum(-1) - 1
        return seen & ((place == one[..., None]) | (place == other[..., None]))


@dataclass(frozen=True)
class AdaptiveRansac(Ransac):
    """RANSAC whose threshold in a frame is at least ``adapt`` times the median residual of what it finds there.

    Where the whole frame is noisy or the cameras are off, views that are as good as the others are outliers to a
    fixed threshold, and what remains are pairs that agree by chance. The threshold grows in at most ``rounds``
    rounds; outliers, as long as they are less than half, do not move a median.
    """

    adapt: float
    rounds: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(adapt=self.adapt, rounds=self.rounds)

    def reach(self, batch: KeyPointBatch, points: Float[Tensor, "B J 3"]) -> Float[Tensor, " B"]:
        size = person_size(batch.key_points, batch.seen).clamp(min=1e-12)[..., None]
        residual = reprojection_error(batch.cameras, batch.key_points, points) / size
        median = torch.where(batch.seen, residual, torch.nan).flatten(1).nanmedian(dim=1).values
        wider = torch.where(torch.isfinite(median), self.adapt * median, 0.0)
        return wider.clamp(min=self.threshold)

    def triangulate(self, batch: KeyPointBatch) -> Triangulation:
        thresholds = everywhere(self.threshold, batch)
        found = self.at(batch, thresholds)
        for _ in range(self.rounds):
            wider = self.reach(batch, found.points)
            rows = torch.nonzero(wider > thresholds)[:, 0]
            if not len(rows):
                break
            thresholds = torch.maximum(thresholds, wider)
            found = _with_rows(found, rows, self.at(batch.rows(rows), thresholds[rows]))
        return found


def _with_rows(whole: Triangulation, rows: Tensor, part: Triangulation) -> Triangulation:
    """``whole`` with ``part`` in its ``rows``."""
    names = [field.name for field in fields(Triangulation)]
    return Triangulation(**{n: getattr(whole, n).index_copy(0, rows, getattr(part, n)) for n in names})
