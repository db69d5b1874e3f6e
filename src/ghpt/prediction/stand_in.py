"""The classical estimators as predictors."""

from __future__ import annotations

import torch

from ghpt.geometry.cameras import reprojection_error
from ghpt.geometry.triangulation import Status
from ghpt.models.baselines import Baseline, Linear
from ghpt.reconstruction import Reconstruction, State
from ghpt.recording import KeyPointBatch

_STATES = {
    Status.OK: State.OBSERVED, Status.FEW_VIEWS: State.FEW_VIEWS, Status.PARALLEL: State.PARALLEL,
    Status.BEHIND: State.BEHIND, Status.NONFINITE_INPUT: State.BAD_INPUT, Status.NOT_CONVERGED: State.OBSERVED,
}  # fmt: skip


class Classical:
    def __init__(self, estimator: Baseline) -> None:
        self.estimator = estimator

    def __call__(self, batch: KeyPointBatch) -> Reconstruction:
        found = self.estimator.triangulate(batch)
        table = torch.tensor([int(_STATES[s]) for s in Status], dtype=torch.int8)
        state = table[found.status.long()]
        error = reprojection_error(batch.cameras, batch.key_points, found.points)
        views = batch.seen & (state == State.OBSERVED)[:, None] & error.isfinite()
        square = torch.where(views, error, 0.0).square().sum(1) / views.sum(1).clamp(min=1)
        frames, count, joints = batch.seen.shape
        return Reconstruction(
            frame=batch.sample, points=found.points.float(), state=state, error=square.sqrt().float(), views=views,
            covariance=torch.zeros(frames, joints, 6), score=torch.zeros(frames),
            swapped=torch.zeros(frames, count, dtype=torch.bool),
        )  # fmt: skip


class Learned:
    def __init__(self, model):
        self.model = model

    def __call__(self, batch):
        from ghpt.models.selection import selection_weights

        keys = self.model.keys("predict", batch)
        pool = self.model.pool(batch, keys)
        weights = selection_weights("weight", pool.logits, pool.errors, self.model.temperature, keys)
        est = self.model.problem.combine(pool.hypotheses, weights)
        base = Classical(Linear())(batch)
        import dataclasses

        return dataclasses.replace(base, points=est.points)
