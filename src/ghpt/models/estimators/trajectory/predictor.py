"""A recording's reconstruction by trajectories: window by window, with states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int, Int8
from torch import Tensor

from ghpt.geometry.cameras import reprojection_error
from ghpt.geometry.state import State
from ghpt.models.estimators.classical import as_poses
from ghpt.models.estimators.predictors import (
    Advance,
    FrameSource,
    Prepared,
    final_states,
    prepare,
)
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.trajectory.estimator import Trajectory, TrajectoryPart
from ghpt.models.estimators.trajectory.windows import Clock, Window, Windows, spread_runs
from ghpt.observations import Observations, PoseEstimate
from ghpt.reconstruction import Reconstruction, concatenate, select_frames
from ghpt.skeleton import Skeleton


@dataclass(frozen=True)
class TrajectoryPredictor:
    """Estimates all frames of a recording together, in windows.

    A frame's result depends on the frames of its window alone, and on what ``fit`` learns of the
    whole recording. ``reject``: which joints are REJECTED because too few views explain them; null:
    none.
    """

    trajectory: Trajectory
    windows: Windows
    reject: Rejection | None

    def for_skeleton(self, skeleton: Skeleton) -> TrajectoryPredictor:
        return replace(self, trajectory=replace(self.trajectory, skeleton=skeleton))

    def fit(self, source: FrameSource, frames: int) -> TrajectoryPredictor:
        batch = source.read(spread_runs(len(source.frame), frames))
        clean = prepare(batch, None, self.trajectory.start).batch
        clock = self._clock(source)
        start = self.trajectory.start.fit_to(clean)
        trajectory = replace(self.trajectory, start=start, clock=clock).fit_to(clean)
        trajectory = trajectory.calibrate(clean)
        reject = self.reject
        if reject is not None:
            first = start.triangulate(clean)
            reject = reject.fit_to(clean, first.points, first.has_position)
        return replace(self, trajectory=trajectory, reject=reject)

    @torch.no_grad()
    def predict(
        self,
        source: FrameSource,
        rows: Int[np.ndarray, " N"],
        batch: int,
        device: torch.device,
        advance: Advance,
    ) -> Reconstruction:
        parts = []
        for window in self.windows.covering(source.frame, rows, self._clock(source)):
            wanted = window.core & np.isin(window.rows, rows)
            part = self._window(source, window)
            parts.append(select_frames(part, torch.from_numpy(np.flatnonzero(wanted))))
            advance(int(wanted.sum()))
        return concatenate(parts)

    def estimate(self, batch: Observations) -> PoseEstimate:
        return self.trajectory(batch)

    def _clock(self, source: FrameSource) -> Clock:
        return Clock.of_frames(source.frame, source.rate_hz, self.trajectory.longest_gap_s)

    def _window(self, source: FrameSource, window: Window) -> Reconstruction:
        """Return the reconstruction of a whole window."""
        trajectory = self.trajectory
        prepared = prepare(source.read(window.rows), None, trajectory.start)
        first = as_poses(prepared.triangulation, prepared.batch)
        found = trajectory.solve(prepared.batch, first, with_covariance=True)
        state = self._states(prepared, found)
        placed = (state == State.OBSERVED) | (state == State.SUPPORTED)
        views = found.views & placed[:, None]
        square = reprojection_error(
            prepared.batch.cameras, found.exchanged.key_points, found.points
        ).square()
        count = views.sum(1)
        error = (torch.where(views, square, 0.0).sum(1) / count.clamp(min=1)).sqrt()
        return Reconstruction(
            frame=prepared.batch.index,
            points=found.points,
            state=state,
            error=error.float(),
            views=views,
            covariance=torch.where(placed[..., None], found.covariance, 0.0).float(),
            score=torch.zeros(len(state), dtype=torch.float32),
            flipped=found.flipped,
        )

    def _states(self, prepared: Prepared, found: TrajectoryPart) -> Int8[Tensor, "N J"]:
        """Return the states.

        1. A joint with which two views agree is observed, unless their rays are parallel.
        2. One with which one view agrees is supported, where it is observed within reach.
        3. Of the others the state is that of the frame alone; what the frame alone would have
           placed is rejected.
        4. An observed or supported joint that its views do not explain is rejected.
        """
        alone = final_states(prepared, prepared.triangulation, None)
        agreeing = found.views.sum(1)
        fixed = alone != State.PARALLEL
        observed = (agreeing >= 2) & fixed
        near = self.trajectory.within_reach(prepared.batch, observed)
        supported = (agreeing >= 1) & ~observed & near
        if self.reject is not None:
            rays = self.reject.explaining(found.exchanged, found.points, observed | supported)
            observed &= rays >= 2
            supported &= rays >= 1
        missing = torch.where(alone == State.OBSERVED, int(State.REJECTED), alone)
        state = torch.where(supported, int(State.SUPPORTED), missing)
        return torch.where(observed, int(State.OBSERVED), state).to(torch.int8)
