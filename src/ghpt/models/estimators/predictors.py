"""From observations to a reconstruction, by a classical estimator or by the learned model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from ghpt.geometry.normal_equations import valid_key_points
from ghpt.geometry.triangulation import Triangulation
from ghpt.models.estimators.classical import Estimator, as_poses
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.estimators.pool_average import AveragedPool, PoolAverage
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.uncertainty import JointUncertainty, UncertaintyModel
from ghpt.observations import Observations, PoseEstimate
from ghpt.reconstruction import Reconstruction, State, concatenate, move_to_cpu
from ghpt.skeleton import HUMAN36M, JOINT, JOINTS, Skeleton

FAR = 20.0
"""Reject a key point whose distance from the view's median exceeds this multiple of the median
distance.
"""
_FEW = 5
"""Key points in a view of whose distances the median says nothing."""


class FrameSource(Protocol):
    """What is predicted: frames that are read as they are asked for."""

    @property
    def frame(self) -> Int[np.ndarray, " T"]:
        """The recording's own numbers, rising."""

    @property
    def rate_hz(self) -> float | None: ...

    def read(self, rows: Int[np.ndarray, " N"]) -> Observations:
        """Return the observations of some frames; ``index`` is a frame's own number."""


Advance = Callable[[int], None]
"""Is told of so many more frames that are done."""
Estimate = Callable[[Observations], PoseEstimate]


class Predictor(Protocol):
    """What `predict` runs. A frame's result does not depend on the rows that are asked for."""

    def for_skeleton(self, skeleton: Skeleton) -> Predictor:
        """Return the same for batches whose key points are this skeleton's, not the 17 joints."""

    def fit(self, source: FrameSource, frames: int) -> Predictor:
        """Return the same with what about so many frames of the recording tell of it."""

    def predict(
        self,
        source: FrameSource,
        rows: Int[np.ndarray, " N"],
        batch: int,
        device: torch.device,
        advance: Advance,
    ) -> Reconstruction:
        """Return these frames, with ``frame`` = ``index``; on the CPU.

        At most ``batch`` frames are worked on at a time, where frames are independent.
        """

    def estimate(self, batch: Observations) -> PoseEstimate:
        """Return what is compared with other estimators: nothing is rejected.

        The frames are successive ones.
        """


def spread(frames: int, most: int) -> Int[np.ndarray, " N"]:
    """Return at most ``most`` of the rows of a recording, evenly spread."""
    return np.unique(np.linspace(0, frames - 1, min(most, frames)).astype(np.int64))


class FramePredictor(ABC):
    """A predictor whose frames are independent of each other."""

    @abstractmethod
    def fit_to(self, batch: Observations) -> Self:
        """Return the same with the noise of these frames: a few hundred of a recording."""

    @abstractmethod
    def rejecting_nothing(self) -> Self:
        """Return the same with all its joints: what it is compared with others by."""

    @abstractmethod
    def __call__(self, batch: Observations) -> Reconstruction:
        """Return the batch's frames, with ``frame`` = ``batch.index``; on the CPU."""

    def fit(self, source: FrameSource, frames: int) -> Self:
        return self.fit_to(source.read(spread(len(source.frame), frames)))

    def predict(
        self,
        source: FrameSource,
        rows: Int[np.ndarray, " N"],
        batch: int,
        device: torch.device,
        advance: Advance,
    ) -> Reconstruction:
        parts = []
        for start in range(0, len(rows), batch):
            observations = source.read(rows[start : start + batch]).to(device)
            parts.append(move_to_cpu(self(observations)))
            advance(len(observations))
        return concatenate(parts)

    def estimate(self, batch: Observations) -> PoseEstimate:
        found = self.rejecting_nothing()(batch)
        return PoseEstimate(found.points, found.state == State.OBSERVED)


class Classical(FramePredictor):
    """A classical estimator with what it can say of its joints.

    A view counts as one of those that made a joint if its residual is within the estimator's
    ``inlier_threshold``; where fewer than two views are, all that were given to it count, and the
    error and covariance say so. ``reject``: which joints are REJECTED because no two views explain
    them; null: none. ``flips``: how left-right flips are looked for and undone; null: they are not.
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

    def for_skeleton(self, skeleton: Skeleton) -> Classical:
        """Return the same for batches of another skeleton than the 17 joints'."""
        flips = self.flips and self.flips.for_skeleton(skeleton)
        estimator = self.estimator.for_skeleton(skeleton)
        return Classical(estimator, self.uncertainty, flips, self.reject)

    def fit_to(self, batch: Observations) -> Classical:
        clean = prepare(batch, self.flips, self.estimator).batch
        estimator = self.estimator.fit_to(clean)
        result = estimator.triangulate(clean)
        views, _ = estimator.inlier_views(clean, result.points, result.has_position)
        uncertainty = self.uncertainty.fit_to(clean, result.points, views)
        reject = self.reject and self.reject.fit_to(clean, result.points, result.has_position)
        flips = self.flips
        if flips is not None and flips.estimator == self.estimator:
            flips = replace(flips, estimator=estimator)
        return Classical(estimator, uncertainty, flips, reject)

    def rejecting_nothing(self) -> Classical:
        """Return the same with all its joints: what it is compared with others by."""
        return Classical(self.estimator, self.uncertainty, self.flips, None)

    @torch.no_grad()
    def __call__(self, batch: Observations) -> Reconstruction:
        prepared = prepare(batch, self.flips, self.estimator)
        clean = prepared.batch
        points = prepared.triangulation.points
        state = final_states(prepared, prepared.triangulation, self.reject)
        views, _ = self.estimator.inlier_views(clean, points, state == State.OBSERVED)
        return reconstruct(
            points=points,
            state=state,
            views=views,
            uncertainty=self.uncertainty(clean, points, views),
            score=torch.zeros(len(batch), dtype=torch.float32),
            prepared=prepared,
        )


class Learned(FramePredictor):
    """A trained model's average pose with what can be said of its joints.

    The model sees the 17 joints, which are means of the ``skeleton``'s key points in the images.
    Those of them that are key points themselves are its own; all other key points are what the
    consensus of ``average`` makes of them.

    The views that made a joint are those on which the consensus agrees, and error and covariance
    are theirs. The score is the mean logit of the hypotheses under their
    weights, before ``cap_logit_std``, which centres each frame's. ``flips`` and ``reject`` as in
    Classical.
    """

    def __init__(
        self,
        average: PoolAverage,
        uncertainty: UncertaintyModel,
        flips: LeftRightFlips | None,
        reject: Rejection | None,
        skeleton: Skeleton = HUMAN36M,
    ) -> None:
        self.average = average
        self.uncertainty = uncertainty
        self.flips = flips
        self.reject = reject
        self.skeleton = skeleton

    def for_skeleton(self, skeleton: Skeleton) -> Learned:
        """Return the same for batches of another skeleton, which has joints of the 17."""
        flips = self.flips and self.flips.for_skeleton(skeleton)
        return Learned(self.average, self.uncertainty, flips, self.reject, skeleton)

    def fit_to(self, batch: Observations) -> Learned:
        prepared = prepare(batch, self.flips, self.average.consensus)
        clean = prepared.batch
        averaged = self._average(prepared)
        result = averaged.triangulation
        uncertainty = self.uncertainty.fit_to(clean, result.points, averaged.views)
        reject = self.reject and self.reject.fit_to(clean, result.points, result.has_position)
        return Learned(self.average, uncertainty, self.flips, reject, self.skeleton)

    def rejecting_nothing(self) -> Learned:
        """Return the same with all its joints: what it is compared with others by."""
        return Learned(self.average, self.uncertainty, self.flips, None, self.skeleton)

    def _average(self, prepared: Prepared) -> AveragedPool:
        """Return the key points, those of the 17 joints among them by the model."""
        clean = prepared.batch
        if self.skeleton == HUMAN36M:
            return self.average.estimate(clean, prepared.triangulation)
        consensus = prepared.triangulation
        views, _ = self.average.consensus.inlier_views(
            clean, consensus.points, consensus.has_position
        )
        averaged = self.average.estimate(observe_joints(clean, self.skeleton))
        direct = [name for name in JOINTS if name in self.skeleton.key_points]
        device = views.device
        joints = torch.tensor([JOINT[name] for name in direct], device=device)
        own = [self.skeleton.key_points.index(name) for name in direct]
        key_points = torch.tensor(own, device=device)
        learned = averaged.triangulation.joints(joints)
        return AveragedPool(
            triangulation=consensus.with_joints(key_points, learned),
            views=views.index_copy(2, key_points, averaged.views.index_select(2, joints)),
            pool=averaged.pool,
        )

    @torch.no_grad()
    def __call__(self, batch: Observations) -> Reconstruction:
        prepared = prepare(batch, self.flips, self.average.consensus)
        averaged = self._average(prepared)
        points = averaged.triangulation.points
        state = final_states(prepared, averaged.triangulation, self.reject)
        views = averaged.views & (state == State.OBSERVED)[:, None]
        pool = averaged.pool
        score = (pool.weights() * pool.logits).sum(-1)
        return reconstruct(
            points=points,
            state=state,
            views=views,
            uncertainty=self.uncertainty(prepared.batch, points, views),
            score=score,
            prepared=prepared,
        )


@dataclass(frozen=True)
class Prepared:
    """Observations without what no detection can be, and with left-right flips undone."""

    batch: Observations
    rejected: Bool[Tensor, "B V J"]
    """The key points that were taken out."""
    flipped: Bool[Tensor, "B V"]
    """The views in which left and right were exchanged."""
    triangulation: Triangulation
    """What the estimator makes of the batch."""


def prepare(batch: Observations, flips: LeftRightFlips | None, estimator: Estimator) -> Prepared:
    """Prepare a batch and triangulate it, once where the estimator also looks for the flips."""
    clean, rejected = remove_outliers(batch)
    result = estimator.triangulate(clean)
    if flips is None:
        return Prepared(clean, rejected, torch.zeros_like(batch.valid[..., 0]), result)
    known = as_poses(result, clean) if estimator == flips.estimator else None
    clean, flipped = undo_flips(clean, flips, known)
    rows = torch.nonzero(flipped.any(-1))[:, 0]
    if len(rows):
        result = result.with_rows(rows, estimator.triangulate(clean.rows(rows)))
    return Prepared(clean, rejected, flipped, result)


def observe_joints(batch: Observations, skeleton: Skeleton) -> Observations:
    """Return the 17 joints, as means in the images of the key points of a batch.

    A joint is valid where all of its parts are, and has the least of their confidences.
    """
    weights = torch.from_numpy(skeleton.joint_weights).to(batch.key_points)
    is_part = weights > 0
    absent = (~batch.valid).to(weights) @ is_part.to(weights).mT
    valid = (absent == 0) & is_part.any(-1)
    parts = torch.where(is_part, batch.confidence[..., None, :], 1.0)
    return replace(
        batch,
        key_points=torch.where(valid[..., None], weights @ batch.key_points, 0.0),
        confidence=torch.where(valid, parts.amin(-1), 0.0),
        valid=valid,
    )


def remove_outliers(batch: Observations) -> tuple[Observations, Bool[Tensor, "B V J"]]:
    """Return the batch without key points that no detection can be, and which those were.

    They are not finite, of a camera that is none, or ``FAR`` from all others of their view.
    """
    finite = batch.valid & valid_key_points(batch.cameras, batch.key_points)
    points = torch.where(finite[..., None], batch.key_points, torch.nan)
    median = points.nanmedian(-2, keepdim=True).values
    offset = (points - median).abs().amax(-1)
    typical = offset.nanmedian(-1, keepdim=True).values.clamp(min=1.0)
    few = finite.sum(-1, keepdim=True) < _FEW
    valid = finite & (few | ~(offset > FAR * typical))
    key_points = torch.where(valid[..., None], batch.key_points, 0.0)
    return replace(batch, valid=valid, key_points=key_points), batch.valid & ~valid


def final_states(
    prepared: Prepared, result: Triangulation, reject: Rejection | None
) -> Int8[Tensor, "B J"]:
    """Return the states of a reconstruction.

    1. A point that has not converged is observed.
    2. A joint that lacks views because some of its key points were taken out has bad input.
    3. A joint that no two views explain is rejected.
    """
    state = torch.where(result.status == State.NOT_CONVERGED, int(State.OBSERVED), result.status)
    bad = (state == State.FEW_VIEWS) & prepared.rejected.any(1)
    state = torch.where(bad, int(State.BAD_INPUT), state)
    if reject is not None:
        observed = state == State.OBSERVED
        explained = reject.find_explained(prepared.batch, result.points, observed)
        state = torch.where(observed & ~explained, int(State.REJECTED), state)
    return state.to(torch.int8)


def reconstruct(
    points: Float[Tensor, "B J 3"],
    state: Int8[Tensor, "B J"],
    views: Bool[Tensor, "B V J"],
    uncertainty: JointUncertainty,
    score: Float[Tensor, " B"],
    prepared: Prepared,
) -> Reconstruction:
    observed = state == State.OBSERVED
    return Reconstruction(
        frame=prepared.batch.index.cpu(),
        points=torch.where(observed[..., None], points, 0.0).double().cpu(),
        state=state.cpu(),
        error=uncertainty.error.float().cpu(),
        views=views.cpu(),
        covariance=uncertainty.covariance.float().cpu(),
        score=score.float().cpu(),
        flipped=prepared.flipped.cpu(),
    )
