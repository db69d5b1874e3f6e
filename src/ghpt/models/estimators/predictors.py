"""From a batch of key points to what a recording becomes, by a classical estimator or by the
learned model.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from ghpt.geometry.normal_equations import valid_key_points
from ghpt.geometry.triangulation import Triangulation
from ghpt.models.estimators.classical import Estimator, poses_of
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.uncertainty import JointUncertainty, UncertaintyModel
from ghpt.models.estimators.view_weights import ViewWeights
from ghpt.observations import Observations
from ghpt.reconstruction import Reconstruction, State

FAR = 20.0
"""A key point so many times as far from its view's median as the median one belongs to nobody."""


class Predictor(Protocol):
    """What `predict` runs: each frame's result is its own, whatever batch it is in, once
    ``fitted``.
    """

    def fitted(self, batch: Observations) -> Predictor:
        """The same with the noise level of these frames: a few hundred, spread over the recording."""

    def __call__(self, batch: Observations) -> Reconstruction:
        """The batch's frames, with ``frame`` = ``batch.index``; on the CPU."""


class Classical:
    """A classical estimator with what it can say of its joints.

    A view counts as one of those that made a joint if its residual is within the estimator's
    ``inlier_threshold``; where fewer than two views are, all that were given to it count, and the
    error and covariance say so. ``reject``: which joints are REJECTED because no two views explain
    them; null: none. ``flips``: how exchanged sides are looked for and undone; null: they are not.
    """

    def __init__(
        self,
        estimator: Estimator,
        uncertainty: UncertaintyModel,
        flips: LeftRightFlips | None,
        reject: Rejection | None,
    ) -> None:
        self.estimator = estimator
        self.uncertainty = uncertainty
        self.flips = flips
        self.reject = reject

    def fitted(self, batch: Observations) -> Classical:
        clean, _, _, result = _prepared(batch, self.flips, self.estimator)
        views, _ = self.estimator.inlier_views(clean, result.points, result.has_position)
        uncertainty = self.uncertainty.fitted(clean, result.points, views)
        reject = self.reject and self.reject.fitted(clean, result.points, result.has_position)
        return Classical(self.estimator, uncertainty, self.flips, reject)

    def rejecting_nothing(self) -> Classical:
        """The same, with all its joints: what it is compared with others by."""
        return Classical(self.estimator, self.uncertainty, self.flips, None)

    @torch.no_grad()
    def __call__(self, batch: Observations) -> Reconstruction:
        clean, spoilt, flipped, result = _prepared(batch, self.flips, self.estimator)
        state = _states(result.status, spoilt)
        state = _rejected(self.reject, clean, result.points, state)
        views, _ = self.estimator.inlier_views(clean, result.points, state == State.OBSERVED)
        found = self.uncertainty(clean, result.points, views)
        score = torch.zeros(len(batch), dtype=torch.float32)
        return _reconstruction(batch, result.points, state, views, found, score, flipped)


class Learned:
    """A trained model's view weights with what can be said of their joints.

    The views that made a joint are those on which the consensus of ``view_weights`` agrees, and
    error and covariance are theirs. The score is the mean logit of the hypotheses under their
    weights, before ``cap_logit_std``, which centres each frame's. ``flips`` and ``reject`` as in
    Classical.
    """

    def __init__(
        self,
        view_weights: ViewWeights,
        uncertainty: UncertaintyModel,
        flips: LeftRightFlips | None,
        reject: Rejection | None,
    ) -> None:
        self.view_weights = view_weights
        self.uncertainty = uncertainty
        self.flips = flips
        self.reject = reject

    def fitted(self, batch: Observations) -> Learned:
        clean, _, _, robust = _prepared(batch, self.flips, self.view_weights.consensus)
        weighed = self.view_weights.weigh(clean, robust)
        found = weighed.triangulation
        uncertainty = self.uncertainty.fitted(clean, found.points, weighed.views)
        reject = self.reject and self.reject.fitted(clean, found.points, found.has_position)
        return Learned(self.view_weights, uncertainty, self.flips, reject)

    def rejecting_nothing(self) -> Learned:
        """The same, with all its joints: what it is compared with others by."""
        return Learned(self.view_weights, self.uncertainty, self.flips, None)

    @torch.no_grad()
    def __call__(self, batch: Observations) -> Reconstruction:
        clean, spoilt, flipped, robust = _prepared(batch, self.flips, self.view_weights.consensus)
        weighed = self.view_weights.weigh(clean, robust)
        points = weighed.triangulation.points
        state = _states(weighed.triangulation.status, spoilt)
        state = _rejected(self.reject, clean, points, state)
        views = weighed.views & (state == State.OBSERVED)[:, None]
        found = self.uncertainty(clean, points, views)
        pool = weighed.pool
        score = (pool.weights() * pool.logits).sum(-1)
        return _reconstruction(batch, points, state, views, found, score, flipped)


def _prepared(
    batch: Observations, flips: LeftRightFlips | None, estimator: Estimator
) -> tuple[Observations, Bool[Tensor, "B V J"], Bool[Tensor, "B V"], Triangulation]:
    """The batch to triangulate, what was taken out of it, in which views left and right were
    exchanged, and what ``estimator`` makes of the batch. It does so once where it is the one that
    looks for swaps.
    """
    clean, spoilt = cleaned(batch)
    result = estimator.triangulate(clean)
    if flips is None:
        return clean, spoilt, torch.zeros_like(batch.valid[..., 0]), result
    clean, flipped = undo_flips(
        clean, flips, poses_of(result, clean) if estimator == flips.estimator else None
    )
    rows = torch.nonzero(flipped.any(-1))[:, 0]
    if len(rows):
        result = result.with_rows(rows, estimator.triangulate(clean.rows(rows)))
    return clean, spoilt, flipped, result


def cleaned(batch: Observations) -> tuple[Observations, Bool[Tensor, "B V J"]]:
    """The batch without key points that no detection can be, and which those were: not finite, of a
    camera that is none, or ``FAR`` from all others of its view.
    """
    usable = batch.valid & valid_key_points(batch.cameras, batch.key_points)
    points = torch.where(usable[..., None], batch.key_points, torch.nan)
    offset = (points - points.nanmedian(-2, keepdim=True).values).abs().amax(-1)
    typical = offset.nanmedian(-1, keepdim=True).values.clamp(min=1.0)
    few = usable.sum(-1, keepdim=True) < 5
    valid = usable & (few | ~(offset > FAR * typical))
    return replace(
        batch, valid=valid, key_points=torch.where(valid[..., None], batch.key_points, 0.0)
    ), batch.valid & ~valid


def _states(status: Int8[Tensor, "B J"], spoilt: Bool[Tensor, "B V J"]) -> Int8[Tensor, "B J"]:
    """The states of a reconstruction: a point that has not converged is observed, and a joint that
    lacks views because some of its key points are ``spoilt`` has bad input.
    """
    state = torch.where(status == State.NOT_CONVERGED, int(State.OBSERVED), status)
    bad = (state == State.FEW_VIEWS) & spoilt.any(1)
    return torch.where(bad, int(State.BAD_INPUT), state).to(torch.int8)


def _rejected(
    reject: Rejection | None,
    batch: Observations,
    points: Float[Tensor, "B J 3"],
    state: Int8[Tensor, "B J"],
) -> Int8[Tensor, "B J"]:
    """The states, REJECTED where a joint has a position that no two views explain."""
    if reject is None:
        return state
    placed = state == State.OBSERVED
    unexplained = placed & ~reject.explained(batch, points, placed)
    return torch.where(unexplained, int(State.REJECTED), state).to(torch.int8)


def _reconstruction(
    batch: Observations,
    points: Float[Tensor, "B J 3"],
    state: Int8[Tensor, "B J"],
    views: Bool[Tensor, "B V J"],
    found: JointUncertainty,
    score: Float[Tensor, " B"],
    flipped: Bool[Tensor, "B V"],
) -> Reconstruction:
    placed = state == State.OBSERVED
    points = torch.where(placed[..., None], points, 0.0).double()
    error = found.error.float()
    covariance = found.covariance.float()
    fields = (batch.index, points, state, error, views, covariance, score.float(), flipped)
    return Reconstruction(*(x.cpu() for x in fields))
