"""metrics.json of the camera problem: all numbers of a test run, computed from its predictions
alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
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
from ghpt.models.relative_pose.schema import PairChunk, PairPredictions

FORMAT_VERSION = 1
NAMES = (*AGGREGATIONS, "eight_point", "ransac", "usac_magsac", "usac_accurate", "poselib", "rig")
"""The order of every table: the selections, then the baselines."""
ERRORS = ("E_R", "E_t", "E_2D", "E_3D", "rotation_deg", "translation_deg")
"""Section 4.5's four, and the angles in degrees."""
ALONE = ("estimated_R", "estimated_t")
"""tab:fundamental-dissection: one part of the pose estimated, the other one true."""

_CHUNK = 512


def evaluate_pairs(predictions: PairPredictions) -> dict[str, Any]:
    """The content of metrics.json; mm, pixels and degrees, null where nothing could be measured.

    ``selections[name]["pairs"]["1-2"]`` (places in the arrangement, from 1): the six errors of
    ``ERRORS`` as medians over all draws of all rigs, in which a draw without an estimate counts as
    infinitely bad (an infinite median is null); ``coverage`` (draws estimated / draws); ``mean``
    and ``deviation`` over the draws that could be measured; ``estimated_R`` and ``estimated_t``:
    median E_2D and E_3D when the other part is the true one. A selection's own numbers are means
    over its pairs. A draw's E_2D and E_3D are means over the points that count.
    """
    names = sorted(
        predictions.names, key=lambda n: (NAMES.index(n) if n in NAMES else len(NAMES), n)
    )
    errors, pair, draw = _all_errors(predictions, names)
    pairs = [tuple(ab) for ab in np.unique(pair, axis=0).tolist()]
    selections = {}
    for name in names:
        numbers = {
            pair_name(ab): _numbers({e: v[(pair == ab).all(-1)] for e, v in errors[name].items()})
            for ab in pairs
        }
        selections[name] = {
            **{
                key: _mean([of_pair[key] for of_pair in numbers.values()])
                for key in (*ERRORS, "coverage")
            },
            "pairs": numbers,
        }
    meta = predictions.meta
    return {
        "format_version": FORMAT_VERSION,
        **{key: meta.get(key) for key in ("data", "source", "split", "problem", "frames")},
        "draws": len(np.unique(draw)),
        "cameras": predictions.tables.camera_name[0].tolist(),
        **{key: meta.get(key) for key in ("seed", "provenance")},
        "selections": selections,
    }


def pair_name(pair: tuple[int, int]) -> str:
    """The paper's name of two views: their places in the arrangement, counted from 1."""
    return f"{pair[0] + 1}-{pair[1] + 1}"


def pair_errors(
    predictions: PairPredictions, chunk: PairChunk, name: str
) -> dict[str, Float[Tensor, " B"]]:
    """Each row's errors under a selection: ``ERRORS``, and E_2D and E_3D of each part ``ALONE``;
    inf where it was not estimated or no point counts.
    """
    estimate = chunk.estimates[name]
    sample = chunk.sample
    truth = _pair_cameras(predictions, sample.rig, sample.pair)
    points = predictions.tables.points[sample.rig]
    whole = _with_target(truth, estimate.R, estimate.t)
    errors = {
        "E_R": quaternion_error(estimate.R, sample.truth_R),
        "E_t": translation_error(estimate.t, sample.truth_t),
        "E_2D": _mean_over_points(*error_2d(whole, truth, points)),
        "E_3D": _mean_over_points(*error_3d(whole, truth, points)),
        "rotation_deg": rotation_deg(estimate.R, sample.truth_R),
        "translation_deg": translation_deg(estimate.t, sample.truth_t),
    }
    for part, (R, t) in zip(
        ALONE, ((estimate.R, sample.truth_t), (sample.truth_R, estimate.t)), strict=True
    ):
        mixed = _with_target(truth, R, t)
        errors[f"E_2D {part}"] = _mean_over_points(*error_2d(mixed, truth, points))
        errors[f"E_3D {part}"] = _mean_over_points(*error_3d(mixed, truth, points))
    return {key: torch.where(estimate.estimated, value, torch.inf) for key, value in errors.items()}


def errors_of_pair(
    predictions: PairPredictions, pair: tuple[int, int], error: str
) -> dict[str, list[float]]:
    """One of ``ERRORS`` on a pair of views (from 0) in each draw, by name, in the file's order; inf
    where a draw was not estimated. A sweep over the number of frames plots these.
    """
    errors, pairs, _ = _all_errors(predictions, list(predictions.names))
    rows = (pairs == pair).all(-1)
    return {name: values[error][rows].tolist() for name, values in errors.items()}


def camera_after(
    reference: Cameras, R: Float[Tensor, "*B 3 3"], t: Float[Tensor, "*B 3"]
) -> tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"]]:
    """World to target camera, of the relative pose after the reference camera (of each of B,
    without a view axis).
    """
    return R @ reference.R, (R @ reference.t[..., None])[..., 0] + t


def _pair_cameras(
    predictions: PairPredictions, rig: Int[Tensor, " B"], pair: Int[Tensor, "B 2"]
) -> Cameras:
    """The true reference and target cameras, leading dimensions B 2."""
    return predictions.tables.cameras.index((rig[:, None], pair))


def _with_target(truth: Cameras, R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"]) -> Cameras:
    reference = truth.index((slice(None), 0))
    target_R, target_t = camera_after(reference, R, t)
    return Cameras(
        truth.K, torch.stack((reference.R, target_R), 1), torch.stack((reference.t, target_t), 1)
    )


def _mean_over_points(errors: Float[Tensor, "B P"], counted: Tensor) -> Float[Tensor, " B"]:
    return torch.where(
        counted.any(-1), (errors * counted).sum(-1) / counted.sum(-1).clamp_min(1), torch.inf
    )


def _all_errors(
    predictions: PairPredictions, names: list[str]
) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray, np.ndarray]:
    """Every row's errors under each name, its pair and its draw. A row is a few numbers, so all are
    held at once.
    """
    parts: dict[str, dict[str, list[Tensor]]] = {name: {} for name in names}
    pair = []
    draw = []
    for chunk in predictions.chunks(_CHUNK):
        pair.append(chunk.sample.pair)
        draw.append(chunk.sample.draw)
        for name in names:
            for error, values in pair_errors(predictions, chunk, name).items():
                parts[name].setdefault(error, []).append(values)
    errors = {
        name: {e: torch.cat(v).numpy() for e, v in each.items()} for name, each in parts.items()
    }
    return errors, torch.cat(pair).numpy(), torch.cat(draw).numpy()


def _numbers(errors: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """A pair's entry of metrics.json, from the errors of its draws."""
    median = {error: _finite(np.median(values)) for error, values in errors.items()}
    measured = {error: errors[error][np.isfinite(errors[error])] for error in ERRORS}
    return {
        **{error: median[error] for error in ERRORS},
        "coverage": float(np.isfinite(errors["E_R"]).mean()),
        "mean": {error: _finite(v.mean()) if len(v) else None for error, v in measured.items()},
        "deviation": {
            error: _finite(v.std(ddof=1)) if len(v) > 1 else None for error, v in measured.items()
        },
        **{
            part: {error: median[f"{error} {part}"] for error in ("E_2D", "E_3D")} for part in ALONE
        },
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _mean(values: list[float | None]) -> float | None:
    return (
        None
        if None in values or not values
        else float(np.mean([v for v in values if v is not None]))
    )
