"""What a reconstruction is worth, without a truth.

Coverage, reprojection, errors in held-out views, and how constant the lengths of bones are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.comparison import BoneVariation, ViewErrors, bone_variations, view_errors
from ghpt.data.people.sequence import Sequence
from ghpt.geometry.cameras import reprojection_error
from ghpt.models.estimators.classical import person_scale
from ghpt.models.estimators.flips import LeftRightFlips, undo_flips
from ghpt.models.estimators.predictors import Estimate
from ghpt.models.estimators.trajectory.disjoint import DisjointTest
from ghpt.models.estimators.trajectory.windows import RUN, spread_runs
from ghpt.models.relative_pose.scale import MEASURED_FRAMES, stature
from ghpt.observations import Observations, PoseEstimate
from ghpt.reconstruction import FILE_STATES, Reconstruction, State
from ghpt.report.course_figure import ViewCourse
from ghpt.skeleton import JOINTS, Skeleton

_LEAST = 20
"""Key points for a median that a verdict may rest on."""


@dataclass(frozen=True)
class Coverage:
    """What all frames of a reconstruction hold."""

    frames: int
    share: dict[str, float]
    """Share of the joints in each state."""
    observed: dict[str, float]
    """Share of the frames in which each joint is observed."""
    completeness: float
    """Mean of ``observed`` over the body's joints that are observed at all, and over the frames
    from the first with such a joint to the last; 0 without any.
    """
    swapped: dict[str, int]
    """Number of the frames in which each view had left and right exchanged."""
    stature_mm: float | None
    """The person's height; None where no bone is observed."""


@dataclass(frozen=True)
class ScaledErrors:
    """Median errors in held-out views, in sizes of the person in the image.

    None where fewer than ``_LEAST`` key points tell it.
    """

    all: float | None
    """None where two views leave none to hold out: ``views`` are then reprojection errors."""
    views: dict[str, float | None]


@dataclass(frozen=True)
class EstimatorErrors:
    """What an estimator's joints are worth."""

    reprojection: ViewErrors
    held_out: ViewErrors
    """In views that were held out, on the joints that all estimators estimate without them."""
    segments: BoneVariation
    placed: float
    """Share of the joints that have a position."""
    scales: ScaledErrors


@dataclass(frozen=True)
class Evaluation:
    """Estimators compared on the same frames of a recording."""

    frames: int
    estimators: dict[str, EstimatorErrors]
    ellipsoids: tuple[float, ...] | None = None
    """Share of the differences between two halves of the views that are within the ellipsoids of
    50, 90 and 95 % of their covariances; None where that cannot be told.
    """


def measure_coverage(
    chunks: Iterator[Reconstruction], joints: tuple[str, ...], views: tuple[str, ...], total: int
) -> Coverage:
    """Return what the ``total`` frames of a reconstruction hold."""
    frames = 0
    states = torch.zeros(len(joints), len(FILE_STATES), dtype=torch.int64)
    flipped = torch.zeros(len(views), dtype=torch.int64)
    step = max(1, -(-total // MEASURED_FRAMES))
    points = []
    observed = []
    body = [joints.index(name) for name in JOINTS if name in joints] or list(range(len(joints)))
    present = []
    for chunk in chunks:
        measured = slice(-frames % step, None, step)
        points.append(chunk.points[measured].double())
        observed.append(chunk.state[measured] == State.OBSERVED)
        present.append((chunk.state[:, body] == State.OBSERVED).any(1))
        frames += len(chunk)
        counts = [(chunk.state == state).sum(0) for state in FILE_STATES]
        states += torch.stack(counts, dim=1)
        flipped += chunk.flipped.sum(0)
    share = {}
    for state in FILE_STATES:
        count = float(states[:, state].sum())
        share[state.name.lower()] = count / max(frames * len(joints), 1)
    observed_share = (states[:, State.OBSERVED].double() / max(frames, 1)).tolist()
    joints17 = [joints.index(name) if name in joints else -1 for name in JOINTS]
    given = torch.tensor(joints17) >= 0
    height = float(
        stature(torch.cat(points)[:, joints17], torch.cat(observed)[:, joints17] & given)
    )
    return Coverage(
        frames=frames,
        share=share,
        observed=dict(zip(joints, observed_share, strict=True)),
        completeness=_completeness(states[body, State.OBSERVED], torch.cat(present)),
        swapped=dict(zip(views, flipped.tolist(), strict=True)),
        stature_mm=height or None,
    )


def _completeness(counts: Int[Tensor, " J"], present: Bool[Tensor, " T"]) -> float:
    """Return the share of joints that are observed. ``counts``: frames in which each joint is;
    ``present``: frames in which any is.
    """
    frames = present.nonzero()[:, 0]
    if not len(frames):
        return 0.0
    between = int(frames[-1] - frames[0]) + 1
    return float(counts[counts > 0].double().mean()) / between


@torch.no_grad()
def evaluate(
    sequence: Sequence,
    flips: LeftRightFlips | None,
    estimates: Mapping[str, Estimate],
    most: int,
    test_halves: Callable[[Observations], DisjointTest] | None = None,
) -> tuple[Evaluation, ViewCourse]:
    """Return the errors of each estimator on about so many frames: runs, evenly spread; and those
    of the first one in held-out views over time.

    ``flips``, which are of the sequence's skeleton, are undone for all estimators. ``test_halves``:
    how the covariances of the first one are tested.
    """
    rows = spread_runs(len(sequence), most)
    batches = []
    for start in range(0, len(rows), RUN):
        batch = sequence.read(rows[start : start + RUN])
        batches.append(batch if flips is None else undo_flips(batch, flips)[0])
    held_out = {name: _hold_out_views(batches, estimate) for name, estimate in estimates.items()}
    common = torch.stack([found.valid for found in held_out.values()]).all(0)
    names = sequence.cameras.names
    errors = {}
    for name, estimate in estimates.items():
        errors[name] = _estimator_errors(
            batches, estimate, held_out[name], common, names, sequence.skeleton
        )
    ellipsoids = None
    if test_halves is not None:
        test = DisjointTest(torch.cat([test_halves(batch).square for batch in batches]))
        ellipsoids = test.coverage() if test.is_decidable else None
    first = next(iter(held_out.values()))
    shown = torch.where(common, first.error.double(), torch.nan).nanmedian(-1).values
    course = ViewCourse(names, sequence.frame[rows].astype(np.float64), shown.numpy())
    return Evaluation(len(rows), errors, ellipsoids), course


@dataclass(frozen=True)
class _Errors:
    """Reprojection errors of key points, pixels, and which of them are measured."""

    error: Float[Tensor, "T V J"]
    valid: Bool[Tensor, "T V J"]


def _estimator_errors(
    batches: Items[Observations],
    estimate: Estimate,
    held_out: _Errors,
    common: Bool[Tensor, "T V J"],
    names: tuple[str, ...],
    skeleton: Skeleton,
) -> EstimatorErrors:
    found = [estimate(batch) for batch in batches]
    points = torch.cat([poses.points.double() for poses in found])
    estimated = torch.cat([poses.estimated for poses in found])
    pairs = zip(batches, found, strict=True)
    error = torch.cat([_reprojection(batch, poses) for batch, poses in pairs])
    valid = torch.cat([batch.valid for batch in batches])
    own = _Errors(error, valid & estimated[:, None] & error.isfinite())
    return EstimatorErrors(
        reprojection=view_errors(own.error, own.valid, names),
        held_out=view_errors(held_out.error, common, names),
        segments=bone_variations(points, estimated, skeleton),
        placed=float(estimated.double().mean()),
        scales=_scaled_errors(batches, own, held_out, names),
    )


def _reprojection(batch: Observations, found: PoseEstimate) -> Float[Tensor, "B V J"]:
    return reprojection_error(batch.cameras, batch.key_points, found.points)


def _hold_out_views(batches: Items[Observations], estimate: Estimate) -> _Errors:
    """Return for each view the distance of its key points from the joints that the others give."""
    parts = [_hold_out_in_batch(batch, estimate) for batch in batches]
    error = torch.cat([part.error for part in parts])
    return _Errors(error, torch.cat([part.valid for part in parts]))


def _hold_out_in_batch(batch: Observations, estimate: Estimate) -> _Errors:
    errors = []
    measured = []
    for view in range(batch.valid.shape[1]):
        others = batch.valid.clone()
        others[:, view] = False
        found = estimate(replace(batch, valid=others))
        error = _reprojection(batch, found)[:, view]
        errors.append(error)
        measured.append(batch.valid[:, view] & found.estimated & error.isfinite())
    return _Errors(torch.stack(errors, dim=1), torch.stack(measured, dim=1))


def _scaled_errors(
    batches: Items[Observations], own: _Errors, held_out: _Errors, names: tuple[str, ...]
) -> ScaledErrors:
    scales = [person_scale(batch.key_points, batch.valid) for batch in batches]
    scale = torch.cat(scales)[..., None].double()
    measured = held_out.valid & (scale > 0)
    enough = int(measured.sum()) >= _LEAST
    error = held_out.error
    if not enough:
        error = own.error
        measured = own.valid & (scale > 0)
    relative = error / scale.clamp(min=1e-12)
    views = {name: _median(relative[:, view][measured[:, view]]) for view, name in enumerate(names)}
    return ScaledErrors(_median(relative[measured]) if enough else None, views)


def _median(values: Float[Tensor, " N"]) -> float | None:
    return float(values.median()) if len(values) >= _LEAST else None
