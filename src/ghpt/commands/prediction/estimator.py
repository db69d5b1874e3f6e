"""The estimator of a prediction, by its name or of a checkpoint."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ghpt.commands.prediction.settings import ALIASES, ONLINE, TRAJECTORY, PredictSettings
from ghpt.config import Target, build
from ghpt.errors import GhptCheckpointError
from ghpt.models.checkpoint import load_model
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.flips import LeftRightFlips
from ghpt.models.estimators.pool_average import PoolAverage
from ghpt.models.estimators.predictors import Classical, Learned, Predictor
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.report.tables import NAMES


@dataclass(frozen=True)
class PoseEstimator:
    """The estimator of a prediction."""

    name: str
    text: str
    """In words, for people."""
    predictor: Predictor
    flips: LeftRightFlips | None
    weights: torch.nn.Module | None
    identity: dict[str, Any]
    """What its results depend on, as plain data."""


def build_estimator(settings: PredictSettings) -> PoseEstimator:
    """Return the estimator of the checkpoint's model, or without one the classical estimator.

    Raises GhptCheckpointError for a model that does not predict poses.
    """
    if settings.ckpt:
        return _learned_estimator(settings, settings.ckpt)
    name = ALIASES.get(settings.estimator, settings.estimator)
    if name == TRAJECTORY:
        text = "the trajectory of the whole recording (no ckpt was given)"
        group = _with_exchange(settings, settings.predictor.trajectory)
        return _trajectory(settings, TRAJECTORY, text, group)
    if name == ONLINE:
        text = f"the trajectory with a lag of {settings.lag:g} s (no ckpt was given)"
        online = dict(settings.predictor.online)
        own = _with_exchange(settings, online["settings"]) | {"lag_s": settings.lag}
        return _trajectory(settings, ONLINE, text, online | {"settings": own})
    group = _with_flips(settings, settings.predictor.classical)
    baseline = settings.baselines[name]
    factory = build(group, "predictor.classical")
    estimator: Estimator = build(baseline, f"baselines.{name}")
    predictor: Classical = factory(estimator=estimator)
    shown = NAMES.get(name, name.replace("_", " "))
    return PoseEstimator(
        name=name,
        text=f"{shown}, {estimator.sort} (no ckpt was given)",
        predictor=predictor,
        flips=predictor.flips,
        weights=None,
        identity=group | {"estimator": baseline},
    )


def _with_exchange(settings: PredictSettings, group: Target) -> dict[str, Any]:
    """Return what holds a trajectory, without exchanged sides if none are looked for."""
    if settings.flips:
        return dict(group)
    trajectory = dict(group["trajectory"])
    solver = dict(trajectory["solver"]) | {"exchange": None}
    return dict(group) | {"trajectory": trajectory | {"solver": solver}}


def _trajectory(
    settings: PredictSettings, name: str, text: str, group: dict[str, Any]
) -> PoseEstimator:
    flips: LeftRightFlips | None = build(settings.predictor.classical["flips"], "flips")
    return PoseEstimator(
        name=name,
        text=text,
        predictor=build(group, f"predictor.{name}"),
        flips=flips if settings.flips else None,
        weights=None,
        identity=group,
    )


def _learned_estimator(settings: PredictSettings, ckpt: str) -> PoseEstimator:
    changes = {"hypotheses": settings.hypotheses, "seed": settings.seed}
    model, trained = load_model(ckpt, settings.trust, **changes)
    if not isinstance(model.problem, PoseTriangulation):
        problem = f"is of a {type(model.problem).__name__}: it has no pool of poses"
        hint = "Give one that train.py model=pose wrote."
        raise GhptCheckpointError(ckpt, problem, hint)
    group = _with_flips(settings, settings.predictor.learned)
    average: PoolAverage = build(group["average"], "predictor.learned.average")(model)
    predictor: Learned = build(group, "predictor.learned")(average=average)
    data = trained["provenance"].get("data", "unknown")
    return PoseEstimator(
        name="weight",
        text=f"the learned model of {Path(ckpt).name}, trained on {data}",
        predictor=predictor,
        flips=predictor.flips,
        weights=model,
        identity=group
        | {
            "ckpt_sha256": hashlib.sha256(Path(ckpt).read_bytes()).hexdigest(),
            "hypotheses": model.hypotheses,
            "seed": settings.seed,
        },
    )


def _with_flips(settings: PredictSettings, group: Target) -> dict[str, Any]:
    return dict(group) if settings.flips else dict(group) | {"flips": None}
