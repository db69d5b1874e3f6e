"""metrics.json: all numbers of a test run, computed from its predictions alone."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.datasets.human36m import DAMAGED
from ghpt.metrics.pose_error import MPJPE
from ghpt.metrics.pose_prior import PARTS, PosePrior
from ghpt.models.pose.schema import PosePredictions
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import JOINTS

FORMAT_VERSION = 1
NAMES = (
    "weight",
    "average",
    "most",
    "least",
    "stochastic",
    "random",
    "best",
    "worst",
    "view_weights",
    "linear",
    "weighted_linear",
    "ransac",
    "adaptive_ransac",
    "m_estimator",
    "lo_ransac",
)
"""The order of every table: the selections, the learned view weights, then the baselines."""

_CHUNK = 2048


class _Selection:
    """All metrics of one selection."""

    def __init__(self, actions: int, subjects: int) -> None:
        self.absolute, self.relative, self.aligned = (
            MPJPE(kind, actions, len(JOINTS)) for kind in ("absolute", "relative", "aligned")
        )
        self.prior = PosePrior(subjects)
        # One process reads the predictions of all; the others have nothing to add.
        for metric in (self.absolute, self.relative, self.aligned, self.prior):
            metric.distributed_available_fn = lambda: False

    def numbers(self) -> dict[str, float | None]:
        relative = self.relative.compute()
        return {
            "mpjpe_absolute": _number(self.absolute.compute().mean),
            "mpjpe_relative": _number(relative.mean),
            "mpjpe_aligned": _number(self.aligned.compute().mean),
            "mpjpe_6_joints": _number(relative.six_joints),
        }

    def update(
        self,
        estimate: PoseEstimate,
        truth: Truth,
        action: Int[Tensor, " B"],
        subject: Int[Tensor, " B"],
    ) -> None:
        for metric in (self.absolute, self.relative, self.aligned):
            metric.update(estimate, truth, action)
        self.prior.update(estimate, subject)


def _number(value: Float[Tensor, ""]) -> float | None:
    return None if math.isnan(value.item()) else value.item()


def evaluate_poses(predictions: PosePredictions) -> dict[str, Any]:
    """The content of metrics.json; lengths in mm, null where nothing could be measured.

    ``selections[name]``: ``mpjpe_absolute``, ``mpjpe_relative`` (to the pelvis), ``mpjpe_aligned``
    (Procrustes), ``mpjpe_6_joints`` (relative; elbows, wrists, knees), ``coverage`` (estimated
    joint-frames / joint-frames with a truth), ``per_joint`` and ``per_action`` (relative),
    ``pose_prior`` (S^2 by subject and part) and, where the data hold damaged takes,
    ``without_damaged`` (the four means again).
    """
    tables = predictions.tables
    actions, action_of = _groups(tables.recording_action)
    subjects, subject_of = _groups(tables.recording_subject)
    damaged = torch.tensor([name in DAMAGED for name in tables.recording_name.tolist()])
    names = sorted(
        predictions.names, key=lambda n: (NAMES.index(n) if n in NAMES else len(NAMES), n)
    )
    whole = {name: _Selection(len(actions), len(subjects)) for name in names}
    sound = (
        {name: _Selection(len(actions), len(subjects)) for name in names} if damaged.any() else {}
    )
    for chunk in predictions.chunks(_CHUNK):
        recording = chunk.sample.recording
        truth = chunk.sample.as_truth()
        keep = ~damaged[recording]
        action = action_of[recording]
        subject = subject_of[recording]
        for name in names:
            estimate = chunk.estimates[name]
            whole[name].update(estimate, truth, action, subject)
            if sound:
                kept = estimate.rows(keep)
                sound[name].update(kept, truth.rows(keep), action[keep], subject[keep])
    selections = {name: _selection(whole[name], actions, subjects) for name in names}
    for name, metrics in sound.items():
        selections[name]["without_damaged"] = metrics.numbers()
    meta = predictions.meta
    return {
        "format_version": FORMAT_VERSION,
        **{key: meta.get(key) for key in ("data", "source", "split")},
        "frames": len(predictions),
        **{key: meta.get(key) for key in ("seed", "provenance")},
        "selections": selections,
    }


def _selection(metrics: _Selection, actions: list[str], subjects: list[str]) -> dict[str, Any]:
    relative = metrics.relative.compute()
    prior = metrics.prior.compute()
    return {
        **metrics.numbers(),
        "coverage": _number(metrics.absolute.compute().coverage),
        "per_joint": dict(zip(JOINTS, map(_number, relative.per_joint), strict=True)),
        "per_action": dict(
            zip(actions, map(_number, torch.atleast_1d(relative.per_group)), strict=True)
        ),
        "pose_prior": {
            subject: dict(zip(PARTS, map(_number, row), strict=True))
            for subject, row in zip(subjects, prior, strict=True)
        },
    }


def _groups(labels: np.ndarray) -> tuple[list[str], Int[Tensor, " R"]]:
    """Return the distinct labels in their order, and which of them each recording has."""
    distinct, of_recording = np.unique(labels, return_inverse=True)
    return distinct.tolist(), torch.from_numpy(of_recording)
