"""What a reconstruction is worth, without a truth: coverage, reprojection, held-out views,
constancy of lengths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.commands.prediction.frames import Frames
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.estimators.classical import person_scale
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.relative_pose.scale import MEASURED_FRAMES, SEGMENTS, stature
from ghpt.observations import Observations, PoseEstimate
from ghpt.reconstruction import FILE_STATES, Reconstruction, State
from ghpt.report.rig_comparison import segment_variation

Estimate = Callable[[Observations], PoseEstimate]
Numbers = dict[str, Any]
_LEAST = 20
"""Key points for a median that a verdict may rest on."""


def counts(
    chunks: Iterator[Reconstruction], joints: tuple[str, ...], cameras: tuple[str, ...], total: int
) -> Numbers:
    """Over all ``total`` frames: how many, what share of the joints is in each state, how many
    views were exchanged, and the person's stature (mm; None where no limb is observed).
    """
    frames = 0
    states = torch.zeros(len(joints), len(FILE_STATES), dtype=torch.int64)
    flipped = torch.zeros(len(cameras), dtype=torch.int64)
    every = max(1, -(-total // MEASURED_FRAMES))
    points = []
    observed = []
    for chunk in chunks:
        measured = slice(-frames % every, None, every)
        points.append(chunk.points[measured].double())
        observed.append(chunk.state[measured] == State.OBSERVED)
        frames += len(chunk)
        states += torch.stack([(chunk.state == state).sum(0) for state in FILE_STATES], dim=1)
        flipped += chunk.flipped.sum(0)
    share = {
        state.name.lower(): float(states[:, state].sum()) / max(frames * len(joints), 1)
        for state in FILE_STATES
    }
    each = (states[:, State.OBSERVED].double() / max(frames, 1)).tolist()
    return {
        "frames": frames,
        "share": share,
        "observed": dict(zip(joints, each, strict=True)),
        "swapped": dict(zip(cameras, flipped.tolist(), strict=True)),
        "stature_mm": float(stature(torch.cat(points), torch.cat(observed))) or None,
    }


@torch.no_grad()
def evaluate(
    frames: Frames,
    flips: LeftRightFlips | None,
    estimates: Mapping[str, Estimate],
    most: int,
    size: int,
) -> Numbers:
    """For each estimator, on at most so many frames, evenly spread, and with ``flips`` undone for
    all: reprojection errors by view; errors in views that were left out, on the joints that all of
    them estimate without that view; variation of the segments' lengths.
    """
    rows = frames.spread(most)
    parts = [
        _undone(frames.batch(rows[start : start + size]), flips)
        for start in range(0, len(rows), size)
    ]
    own = {name: [estimate(part) for part in parts] for name, estimate in estimates.items()}
    held = {
        name: [_held_out(part, estimate) for part in parts] for name, estimate in estimates.items()
    }
    counted = torch.stack(
        [torch.cat([there for _, there in found]) for found in held.values()]
    ).all(0)
    valid = torch.cat([part.valid for part in parts])
    result: Numbers = {}
    for name in estimates:
        placed = torch.cat([found.estimated for found in own[name]])
        error = torch.cat(
            [_errors(part, found) for part, found in zip(parts, own[name], strict=True)]
        )
        measured = valid & placed[:, None] & error.isfinite()
        variation, known = segment_variation(
            torch.cat([found.points.double() for found in own[name]]), placed
        )
        lengths = [
            v if k else None for v, k in zip(variation.tolist(), known.tolist(), strict=True)
        ]
        result[name] = {
            "reprojection": _by_view(error, measured, frames.camera_names),
            "held_out": _by_view(
                torch.cat([e for e, _ in held[name]]), counted, frames.camera_names
            ),
            "segments": {
                "median": float(variation[known].median()) if known.any() else None,
                "each": dict(zip(SEGMENTS, lengths, strict=True)),
            },
            "placed": float(placed.double().mean()),
            "scales": _scales(
                parts,
                error,
                measured,
                [e for e, _ in held[name]],
                [c for _, c in held[name]],
                frames.camera_names,
            ),
        }
    return {"frames": len(rows), "estimators": result}


def estimate_of(predictor: Callable[[Observations], Reconstruction]) -> Estimate:
    """What a predictor gives, as the other estimators give it."""

    def estimate(batch: Observations) -> PoseEstimate:
        found = predictor(batch)
        return PoseEstimate(found.points, found.state == State.OBSERVED)

    return estimate


def _undone(batch: Observations, flips: LeftRightFlips | None) -> Observations:
    return batch if flips is None else undo_flips(batch, flips)[0]


def _errors(batch: Observations, found: PoseEstimate) -> Float[Tensor, "B V J"]:
    return reprojection_error(batch.cameras, batch.key_points, found.points)


def _held_out(
    batch: Observations, estimate: Estimate
) -> tuple[Float[Tensor, "B V J"], Bool[Tensor, "B V J"]]:
    """For each view the distance of its key points from the joints that the others give, and where
    there is one.
    """
    errors = []
    counted = []
    for view in range(batch.valid.shape[1]):
        valid = batch.valid.clone()
        valid[:, view] = False
        found = estimate(replace(batch, valid=valid))
        error = _errors(batch, found)[:, view]
        errors.append(error)
        counted.append(batch.valid[:, view] & found.estimated & error.isfinite())
    return torch.stack(errors, dim=1), torch.stack(counted, dim=1)


def _scales(
    parts: list[Observations],
    error: Float[Tensor, "T V J"],
    measured: Bool[Tensor, "T V J"],
    held: list[Tensor],
    counted: list[Tensor],
    names: tuple[str, ...],
) -> Numbers:
    """Median errors in left-out views, in sizes of the person in the image; where two views leave
    none, ``all`` is None and those of the views are reprojection errors. None for fewer than
    ``_LEAST`` key points.
    """
    size = torch.cat([person_scale(part.key_points, part.valid) for part in parts])[
        ..., None
    ].double()
    left_out = torch.cat(held)
    there = torch.cat(counted) & (size > 0)
    some = int(there.sum()) >= _LEAST
    values, known = (left_out, there) if some else (error, measured & (size > 0))
    relative = values / size.clamp(min=1e-12)

    def middle(of: Tensor) -> float | None:
        return float(of.median()) if len(of) >= _LEAST else None

    views = {name: middle(relative[:, v][known[:, v]]) for v, name in enumerate(names)}
    return {"all": middle(relative[known]) if some else None, "views": views}


def _by_view(
    errors: Float[Tensor, "T V J"], counted: Bool[Tensor, "T V J"], names: tuple[str, ...]
) -> Numbers:
    views = {name: quantiles(errors[:, v][counted[:, v]]) for v, name in enumerate(names)}
    return quantiles(errors[counted]) | {"views": views}


def quantiles(errors: Float[Tensor, " N"]) -> Numbers:
    """Median and 90 %, the lower of two; None of nothing."""
    if not len(errors):
        return {"median": None, "p90": None, "count": 0}
    ordered = errors.sort().values
    middle, late = (float(ordered[int(q * (len(errors) - 1))]) for q in (0.5, 0.9))
    return {"median": middle, "p90": late, "count": len(errors)}
