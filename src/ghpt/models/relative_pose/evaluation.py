"""metrics.json of the camera problem: all numbers of a test run, from its predictions alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.metrics.relative_pose import (
    error_2d,
    error_3d,
    quaternion_error,
    rotation_deg,
    translation_deg,
    translation_error,
)
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.measured import Measured, Number, TestRun
from ghpt.models.relative_pose.schema import PairChunk, PairPredictions

NAMES = (
    *AGGREGATIONS,
    "weight_refined",
    "eight_point",
    "ransac",
    "usac_magsac",
    "usac_accurate",
    "poselib",
    "five_point",
    "rig",
)
"""The order of every table: the selections, then the baselines."""
ERRORS = ("E_R", "E_t", "E_2D", "E_3D", "rotation_deg", "translation_deg")
"""Section 4.5's four, and the angles in degrees."""
ALONE = ("estimated_R", "estimated_t")
"""tab:fundamental-dissection: one part of the pose estimated, the other one true."""

_CHUNK = 512


@dataclass(frozen=True)
class PairNumbers:
    """The errors of one pair of views; those of all by their names in ``ERRORS``."""

    median: Mapping[str, Number]
    """Over all draws of all rigs; a draw without an estimate counts as infinitely bad, and an
    infinite median is None.
    """
    coverage: float
    """Draws estimated / draws."""
    mean: Mapping[str, Number]
    """Over the draws that could be measured."""
    deviation: Mapping[str, Number]
    alone: Mapping[str, Mapping[str, Number]]
    """Median E_2D and E_3D of each of ``ALONE``, where the other part is the true one."""

    def plain(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        return {
            **self.median,
            "coverage": self.coverage,
            "mean": dict(self.mean),
            "deviation": dict(self.deviation),
            **{part: dict(errors) for part, errors in self.alone.items()},
        }


@dataclass(frozen=True)
class PairSelection:
    """The errors of one selection or baseline, and their means over the pairs."""

    mean: Mapping[str, Number]
    coverage: Number
    pairs: Mapping[str, PairNumbers]
    """By the pair's name, such as 1-2: places in the arrangement, from 1."""

    @property
    def headline(self) -> Number:
        return self.mean["E_3D"]

    def plain(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        pairs = {pair: numbers.plain() for pair, numbers in self.pairs.items()}
        return {**self.mean, "coverage": self.coverage, "pairs": pairs}


@dataclass(frozen=True)
class PairsMeasured(Measured[PairSelection]):
    """The errors of relative poses; mm, pixels and degrees."""

    draws: int
    cameras: Sequence[str]

    def _own(self) -> dict[str, Any]:
        return {"draws": self.draws, "cameras": list(self.cameras)}


def evaluate_pairs(predictions: PairPredictions) -> PairsMeasured:
    """Return what a test run measured, in the order of ``NAMES``.

    A draw's E_2D and E_3D are means over the points that count.
    """
    rank = {name: place for place, name in enumerate(NAMES)}
    names = sorted(predictions.names, key=lambda name: (rank.get(name, len(NAMES)), name))
    measured = _measure(predictions, names)
    pairs = [tuple(views) for views in np.unique(measured.pair, axis=0).tolist()]
    selections = {}
    for name in names:
        of_pairs = {pair_name(pair): _pair_numbers(measured.select(name, pair)) for pair in pairs}
        means = {
            error: _mean([numbers.median[error] for numbers in of_pairs.values()])
            for error in ERRORS
        }
        coverage = _mean([numbers.coverage for numbers in of_pairs.values()])
        selections[name] = PairSelection(means, coverage, of_pairs)
    meta = predictions.meta
    return PairsMeasured(
        run=TestRun.from_meta(meta, meta["frames"]),
        selections=selections,
        draws=len(np.unique(measured.draw)),
        cameras=predictions.tables.camera_name[0].tolist(),
    )


def pair_name(pair: tuple[int, int]) -> str:
    """The paper's name of two views: their places in the arrangement, counted from 1."""
    return f"{pair[0] + 1}-{pair[1] + 1}"


def pair_errors(
    predictions: PairPredictions, chunk: PairChunk, name: str
) -> dict[str, Float[Tensor, " B"]]:
    """Return each row's errors under a selection: ``ERRORS``, and E_2D and E_3D of each ``ALONE``.

    An error is inf where the pose was not estimated, and where no point counts.
    """
    estimate = chunk.estimates[name]
    sample = chunk.sample
    truth = predictions.tables.cameras.index((sample.rig[:, None], sample.pair))
    points = predictions.tables.points[sample.rig]
    errors = {
        "E_R": quaternion_error(estimate.R, sample.truth_R),
        "E_t": translation_error(estimate.t, sample.truth_t),
        "rotation_deg": rotation_deg(estimate.R, sample.truth_R),
        "translation_deg": translation_deg(estimate.t, sample.truth_t),
    }
    tried = {
        "": (estimate.R, estimate.t),
        " estimated_R": (estimate.R, sample.truth_t),
        " estimated_t": (sample.truth_R, estimate.t),
    }
    for part, (R, t) in tried.items():
        cameras = _with_target(truth, R, t)
        errors["E_2D" + part] = _mean_over_points(*error_2d(cameras, truth, points))
        errors["E_3D" + part] = _mean_over_points(*error_3d(cameras, truth, points))
    return {key: torch.where(estimate.estimated, value, torch.inf) for key, value in errors.items()}


def errors_of_pair(
    predictions: PairPredictions, pair: tuple[int, int], error: str
) -> dict[str, list[float]]:
    """Return one of ``ERRORS`` on a pair of views (from 0) in each draw, by name.

    The draws are in the file's order; inf where one was not estimated. A sweep over the number of
    frames plots these.
    """
    measured = _measure(predictions, list(predictions.names))
    return {name: measured.select(name, pair)[error].tolist() for name in predictions.names}


def camera_after(
    reference: Cameras, R: Float[Tensor, "*B 3 3"], t: Float[Tensor, "*B 3"]
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"]]:
    """Return R and t from the world to the target camera of a relative pose.

    The reference cameras have no view axis.
    """
    shifted = (R @ reference.t[..., None])[..., 0]
    return R @ reference.R, shifted + t


def _with_target(truth: Cameras, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]) -> Cameras:
    """Return the true reference cameras with the targets of these relative poses."""
    reference = truth.index((slice(None), 0))
    target_R, target_t = camera_after(reference, R, t)
    both_R = torch.stack((reference.R, target_R), 1)
    both_t = torch.stack((reference.t, target_t), 1)
    return Cameras(truth.K, both_R, both_t)


def _mean_over_points(errors: Float[Tensor, "B P"], counted: Tensor) -> Float[Tensor, " B"]:
    """Return the mean over the points that count, inf where none does."""
    total = (errors * counted).sum(-1)
    mean = total / counted.sum(-1).clamp_min(1)
    return torch.where(counted.any(-1), mean, torch.inf)


@dataclass(frozen=True)
class _Measured:
    """The errors of all rows: a row is a few numbers, so all are held at once."""

    errors: Mapping[str, Mapping[str, Float[np.ndarray, " N"]]]
    """By name, then by error."""
    pair: Int[np.ndarray, "N 2"]
    draw: Int[np.ndarray, " N"]

    def select(self, name: str, pair: tuple[int, ...]) -> dict[str, Float[np.ndarray, " D"]]:
        """Return the errors under a name on a pair, draw by draw."""
        rows = (self.pair == pair).all(-1)
        return {error: values[rows] for error, values in self.errors[name].items()}


def _measure(predictions: PairPredictions, names: Sequence[str]) -> _Measured:
    """Return the errors of every row under each name."""
    parts: dict[str, dict[str, list[Tensor]]] = {name: {} for name in names}
    pair = []
    draw = []
    for chunk in predictions.chunks(_CHUNK):
        pair.append(chunk.sample.pair)
        draw.append(chunk.sample.draw)
        for name, collected in parts.items():
            for error, values in pair_errors(predictions, chunk, name).items():
                collected.setdefault(error, []).append(values)
    errors = {
        name: {error: torch.cat(values).numpy() for error, values in collected.items()}
        for name, collected in parts.items()
    }
    return _Measured(errors, torch.cat(pair).numpy(), torch.cat(draw).numpy())


def _pair_numbers(errors: Mapping[str, Float[np.ndarray, " D"]]) -> PairNumbers:
    """Return a pair's numbers, from the errors of its draws."""
    median = {error: _finite(np.median(values)) for error, values in errors.items()}
    mean: dict[str, float | None] = {}
    deviation: dict[str, float | None] = {}
    for error in ERRORS:
        values = errors[error]
        measured = values[np.isfinite(values)]
        mean[error] = _finite(measured.mean()) if len(measured) else None
        deviation[error] = _finite(measured.std(ddof=1)) if len(measured) > 1 else None
    alone = {
        part: {error: median[f"{error} {part}"] for error in ("E_2D", "E_3D")} for part in ALONE
    }
    return PairNumbers(
        median={error: median[error] for error in ERRORS},
        coverage=float(np.isfinite(errors["E_R"]).mean()),
        mean=mean,
        deviation=deviation,
        alone=alone,
    )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean, None where a value is missing or there is none."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    return float(np.mean(known))
