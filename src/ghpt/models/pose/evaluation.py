"""metrics.json: all numbers of a test run, computed from its predictions alone."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.datasets.human36m import DAMAGED
from ghpt.metrics.pose_error import MPJPE
from ghpt.metrics.pose_prior import PARTS, PosePrior
from ghpt.models.measured import Measured, Number, TestRun
from ghpt.models.pose.numbers import PoseMeans, PoseNumbers
from ghpt.models.pose.schema import PosePredictions
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import JOINTS

NAMES = (
    "weight",
    "average",
    "most",
    "least",
    "stochastic",
    "random",
    "best",
    "worst",
    "trajectory",
    "frame_learned",
    "linear",
    "weighted_linear",
    "ransac",
    "adaptive_ransac",
    "m_estimator",
    "lo_ransac",
)
"""The order of every table: the selections, then the other estimators."""

_CHUNK = 2048


@dataclass(frozen=True)
class _Groups:
    """Distinct labels in their order, and which of them each recording has."""

    labels: list[str]
    of_recording: Int[Tensor, " R"]

    @staticmethod
    def from_labels(labels: np.ndarray) -> _Groups:
        """Return the groups of the recordings that have these labels."""
        distinct, of_recording = np.unique(labels, return_inverse=True)
        return _Groups(distinct.tolist(), torch.from_numpy(of_recording))


class _Metrics:
    """All metrics of one aggregation or baseline."""

    def __init__(self, actions: _Groups, subjects: _Groups) -> None:
        count = len(actions.labels)
        self.absolute = MPJPE("absolute", count, len(JOINTS))
        self.relative = MPJPE("relative", count, len(JOINTS))
        self.aligned = MPJPE("aligned", count, len(JOINTS))
        self.prior = PosePrior(len(subjects.labels))
        self.actions = actions
        self.subjects = subjects
        # One process reads the predictions of all; the others have nothing to add.
        for metric in (self.absolute, self.relative, self.aligned, self.prior):
            metric.distributed_available_fn = lambda: False

    def update(self, estimate: PoseEstimate, truth: Truth, recording: Int[Tensor, " B"]) -> None:
        """Add frames of these recordings."""
        action = self.actions.of_recording[recording]
        for metric in (self.absolute, self.relative, self.aligned):
            metric.update(estimate, truth, action)
        self.prior.update(estimate, self.subjects.of_recording[recording])

    def means(self) -> PoseMeans:
        """Return the four means."""
        relative = self.relative.compute()
        return PoseMeans(
            absolute=_number(self.absolute.compute().mean),
            relative=_number(relative.mean),
            aligned=_number(self.aligned.compute().mean),
            six_joints=_number(relative.six_joints),
        )

    def numbers(self) -> PoseNumbers:
        """Return all numbers."""
        relative = self.relative.compute()
        per_action = torch.atleast_1d(relative.per_group)
        priors = {}
        for subject, row in zip(self.subjects.labels, self.prior.compute(), strict=True):
            priors[subject] = _by_name(PARTS, row)
        return PoseNumbers(
            means=self.means(),
            coverage=_number(self.absolute.compute().coverage),
            per_joint=_by_name(JOINTS, relative.per_joint),
            per_action=_by_name(self.actions.labels, per_action),
            pose_prior=priors,
        )


def evaluate_poses(predictions: PosePredictions) -> Measured[PoseNumbers]:
    """Return what a test run measured, in the order of ``NAMES``."""
    tables = predictions.tables
    actions = _Groups.from_labels(tables.recording_action)
    subjects = _Groups.from_labels(tables.recording_subject)
    damaged = torch.tensor([name in DAMAGED for name in tables.recording_name.tolist()])
    rank = {name: place for place, name in enumerate(NAMES)}
    names = sorted(predictions.names, key=lambda name: (rank.get(name, len(NAMES)), name))
    whole = {name: _Metrics(actions, subjects) for name in names}
    sound = {name: _Metrics(actions, subjects) for name in names} if damaged.any() else {}
    for chunk in predictions.chunks(_CHUNK):
        recording = chunk.sample.recording
        truth = chunk.sample.as_truth()
        keep = ~damaged[recording]
        for name, estimate in chunk.estimates.items():
            whole[name].update(estimate, truth, recording)
            if sound:
                sound[name].update(estimate.rows(keep), truth.rows(keep), recording[keep])
    selections = {name: metrics.numbers() for name, metrics in whole.items()}
    for name, metrics in sound.items():
        selections[name] = replace(selections[name], without_damaged=metrics.means())
    return Measured(TestRun.from_meta(predictions.meta, len(predictions)), selections)


def _by_name(names: Iterable[str], values: Tensor) -> dict[str, Number]:
    return {name: _number(value) for name, value in zip(names, values, strict=True)}


def _number(value: Float[Tensor, ""]) -> Number:
    return None if math.isnan(value.item()) else value.item()
