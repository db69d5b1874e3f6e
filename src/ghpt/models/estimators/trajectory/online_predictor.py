"""A recording's reconstruction as it would have been made while it was recorded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Int

from ghpt.models.estimators.predictors import Advance, FrameSource
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.trajectory.online import (
    Estimate,
    OnlineSettings,
    OnlineStream,
    as_reconstruction,
)
from ghpt.models.estimators.trajectory.sightings import frames_of
from ghpt.models.estimators.trajectory.windows import Clock
from ghpt.observations import Observations, PoseEstimate
from ghpt.reconstruction import Reconstruction
from ghpt.skeleton import Skeleton


class _Run:
    """How far a recording has been worked through."""

    def __init__(self, stream: OnlineStream) -> None:
        self.stream = stream
        self.row = 0
        """The next one that the stream takes."""
        self.first = 0
        """The first one whose result is not given away."""
        self.ready: list[Estimate] = []


@dataclass(frozen=True)
class OnlinePredictor:
    """Estimates each frame from those before it and those of a fixed lag after it.

    A frame's result depends on all frames before, so a part of a recording costs what is before it
    too, unless it follows the part that was asked for last. ``reject``: which joints are REJECTED
    because too few views explain them; null: none.
    """

    settings: OnlineSettings
    reject: Rejection | None
    clock: Clock | None = None
    runs: list[_Run] = field(default_factory=list, compare=False)
    """The run that goes on, if there is one."""

    def for_skeleton(self, skeleton: Skeleton) -> OnlinePredictor:
        trajectory = replace(self.settings.trajectory, skeleton=skeleton)
        settings = replace(self.settings, trajectory=trajectory)
        return OnlinePredictor(settings, self.reject, self.clock)

    def fit(self, source: FrameSource, frames: int) -> OnlinePredictor:
        """Return the same with the recording's clock: of its key points nothing is known before."""
        longest = self.settings.trajectory.longest_gap_s
        clock = Clock.of_frames(source.frame, source.rate_hz, longest)
        return OnlinePredictor(self.settings, self.reject, clock)

    def stream(self, rate_hz: float | None) -> OnlineStream:
        """Return what takes the successive frames of one person as they come."""
        longest = self.settings.trajectory.longest_gap_s
        clock = Clock.of_frames(np.arange(1), rate_hz, longest)
        return OnlineStream(self.settings, self.reject, clock)

    @torch.no_grad()
    def predict(
        self,
        source: FrameSource,
        rows: Int[np.ndarray, " N"],
        batch: int,
        device: torch.device,
        advance: Advance,
    ) -> Reconstruction:
        wanted = source.frame[rows]
        run = self._run(int(rows[0]))
        total = len(source.frame)
        done = 0
        while not run.ready or run.ready[-1].number < wanted[-1]:
            if run.row == total:
                run.ready += run.stream.finish()
                break
            read = np.arange(run.row, min(run.row + batch, total))
            for frame in frames_of(source.read(read)):
                run.ready += run.stream.push(frame)
            run.row += len(read)
            run.ready = [found for found in run.ready if found.number >= wanted[0]]
            now = sum(found.number <= wanted[-1] for found in run.ready)
            advance(now - done)
            done = now
        numbers = set(wanted.tolist())
        found = [one for one in run.ready if one.number in numbers]
        run.ready = [one for one in run.ready if one.number > wanted[-1]]
        run.first = int(rows[-1]) + 1
        advance(len(found) - done)
        return as_reconstruction(found)

    @torch.no_grad()
    def estimate(self, batch: Observations) -> PoseEstimate:
        """Return the poses of frames of which nothing is known before."""
        points = batch.key_points.new_zeros(*batch.valid.shape[::2], 3)
        estimated = torch.zeros(points.shape[:2], dtype=torch.bool)
        for recording in batch.recording.unique():
            rows = torch.nonzero(batch.recording == recording)[:, 0]
            part = batch.rows(rows)
            longest = self.settings.trajectory.longest_gap_s
            clock = self.clock or Clock.of_frames(part.index.numpy(), None, longest)
            stream = OnlineStream(self.settings, None, clock)
            found = [one for frame in frames_of(part) for one in stream.push(frame)]
            poses = as_reconstruction([*found, *stream.finish()])
            points[rows] = poses.points.to(points.dtype)
            estimated[rows] = poses.has_position
        return PoseEstimate(points, estimated)

    def _run(self, first: int) -> _Run:
        """Return the run that goes on to these frames, or one from the beginning."""
        assert self.clock is not None, "fit it first"
        if self.runs and self.runs[0].first <= first:
            return self.runs[0]
        self.runs[:] = [_Run(OnlineStream(self.settings, self.reject, self.clock))]
        return self.runs[0]
