"""A person's trajectory from observations in the order of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.models.estimators.classical import Estimator, person_scale
from ghpt.models.estimators.confidence import confidence_exponent, confidence_weights
from ghpt.models.estimators.trajectory.disjoint import (
    HALF_INFLATION,
    LEAST_VIEWS,
    DisjointTest,
    halves,
    observed_by_two,
    square_distances,
)
from ghpt.models.estimators.trajectory.rows import ReprojectionRows
from ghpt.models.estimators.trajectory.solver import Body, Frames, TrajectorySolver
from ghpt.models.estimators.trajectory.uncertainty import covariances
from ghpt.models.estimators.trajectory.windows import Clock, dense
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import HUMAN36M, Skeleton

_ADULT = 1800.0
"""mm: the diagonal of the box around an adult."""
_PERSON = (0.25, 2.0)
"""Sizes that a person may have, who sits or is a child."""
_LEAST_PLACED = 5
"""Joints of a frame, of which fewer tell no size."""
LEAST_EXPONENT = 0.0
"""Of the confidences: any that is surely positive counts, since many frames are averaged."""


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

    ``start`` gives each frame's first estimate. A key point weighs its confidence to a power that
    is measured (`confidence_exponent`), at most ``largest_exponent``. A view agrees with a point if
    its residual is at most ``agree`` deviations of its joint's key points; one view alone supports
    a joint that two views observe within ``reach_s``. Frames farther apart than ``longest_gap_s``
    have nothing to do with each other. ``inflation``: of the variances, for what is common to
    successive frames and no residual of a single frame tells, with four views; with fewer it is
    inversely proportional to their number, with more it is measured (`DisjointTest`).
    """

    start: Estimator
    solver: TrajectorySolver
    largest_exponent: float
    agree: float
    reach_s: float
    longest_gap_s: float
    inflation: float
    skeleton: Skeleton = HUMAN36M
    clock: Clock | None = None
    """Of the recording; None: each batch tells, at the nominal rate."""
    body: Body | None = None
    """What the recording says of its person; None: each batch tells."""
    exponent: float = 0.0
    """Of the confidences."""
    size: float = 1.0
    """Of the body, in that of an adult: lengths in the settings are those of an adult. 1 for every
    person; animals, and cameras of a wrong unit, have another.
    """

    def __post_init__(self) -> None:
        check_positive(agree=self.agree, longest_gap_s=self.longest_gap_s)
        check_positive(reach_s=self.reach_s, inflation=self.inflation)
        power = self.largest_exponent
        check(power >= 0, "largest_exponent", f"is {power}", "It must be >= 0.")

    @torch.no_grad()
    def __call__(self, batch: Observations) -> PoseEstimate:
        """Return the poses of frames in the order of time, of one recording or of several.

        A joint is estimated where it is observed or supported.
        """
        return self._estimate(batch, least_views=1)

    @torch.no_grad()
    def complete(self, batch: Observations) -> PoseEstimate:
        """Return the same with joints that no view sees, near frames in which they are observed."""
        return self._estimate(batch, least_views=0)

    def _estimate(self, batch: Observations, least_views: int) -> PoseEstimate:
        pieces = []
        for rows in _recordings(batch):
            part = batch.rows(rows)
            found = self.solve(part, self.start(part))
            agreeing = found.views.sum(1)
            observed = agreeing >= 2
            carried = (agreeing >= least_views) & self.within_reach(part, observed)
            points = found.points.to(part.key_points.dtype)
            pieces.append(PoseEstimate(points, observed | carried))
        points = torch.cat([piece.points for piece in pieces])
        return PoseEstimate(points, torch.cat([piece.estimated for piece in pieces]))

    def at_rate(self, batch: Observations, rate_hz: float | None) -> Trajectory:
        """Return the same for a recording with these frames, so many in a second."""
        clock = Clock.of_frames(batch.index.numpy(), rate_hz, self.longest_gap_s)
        return replace(self, clock=clock)

    def fit_to(self, batch: Observations) -> Trajectory:
        """Return the same with the body that these frames show, and the worth of confidences.

        They are of one recording, in the order of time; there may be gaps between them.
        """
        first = self.start(batch)
        size = body_size(first)
        if size != self.size:
            return replace(self, size=size).fit_to(batch)
        plain = replace(self, exponent=0.0)
        found = plain.solve(batch, first)
        exchanged = found.exchanged
        error = reprojection_error(batch.cameras, exchanged.key_points, found.points)
        relative = error / person_scale(batch.key_points, batch.valid)[..., None]
        exponent = confidence_exponent(
            relative, exchanged.confidence, exchanged.valid, LEAST_EXPONENT
        )
        weighted = replace(self, exponent=min(exponent, self.largest_exponent))
        frames, _ = weighted._frames(_resize(batch, 1 / size), _resize_poses(first, 1 / size))
        return replace(weighted, body=self.solver(frames, self.skeleton).body)

    def calibrate(self, batch: Observations) -> Trajectory:
        """Return the same with the inflation of the covariances that these frames show."""
        views = int(batch.valid.any(-1).any(0).sum())
        prior = replace(self, inflation=self.inflation * LEAST_VIEWS / max(views, 2))
        test = prior.test_halves(batch)
        if not test.is_decidable:
            return prior
        return replace(prior, inflation=prior.inflation * test.inflation())

    def test_halves(self, batch: Observations) -> DisjointTest:
        """Return how far the trajectories of two halves of the views are from each other.

        There is nothing in it where fewer than four views leave no two halves.
        """
        squares = [batch.key_points.new_zeros(0, dtype=torch.float64)]
        half = replace(self, inflation=self.inflation * HALF_INFLATION)
        if batch.valid.shape[1] >= LEAST_VIEWS:
            for one, other in halves(batch):
                a = half.solve(one, self.start(one), with_covariance=True)
                b = half.solve(other, self.start(other), with_covariance=True)
                both = observed_by_two(a.views) & observed_by_two(b.views)
                difference = (a.points - b.points)[both]
                squares.append(square_distances(difference, (a.covariance + b.covariance)[both]))
        return DisjointTest(torch.cat(squares))

    def solve(
        self, batch: Observations, first: PoseEstimate, with_covariance: bool = False
    ) -> TrajectoryPart:
        """Return the trajectory of frames of one recording in the order of time."""
        size = self.size
        frames, place = self._frames(_resize(batch, 1 / size), _resize_poses(first, 1 / size))
        solution = self.solver(frames, self.skeleton, self.body)
        at = torch.from_numpy(place)
        origin = frames.rows.origin
        covariance = solution.points.new_zeros(len(batch), solution.points.shape[1], 6)
        if with_covariance:
            every = size**2 * covariances(solution, self.inflation)
            covariance = every[..., at].permute(2, 1, 0)
        limit = self.agree * solution.body.scale[:, None]
        agrees = solution.used & (solution.residual <= limit)
        order = solution.order[..., at].permute(2, 0, 1)
        return TrajectoryPart(
            points=size * (solution.points[..., at].permute(2, 1, 0) + origin),
            covariance=covariance,
            views=agrees[..., at].permute(2, 0, 1),
            flipped=(order != torch.arange(order.shape[-1])).any(-1),
            exchanged=_exchange(batch, order),
        )

    def _clock(self, batch: Observations) -> Clock:
        if self.clock is not None:
            return self.clock
        return Clock.of_frames(batch.index.numpy(), None, self.longest_gap_s)

    def _frames(self, batch: Observations, first: PoseEstimate) -> tuple[Frames, np.ndarray]:
        """Return the frames on an axis without gaps, and the place of each given one on it."""
        numbers = batch.index.numpy()
        clock = self._clock(batch)
        place, axis = clock.axis(numbers)
        length = len(axis.joined)
        rows = ReprojectionRows.from_observations(_dense_observations(batch, place, length))
        weight = confidence_weights(batch.confidence, self.exponent)
        placed = first.estimated & first.points.isfinite().all(-1)
        local = torch.where(placed[..., None], first.points.double() - rows.origin, 0.0)
        return Frames(
            rows=rows,
            weight=_last(dense(weight, place, length)),
            start=_last(dense(local, place, length)).transpose(0, 1).contiguous(),
            placed=_last(dense(placed, place, length)),
            axis=axis,
        ), place

    def within_reach(self, batch: Observations, known: Bool[Tensor, "N J"]) -> Bool[Tensor, "N J"]:
        """Return which joints are known in a frame at most ``reach_s`` away."""
        clock = self._clock(batch)
        reach = round(self.reach_s * clock.rate_hz) * clock.step
        number = batch.index[:, None].double()
        before = torch.where(known, number, -torch.inf).cummax(0).values
        after = torch.where(known, -number, -torch.inf).flip(0).cummax(0).values.flip(0)
        return (number - before <= reach) | (-after - number <= reach)


def body_size(first: PoseEstimate) -> float:
    """Return the size of the body in that of an adult; 1 where it may be a person's."""
    placed = (first.estimated & first.points.isfinite().all(-1))[..., None]
    largest = torch.where(placed, first.points.double(), -torch.inf).amax(1)
    smallest = torch.where(placed, first.points.double(), torch.inf).amin(1)
    extent = (largest - smallest).norm(dim=-1)
    known = extent[(placed.sum(1)[:, 0] >= _LEAST_PLACED) & (extent > 0)]
    if not len(known):
        return 1.0
    size = float(known.median()) / _ADULT
    least, most = _PERSON
    return 1.0 if least < size < most else size


def _resize(batch: Observations, factor: float) -> Observations:
    """Return what the cameras of a world so many times as large see."""
    if factor == 1:
        return batch
    cameras = batch.cameras
    return replace(batch, cameras=Cameras(cameras.K, cameras.R, cameras.t * factor))


def _resize_poses(poses: PoseEstimate, factor: float) -> PoseEstimate:
    return poses if factor == 1 else PoseEstimate(poses.points * factor, poses.estimated)


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
