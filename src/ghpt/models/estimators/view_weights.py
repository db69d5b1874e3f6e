"""Learned view weights: the scorer says how much each view's key point is worth.

One triangulation uses them. The average of 3D hypotheses, the paper's estimate, is made of
triangulations from few views and is hardly better than they are. Their weights say more: views that
are in likely poses are good views. So the weight of a view, for a joint, is the probability that a
hypothesis drawn by its weight has that view in its subset, and the joint is triangulated once from
all views under these weights. The scorer still sees 3D poses alone, and is the one that the paper's
loss trained.

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
from ghpt.models.estimators.classical import Estimator, fall_back
from ghpt.models.estimators.ransac import Ransac
from ghpt.models.module import StochasticEstimator
from ghpt.models.pool import Pool
from ghpt.models.pose.problem import PoseHypotheses
from ghpt.observations import Observations


@dataclass(frozen=True)
class WeightedViews:
    """Joints triangulated under view weights, and what they are made of."""

    triangulation: Triangulation
    """The joints."""
    views: Bool[Tensor, "B V J"]
    """The views that agree, from which the hypotheses are."""
    pool: Pool


class ViewWeights(Estimator):
    """The scores of ``model``, turned into view weights.

    The poses that it scores are made of the views on which ``consensus`` finds agreement.

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
    def weigh(self, batch: Observations, robust: Triangulation | None = None) -> WeightedViews:
        """Return the joints and all that they are made of.

        ``robust``: what ``consensus`` makes of the batch, if that is known.
        """
        robust = robust or self.consensus.triangulate(batch)
        views, _ = self.consensus.inlier_views(batch, robust.points, robust.has_position)
        agreed = replace(batch, valid=views)
        pool = self.model.sample(agreed, "view weights")
        weights = pool.weights().double()
        probability = torch.einsum("bh,bhjv->bvj", weights, _subsets(pool).double())
        threshold = self.consensus.inlier_threshold(batch, robust.points)
        trust = (self.consensus.threshold / threshold[:, None, None]).sqrt()
        view_weights = probability ** (self.power * trust)
        result = triangulate(batch.cameras, batch.key_points, views * view_weights)
        return WeightedViews(fall_back(result, robust), views, pool)


def _subsets(pool: Pool) -> Bool[Tensor, "B H J V"]:
    """Return the views that each hypothesis of a joint is made of."""
    if not isinstance(pool.hypotheses, PoseHypotheses):
        raise TypeError("view weights are made of poses, not of other hypotheses")
    return pool.hypotheses.views
