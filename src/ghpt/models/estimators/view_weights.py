"""Learned view weights: the scorer says how much each view's key point is worth, and one
triangulation uses it.

The average of 3D hypotheses, the paper's estimate, is made of triangulations from few views and is
hardly better than they are. Their weights say more: views that are in likely poses are good views.
So the weight of a view, for a joint, is the probability that a hypothesis drawn by its weight has
that view in its subset, and the joint is triangulated once from all views under these weights. The
scorer still sees 3D poses alone, and is the one that the paper's loss trained.

The pool is drawn from views that agree. A scorer trained on a good detector has never seen what a
far outlier does to a pose; a robust estimator finds those without any knowledge of poses, so each
does what it can do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.errors import check
from ghpt.geometry.triangulation import Triangulation, triangulate
from ghpt.models.estimators.classical import Estimator, otherwise
from ghpt.models.estimators.ransac import Ransac
from ghpt.models.module import StochasticEstimator
from ghpt.models.pool import Pool
from ghpt.observations import Observations


@dataclass(frozen=True)
class Weighed:
    """What was made of a batch."""

    triangulation: Triangulation
    """The joints."""
    views: Bool[Tensor, "B V J"]
    """The views that agree, from which the hypotheses are."""
    pool: Pool


class ViewWeights(Estimator):
    """``model``'s scores of poses made of the views on which ``consensus`` finds agreement, turned
    into view weights.

    ``power``: of the probabilities; 1 is their definition, more trusts the scorer more. In a frame
    whose views disagree as a whole (cameras that are off, much noise) it falls with the square root
    of how far the consensus had to reach: what makes a pose likely there is hardly a single view.
    """

    def __init__(self, model: StochasticEstimator, consensus: Ransac, power: float) -> None:
        check(power > 0, "view_weights.power", f"is {power}", "It must be > 0.")
        self.model = model.eval()
        self.consensus = consensus
        self.power = power

    def triangulate(self, batch: Observations) -> Triangulation:
        return self.weigh(batch).triangulation

    @torch.no_grad()
    def weigh(self, batch: Observations, robust: Triangulation | None = None) -> Weighed:
        """The joints and all that they were made of. ``robust``: what ``consensus`` makes of the
        batch, if that is known.
        """
        robust = robust or self.consensus.triangulate(batch)
        views, _ = self.consensus.inlier_views(batch, robust.points, robust.has_position)
        agreed = replace(batch, valid=views)
        pool = self.model.sample(agreed, "view weights")
        weights = pool.weights().double()
        probability = torch.einsum("bh,bhjv->bvj", weights, pool.hypotheses.views.double())
        inlier_threshold = self.consensus.inlier_threshold(batch, robust.points)
        power = self.power * (self.consensus.threshold / inlier_threshold[:, None, None]).sqrt()
        result = triangulate(batch.cameras, batch.key_points, views * probability**power)
        return Weighed(otherwise(result, robust), views, pool)
