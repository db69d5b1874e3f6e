"""How well a calibration explains a recording, and how far two calibrations of one rig differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.rotations import nearest_rotation, rotation_angle
from ghpt.geometry.similarity import Similarity
from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.observations import Observations, Recording
from ghpt.skeleton import HUMAN36M, Skeleton

_FRAMES = 256
"""Frames that are triangulated at once."""
_ITERATIONS = 100
_SMALLEST_ANGLE = 1e-4
"""Radians; a rotation that differs by less weighs no more in `align_robustly`."""
_SMALLEST_SHARE = 1e-5
"""Of the rig's size; a centre that differs by less weighs no more in `align_robustly`."""


def align(cameras: Cameras, reference: Cameras, rigid: bool = False) -> Similarity:
    """Return the similarity (with scale 1 if ``rigid``) that brings a rig onto a reference rig with
    the same V >= 2 cameras.

    Its rotation is the mean (chordal) of the cameras' own; scale and translation then fit the
    centres in least squares. The scale is 1 where the centres of either rig coincide.
    """
    equal = torch.ones(len(cameras.R), dtype=cameras.R.dtype)
    R = _mean_rotation(cameras, reference, equal)
    return _fit_centres(cameras, reference, R, equal, rigid)


def align_robustly(cameras: Cameras, reference: Cameras) -> Similarity:
    """Return the similarity that brings a rig onto a reference rig, whatever a minority of cameras
    says.

    Its rotation has the least sum of chordal distances, not of their squares, to the cameras' own;
    scale and translation then leave the least sum of distances between the centres. So a camera
    that differs does not move the others, and its own difference is not shared among them.
    """
    equal = torch.ones(len(cameras.R), dtype=cameras.R.dtype)
    R = _mean_rotation(cameras, reference, equal)
    for _ in range(_ITERATIONS):
        chord = (reference.R @ R - cameras.R).flatten(1).norm(dim=-1)
        R = _mean_rotation(cameras, reference, 1 / chord.clamp(min=_SMALLEST_ANGLE))
    similarity = _fit_centres(cameras, reference, R, equal)
    target = reference.centre
    size = (target - target.mean(0)).norm(dim=-1).mean()
    smallest = float((_SMALLEST_SHARE * size).clamp(min=1e-9))
    for _ in range(_ITERATIONS):
        distance = (similarity.points(cameras.centre) - target).norm(dim=-1)
        weight = 1 / distance.clamp(min=smallest)
        similarity = _fit_centres(cameras, reference, R, weight)
    return similarity


def _mean_rotation(
    cameras: Cameras, reference: Cameras, weight: Float[Tensor, " V"]
) -> Float[Tensor, "3 3"]:
    own = reference.R.mT @ cameras.R
    return nearest_rotation((weight[:, None, None] * own).sum(0))


def _fit_centres(
    cameras: Cameras,
    reference: Cameras,
    R: Float[Tensor, "3 3"],
    weight: Float[Tensor, " V"],
    rigid: bool = False,
) -> Similarity:
    """Return the similarity of this rotation that fits the centres in weighted least squares."""
    w = weight[:, None]
    source = cameras.centre @ R.mT
    target = reference.centre
    source_mean = (w * source).sum(0) / weight.sum()
    target_mean = (w * target).sum(0) / weight.sum()
    a = source - source_mean
    b = target - target_mean
    variance = float((w * a * a).sum())
    product = float((w * a * b).sum())
    scale = 1.0
    if variance > 0 and product > 0 and not rigid:
        scale = product / variance
    return Similarity(R, scale, target_mean - scale * source_mean)


@dataclass(frozen=True)
class RigDifference:
    """Of an estimated rig from a reference rig, after `align_robustly`."""

    rotation_deg: Float[Tensor, " V"]
    centre_mm: Float[Tensor, " V"]
    """Between the centres, in the reference's millimetres."""
    scale: float
    """Size of the reference over the estimate's: 1 where both have the same millimetre."""


def rig_difference(cameras: Cameras, reference: Cameras) -> RigDifference:
    """Return what `align_robustly` leaves between two calibrations of one rig."""
    similarity = align_robustly(cameras, reference)
    moved = similarity.cameras(cameras)
    distance = torch.linalg.vector_norm(moved.centre - reference.centre, dim=-1)
    rotation = torch.rad2deg(rotation_angle(moved.R, reference.R))
    return RigDifference(rotation, distance, similarity.scale)


@dataclass(frozen=True)
class Quantiles:
    """Of errors in pixels; None of no errors."""

    median: float | None
    p90: float | None
    count: int


@dataclass(frozen=True)
class ViewErrors(Quantiles):
    """Errors of all views together, and of each."""

    views: dict[str, Quantiles]


@dataclass(frozen=True)
class BoneVariation:
    """How much the lengths of bones vary over the frames, as a fraction of them."""

    median: float | None
    each: dict[str, float | None]


@dataclass(frozen=True)
class Explanation:
    """How well a calibration explains a recording."""

    held_out: ViewErrors
    segments: BoneVariation


def explain(
    recordings: Mapping[str, Sequence[Recording]], estimator: Estimator
) -> dict[str, Explanation]:
    """Return how well each calibration explains key points, by name.

    The calibrations have the same parts of a recording, each perhaps with cameras of its own. The
    errors in held-out views (pixels) are over the joints that all of them estimate.
    """
    if not recordings:
        return {}
    held_out = {name: _errors_of_parts(parts, estimator) for name, parts in recordings.items()}
    measured = torch.stack([valid for _, valid in held_out.values()]).all(0)
    result = {}
    for name, parts in recordings.items():
        errors = view_errors(held_out[name][0], measured, parts[0].camera_names)
        found = [triangulate_recording(part, estimator) for part in parts]
        points, estimated = (torch.cat(each) for each in zip(*found, strict=True))
        result[name] = Explanation(errors, bone_variations(points, estimated))
    return result


def _errors_of_parts(
    parts: Sequence[Recording], estimator: Estimator
) -> tuple[Float[Tensor, "T V J"], Bool[Tensor, "T V J"]]:
    found = [held_out_errors(part, estimator) for part in parts]
    error, measured = (torch.cat(each) for each in zip(*found, strict=True))
    return error, measured


def view_errors(
    error: Float[Tensor, "T V J"], measured: Bool[Tensor, "T V J"], names: tuple[str, ...]
) -> ViewErrors:
    """Return the quantiles of the measured errors, of all views and of each."""
    each = {name: quantiles(error[:, v][measured[:, v]]) for v, name in enumerate(names)}
    every = quantiles(error[measured])
    return ViewErrors(every.median, every.p90, every.count, each)


def quantiles(errors: Float[Tensor, " N"]) -> Quantiles:
    """Return the median and the 90 % quantile, the lower of two values."""
    count = len(errors)
    if not count:
        return Quantiles(None, None, 0)
    ordered = errors.sort().values
    median = float(ordered[int(0.5 * (count - 1))])
    return Quantiles(median, float(ordered[int(0.9 * (count - 1))]), count)


def bone_variations(
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    skeleton: Skeleton = HUMAN36M,
) -> BoneVariation:
    """Return the variation of each bone's length by name; None for one that is never measured."""
    variation, known = bone_variation(points, estimated, skeleton)
    pairs = zip(variation.tolist(), known.tolist(), strict=True)
    each = [value if is_known else None for value, is_known in pairs]
    median = float(variation[known].median()) if known.any() else None
    names = BONE_NAMES if skeleton == HUMAN36M else map("_".join, skeleton.bone_names)
    return BoneVariation(median, dict(zip(names, each, strict=True)))


def triangulate_recording(
    recording: Recording, estimator: Estimator, without: int | None = None
) -> tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J"]]:
    """Return the recording's joints (world, mm) by ``estimator``, and which are estimated.

    ``without``: a view that is left out.
    """
    points = []
    estimated = []
    for first in range(0, len(recording), _FRAMES):
        rows = slice(first, first + _FRAMES)
        valid = torch.from_numpy(recording.valid[rows].copy())
        if without is not None:
            valid[:, without] = False
        count = len(valid)
        batch = Observations(
            index=torch.arange(first, first + count),
            recording=torch.zeros(count, dtype=torch.int64),
            cameras=recording.cameras.expand(count),
            key_points=torch.from_numpy(recording.key_points[rows]).double(),
            confidence=torch.from_numpy(recording.confidence[rows]).double(),
            valid=valid,
        )
        result = estimator(batch)
        points.append(result.points)
        estimated.append(result.estimated)
    return torch.cat(points), torch.cat(estimated)


def held_out_errors(
    recording: Recording, estimator: Estimator
) -> tuple[Float[Tensor, "T V J"], Bool[Tensor, "T V J"]]:
    """Return for each view the distance (pixels) of its key points from the joints that the *other*
    views give, and where there is one.

    There is one where the key point is valid in the view, and the joint estimated without it and
    in front of it.
    """
    errors = []
    measured = []
    key_points = torch.from_numpy(recording.key_points).double()
    for view in range(len(recording.camera_names)):
        points, estimated = triangulate_recording(recording, estimator, without=view)
        own = slice(view, view + 1)
        error = reprojection_error(recording.cameras.index(own), key_points[:, own], points)[:, 0]
        valid = torch.from_numpy(recording.valid[:, view])
        counted = estimated & valid & torch.isfinite(error)
        errors.append(torch.where(counted, error, 0.0))
        measured.append(counted)
    return torch.stack(errors, dim=1), torch.stack(measured, dim=1)


def bone_variation(
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    skeleton: Skeleton = HUMAN36M,
) -> tuple[Float[Tensor, " L"], Bool[Tensor, " L"]]:
    """Return how much each bone's length varies over the frames, and which bones are known.

    The variation is 1.4826 x the median deviation over the median; a bone is known that two frames
    or more show.
    """
    a, b = torch.tensor(skeleton.bones, dtype=torch.long).reshape(-1, 2).unbind(1)
    both = estimated[:, a] & estimated[:, b]
    length = (points[:, a] - points[:, b]).norm(dim=-1)
    length = torch.where(both, length, torch.nan)
    median = length.nanmedian(0).values
    deviation = 1.4826 * (length - median).abs().nanmedian(0).values
    known = (both.sum(0) >= 2) & (median > 0)
    safe_median = torch.where(known, median, 1.0)
    return torch.where(known, deviation / safe_median, 0.0), known
