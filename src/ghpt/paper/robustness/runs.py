"""Runs of successive frames of a data set, so that single frames and trajectories are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Int

from ghpt.data.datasets.frames import Frames
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.observations import (
    Labelled,
    LabelledRecording,
    Observations,
    PoseEstimate,
    Truth,
)
from ghpt.paper.engine.settings import Sequences


@dataclass(frozen=True)
class Runs:
    """The frames of all runs, one run after the other, in the order of their recordings."""

    batch: Labelled[Observations, Truth]
    tested: Bool[torch.Tensor, " B"]
    """Which frames are compared with the truth."""
    rates_hz: tuple[float, ...]
    """Of each recording of the data set."""

    def estimate(self, trajectory: Trajectory, observations: Observations) -> PoseEstimate:
        """Return the trajectory of all frames, recording by recording.

        ``observations`` are those of ``batch``, or what a perturbation made of them.
        """
        parts = []
        for recording in observations.recording.unique():
            rows = observations.recording == recording
            part, _ = remove_outliers(observations.rows(rows))
            fitted = trajectory.at_rate(part, self.rates_hz[int(recording)]).fit_to(part)
            parts.append(fitted(part))
        points = torch.cat([part.points for part in parts])
        return PoseEstimate(points, torch.cat([part.estimated for part in parts]))


def draw_runs(recordings: Sequence[LabelledRecording], sizes: Sequences) -> Runs:
    """Return runs that are spread over the recordings of a data set."""
    ends = np.cumsum([0, *map(len, recordings)])
    rows = []
    tested = []
    for start, end in pairwise(ends):
        for first in range(start, end, sizes.stride):
            run = np.arange(first, min(first + sizes.frames, end))
            rows.append(run)
            tested.append(_tested(len(run), sizes.tested))
    every = Frames(recordings, np.arange(ends[-1]))
    rates = tuple(recording.rate_hz for recording in recordings)
    batch = every[np.concatenate(rows).tolist()]
    return Runs(batch, torch.from_numpy(np.concatenate(tested)), rates)


def _tested(length: int, every: int) -> Bool[np.ndarray, " T"]:
    """Return which frames of a run are tested: those in the middle of every so many."""
    place: Int[np.ndarray, " T"] = np.arange(length)
    return place % every == every // 2
