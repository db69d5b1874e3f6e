"""Trajectories of a data set's recordings, for a test that asks for single frames."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Int

from ghpt.data.datasets.frames import Frames
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.models.estimators.trajectory.windows import spread_runs
from ghpt.observations import LabelledRecording, Observations, PoseEstimate

_PIECE = 4096
"""Frames that are solved at a time."""


class TestedTrajectory:
    """Gives each frame of a batch its pose in the trajectory of its whole recording.

    ``fitted_frames``: about so many of a recording tell its person's bones. A recording is solved
    once, when its first frame is asked for. ``open`` says which recordings those of the batches
    are.
    """

    __test__ = False  # not one for pytest

    def __init__(self, trajectory: Trajectory, fitted_frames: int) -> None:
        self.trajectory = trajectory
        self.fitted_frames = fitted_frames
        self._solved = lru_cache(maxsize=2)(self._solve)

    def open(self, dataset: Frames) -> None:
        """Take the recordings of a data set."""
        self.dataset = dataset
        self._solved.cache_clear()

    def __call__(self, batch: Observations) -> PoseEstimate:
        places = [self.dataset.locate(int(sample)) for sample in batch.index]
        points = torch.empty_like(batch.key_points[:, 0, :, :1]).expand(-1, -1, 3).clone()
        estimated = torch.zeros(points.shape[:2], dtype=torch.bool, device=points.device)
        for row, (recording, position) in enumerate(places):
            whole = self._solved(recording)
            points[row] = whole.points[position].to(points)
            estimated[row] = whole.estimated[position].to(points.device)
        return PoseEstimate(points, estimated)

    def _solve(self, recording: int) -> PoseEstimate:
        """Return the poses of all frames of a recording."""
        frames = self.dataset.recordings[recording]
        sample = _read(frames, spread_runs(len(frames), self.fitted_frames))
        trajectory = self.trajectory.at_rate(sample, frames.rate_hz).fit_to(sample)
        parts = []
        for start in range(0, len(frames), _PIECE):
            rows = np.arange(start, min(start + _PIECE, len(frames)))
            parts.append(trajectory(_read(frames, rows)))
        points = torch.cat([part.points for part in parts])
        return PoseEstimate(points, torch.cat([part.estimated for part in parts]))


def _read(recording: LabelledRecording, rows: Int[np.ndarray, " N"]) -> Observations:
    """Return the observations of some frames, without what no detection can be."""
    part = recording.frames(rows)
    batch = Observations(
        index=torch.from_numpy(np.array(part.frame)),
        recording=torch.zeros(len(rows), dtype=torch.int64),
        cameras=part.cameras.to(torch.float64).expand(len(rows)),
        key_points=torch.from_numpy(np.array(part.key_points)),
        confidence=torch.from_numpy(np.array(part.confidence)),
        valid=torch.from_numpy(np.array(part.valid)),
    )
    return remove_outliers(batch)[0]
