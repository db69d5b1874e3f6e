"""A person's trajectory from observations in the order of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.trajectory.rows import ReprojectionRows
from ghpt.models.estimators.trajectory.solver import Body, Frames, TrajectorySolver
from ghpt.models.estimators.trajectory.uncertainty import covariances
from ghpt.models.estimators.trajectory.windows import Clock, dense
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, Skeleton

_LEAST_CONFIDENCE = 1e-3
"""Less confidence than this is no less."""


@dataclass(frozen=True)
class TrajectoryPart:
    """The trajectory of N frames, as they were given."""

    points: Float[Tensor, "N J 3"]
    """World, mm, float64."""
    covariance: Float[Tensor, "N J 6"]
    """xx xy xz yy yz zz, mm^2; 0 where it was not asked for."""
    views: Bool[Tensor, "N V J"]
    """The views that agree with the point."""
    flipped: Bool[Tensor, "N V"]
    """The views in which left and right of a limb are exchanged."""
    exchanged: Observations
    """The observations with these put right."""


@dataclass(frozen=True)
class Trajectory:
    """Estimates all frames of a piece of recording together.

    ``start`` gives each frame's first estimate. A key point weighs its confidence to the power
    ``confidence``. A view agrees with a point if its residual is at most ``agree`` deviations of
    its joint's key points; one view alone supports a joint that two views observe within
    ``reach_s``. Frames farther apart than ``longest_gap_s`` have nothing to do with
    each other. ``inflation``: of the variances, for what is common to successive frames and no
    residual of a single frame tells (`calibrated`).
    """

    start: Estimator
    solver: TrajectorySolver
    confidence: float
    agree: float
    reach_s: float
    longest_gap_s: float
    inflation: float
    skeleton: Skeleton = HUMAN36M
    rate_hz: float | None = None
    body: Body | None = None
    """What the recording says of its person; None: each batch tells."""

    def __post_init__(self) -> None:
        check_positive(agree=self.agree, longest_gap_s=self.longest_gap_s)
        check_positive(reach_s=self.reach_s, inflation=self.inflation)
        check(self.confidence >= 0, "confidence", f"is {self.confidence}", "It must be >= 0.")

    @torch.no_grad()
    def __call__(self, batch: Observations) -> PoseEstimate:
        """Return the poses of frames in the order of time, of one recording or of several.

        A joint is estimated where it is observed or supported.
        """
        pieces = []
        for rows in _recordings(batch):
            part = batch.rows(rows)
            found = self.solve(part, self.start(part))
            count = found.views.sum(1)
            observed = count >= 2
            supported = (count == 1) & self.within_reach(part, observed)
            points = found.points.to(part.key_points.dtype)
            pieces.append(PoseEstimate(points, observed | supported))
        points = torch.cat([piece.points for piece in pieces])
        return PoseEstimate(points, torch.cat([piece.estimated for piece in pieces]))

    def fitted(self, batch: Observations) -> Trajectory:
        """Return the same with the body, and the inflation, that these frames show.

        They are of one recording, in the order of time; there may be gaps between them.
        """
        frames, _ = self._frames(batch, self.start(batch))
        body = self.solver(frames, self.skeleton).body
        return replace(self, body=body)

    def solve(
        self, batch: Observations, first: PoseEstimate, with_covariance: bool = False
    ) -> TrajectoryPart:
        """Return the trajectory of frames of one recording in the order of time."""
        frames, place = self._frames(batch, first)
        solution = self.solver(frames, self.skeleton, self.body)
        at = torch.from_numpy(place)
        origin = frames.rows.origin
        covariance = solution.points.new_zeros(len(batch), solution.points.shape[1], 6)
        if with_covariance:
            every = self.inflation * covariances(solution)
            covariance = every[..., at].permute(2, 1, 0)
        limit = self.agree * solution.body.scale[:, None]
        agrees = solution.used & (solution.residual <= limit)
        order = solution.order[..., at].permute(2, 0, 1)
        return TrajectoryPart(
            points=solution.points[..., at].permute(2, 1, 0) + origin,
            covariance=covariance,
            views=agrees[..., at].permute(2, 0, 1),
            flipped=(order != torch.arange(order.shape[-1])).any(-1),
            exchanged=_exchange(batch, order),
        )

    def _frames(self, batch: Observations, first: PoseEstimate) -> tuple[Frames, np.ndarray]:
        """Return the frames on an axis without gaps, and the place of each given one on it."""
        numbers = batch.index.numpy()
        clock = Clock.of_frames(numbers, self.rate_hz, self.longest_gap_s)
        place, axis = clock.axis(numbers)
        length = len(axis.joined)
        rows = ReprojectionRows.from_observations(_dense_observations(batch, place, length))
        confidence = batch.confidence.double().clamp(min=_LEAST_CONFIDENCE)
        placed = first.estimated & first.points.isfinite().all(-1)
        local = torch.where(placed[..., None], first.points.double() - rows.origin, 0.0)
        return Frames(
            rows=rows,
            weight=_last(dense(confidence**self.confidence, place, length)),
            start=_last(dense(local, place, length)).transpose(0, 1).contiguous(),
            placed=_last(dense(placed, place, length)),
            axis=axis,
        ), place

    def within_reach(self, batch: Observations, known: Bool[Tensor, "N J"]) -> Bool[Tensor, "N J"]:
        """Return which joints are known in a frame at most ``reach_s`` away."""
        clock = Clock.of_frames(batch.index.numpy(), self.rate_hz, self.longest_gap_s)
        reach = round(self.reach_s * clock.rate_hz) * clock.step
        number = batch.index[:, None].double()
        before = torch.where(known, number, -torch.inf).cummax(0).values
        after = torch.where(known, -number, -torch.inf).flip(0).cummax(0).values.flip(0)
        return (number - before <= reach) | (-after - number <= reach)


def _recordings(batch: Observations) -> list[Int[Tensor, " n"]]:
    """Return the rows of each recording of a batch."""
    return [torch.nonzero(batch.recording == one)[:, 0] for one in batch.recording.unique()]


def _last(values: Tensor) -> Tensor:
    """Return values [T ...] with the frames as the last dimension."""
    return values.movedim(0, -1).contiguous()


def _dense_observations(batch: Observations, place: np.ndarray, length: int) -> Observations:
    """Return the observations on an axis of ``length`` frames; nothing is seen in new ones."""
    if len(batch) == length:
        return batch
    nearest = torch.from_numpy(np.searchsorted(place, np.arange(length), side="right") - 1)
    return Observations(
        index=batch.index[nearest],
        recording=batch.recording[nearest],
        cameras=batch.cameras.index(nearest),
        key_points=dense(batch.key_points, place, length),
        confidence=dense(batch.confidence, place, length),
        valid=dense(batch.valid, place, length),
    )


def _exchange(batch: Observations, order: Int[Tensor, "N V J"]) -> Observations:
    """Return the observations in which each joint has the key point of another one."""
    coordinates = order[..., None].expand(-1, -1, -1, 2)
    return replace(
        batch,
        key_points=batch.key_points.gather(2, coordinates),
        confidence=batch.confidence.gather(2, order),
        valid=batch.valid.gather(2, order),
    )
