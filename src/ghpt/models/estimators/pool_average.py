"""The paper's estimate for use: the average of a trained model's hypotheses by their weights.

The pool is drawn from views that agree. A scorer trained on a good detector has never seen what a
far outlier does to a pose; a robust estimator finds those without any knowledge of poses, so each
does what it can do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.geometry.triangulation import Triangulation
from ghpt.models.estimators.ransac import Ransac
from ghpt.models.module import StochasticEstimator
from ghpt.models.pool import Pool
from ghpt.observations import Observations


@dataclass(frozen=True)
class AveragedPool:
    """Joints that are averages over a pool, and what they are made of."""

    triangulation: Triangulation
    """The joints; what is known of them beside their points is the consensus' own."""
    views: Bool[Tensor, "B V J"]
    """The views that agree, from which the hypotheses are."""
    pool: Pool


class PoolAverage:
    """The estimate ``weight`` of ``model``, from the views on which ``consensus`` finds agreement.

    Where that gives a joint no point, it is what ``consensus`` makes of it.
    """

    def __init__(self, model: StochasticEstimator, consensus: Ransac) -> None:
        self.model = model.eval()
        self.consensus = consensus

    @torch.no_grad()
    def estimate(self, batch: Observations, robust: Triangulation | None = None) -> AveragedPool:
        """Return the joints and all that they are made of.

        ``robust``: what ``consensus`` makes of the batch, if that is known.
        """
        robust = robust or self.consensus.triangulate(batch)
        views, _ = self.consensus.inlier_views(batch, robust.points, robust.has_position)
        pool = self.model.sample(replace(batch, valid=views), "prediction")
        average = pool.estimate()
        estimated = average.estimated & robust.has_position
        points = torch.where(estimated[..., None], average.points.double(), robust.points)
        return AveragedPool(replace(robust, points=points), views, pool)
