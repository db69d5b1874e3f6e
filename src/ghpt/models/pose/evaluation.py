"""metrics.json: all numbers of a test run, computed from its predictions alone."""

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.datasets.human36m import DAMAGED
from ghpt.files import write_json
from ghpt.metrics.pose_error import MPJPE
from ghpt.metrics.pose_prior import PARTS, PosePrior
from ghpt.models.pose.predictions import Predictions
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


def evaluate(predictions: Predictions) -> dict[str, Any]:
    """The content of metrics.json; lengths in mm, null where nothing could be measured.

    ``selections[name]``: ``mpjpe_absolute``, ``mpjpe_relative`` (to the pelvis), ``mpjpe_aligned``
    (Procrustes), ``mpjpe_6_joints`` (relative; elbows, wrists, knees), ``coverage`` (estimated
    joint-frames / joint-frames with a truth), ``per_joint`` and ``per_action`` (relative),
    ``pose_prior`` (S^2 by subject and part) and, where the data hold damaged takes,
    ``without_damaged`` (the four means again).
    """
    actions = sorted(set(predictions.recording_action))
    subjects = sorted(set(predictions.recording_subject))
    action_of = torch.tensor([actions.index(a) for a in predictions.recording_action])
    subject_of = torch.tensor([subjects.index(s) for s in predictions.recording_subject])
    damaged = torch.tensor([name in DAMAGED for name in predictions.recording_name])
    names = sorted(
        predictions.names, key=lambda n: (NAMES.index(n) if n in NAMES else len(NAMES), n)
    )
    whole = {name: _Selection(len(actions), len(subjects)) for name in names}
    sound = (
        {name: _Selection(len(actions), len(subjects)) for name in names} if damaged.any() else {}
    )
    for chunk in predictions.chunks(_CHUNK):
        keep = ~damaged[chunk.recording]
        action = action_of[chunk.recording]
        subject = subject_of[chunk.recording]
        for name in names:
            estimate = chunk.estimates[name]
            whole[name].update(estimate, chunk.truth, action, subject)
            if sound:
                kept = estimate.rows(keep)
                sound[name].update(kept, chunk.truth.rows(keep), action[keep], subject[keep])
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


def write_metrics(path: str | Path, metrics: dict[str, Any]) -> None:
    """Write ``evaluate``'s result as metrics.json."""
    write_json(path, metrics)
