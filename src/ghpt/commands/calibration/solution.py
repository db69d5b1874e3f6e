"""The rig that a case shows, from everybody in view, in millimetres and in its world."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.calibration.comparison import align, triangulate_recording
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.millimetres import RigScale, ScaleSource, in_millimetres, scale_findings
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.calibration.whose import attach_views
from ghpt.commands.calibration.case import Case, Crowd, spread_recording
from ghpt.commands.time import calibrate_people
from ghpt.data.people.pooled import among_cameras, pool_detectors
from ghpt.data.people.sequence import Sequence
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import MEASURED_FRAMES

_UPRIGHT = (
    "z along the people's upright, x where the first camera looks, the floor at their lowest ankles"
)


@dataclass(frozen=True)
class RigSolution:
    """A calibrated rig, in millimetres."""

    estimate: RigEstimate
    """In a world of its own."""
    people: tuple[Sequence, ...]
    """Those whom it was calibrated from."""
    scale: RigScale
    placed: list[int]
    """The calibrated views; none if they are fewer than two."""
    usable: list[int]
    """Those of them that no error concerns."""
    world: str
    """The world that the rig is written in, in words."""
    change: Similarity
    """The way there from the estimate's own."""

    @property
    def rig(self) -> Cameras:
        """All cameras, in the world that the rig is written in."""
        return self.change.cameras(self.estimate.cameras)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the rig and its scale."""
        return (*self.estimate.findings, *scale_findings(self.scale))


def solve_rig(
    case: Case,
    calibration: RigCalibration,
    estimator: Estimator,
    source: ScaleSource,
    seed: int,
) -> RigSolution:
    """Return the rig that a recording shows, with the length that ``source`` gives it."""
    people, estimate = _from_everybody(case, calibration, seed)
    placed = _placed_views(estimate)

    def measure(rig: Cameras) -> tuple[Tensor, Tensor]:
        used = _indices(usable_cameras(estimate)) or placed
        recording = spread_recording(case.recording(used, rig), MEASURED_FRAMES)
        return triangulate_recording(recording, estimator)

    estimate, scale = in_millimetres(estimate, source, measure)
    usable = _indices(usable_cameras(estimate))
    world, change = _choose_world(estimate, placed, case)
    return RigSolution(estimate, people, scale, placed, usable, world, change)


def _from_everybody(
    case: Case, calibration: RigCalibration, seed: int
) -> tuple[tuple[Sequence, ...], RigEstimate]:
    """Return the rig from the people who were followed, or from everybody whom that rig tells apart
    in the key points of all detectors; and who it was.
    """
    cameras = case.evidence.cameras
    in_one_time = cameras.clock is None or cameras.clock.is_synchronised
    followed: tuple[Sequence, ...] = (case.evidence,)
    if case.crowd is not None and in_one_time:
        # who stands in one place shows no rig: whoever else is there adds what is lacking
        followed = tuple(case.crowd.follow(cameras, calibration, seed))
    estimate = calibrate_people(calibration, followed, seed, lenses=case.lenses)
    if case.crowd is not None and in_one_time:
        estimate = _with_all_views(case.evidence, case.crowd, estimate, calibration, seed)
    whole = estimate.converged and bool(estimate.calibrated.all())
    alone = case.crowd is None and not case.more
    if alone or not in_one_time or not whole:
        return followed, estimate
    found = cameras.with_cameras(estimate.cameras)
    own = followed if case.crowd is None else case.crowd.persons(found)
    people = pool_detectors([own, *(crowd.persons(found) for crowd in case.more)])
    if len(people) < 2:
        return followed, estimate
    of_all = calibrate_people(calibration, people, seed, lenses=case.lenses)
    if not bool(of_all.calibrated.all()):
        return followed, estimate
    return people, of_all


def _with_all_views(
    evidence: Sequence,
    crowd: Crowd,
    estimate: RigEstimate,
    calibration: RigCalibration,
    seed: int,
) -> RigEstimate:
    """Return the rig with the views that the person who was followed does not link to the others,
    each linked by whomever it shows; the same rig if nobody does.
    """
    placed = _indices(estimate.calibrated)
    missing = _indices(~estimate.calibrated)
    if len(placed) < 2 or not missing:
        return estimate
    cameras = evidence.cameras.with_cameras(estimate.cameras)
    found = [among_cameras(person, evidence) for person in crowd.among(cameras, placed)]
    if not found:
        return estimate
    tracks = crowd.tracks(evidence.cameras)
    pairs = calibration.pairs
    people = attach_views(found, tracks, missing, pairs, calibration.noise, seed)
    tried = calibrate_people(calibration, people, seed)
    return tried if int(tried.calibrated.sum()) > len(placed) else estimate


def usable_cameras(estimate: RigEstimate) -> Bool[Tensor, " V"]:
    """Return the calibrated cameras that no error concerns: two or more, or none.

    An error that names no camera concerns all.
    """
    usable = estimate.calibrated.clone()
    for found in estimate.findings:
        if found.severity == Severity.ERROR:
            views = [estimate.names.index(name) for name in found.cameras]
            usable[views or slice(None)] = False
    return usable if int(usable.sum()) >= 2 else torch.zeros_like(usable)


def _placed_views(estimate: RigEstimate) -> list[int]:
    """Return the calibrated views; none if they are fewer than two."""
    views = _indices(estimate.calibrated)
    return views if len(views) >= 2 else []


def _indices(mask: Bool[Tensor, " V"]) -> list[int]:
    return torch.nonzero(mask)[:, 0].tolist()


def _choose_world(estimate: RigEstimate, placed: list[int], case: Case) -> tuple[str, Similarity]:
    """Return the world that the rig is written in, in words, and the way there."""
    reference = case.reference_cameras
    if reference is not None and placed:
        own = estimate.cameras.index(placed)
        return f"that of {case.reference}", align(own, reference.index(placed), rigid=True)
    cameras = estimate.cameras.index(placed or slice(None))
    return _UPRIGHT, upright(estimate.points, estimate.estimated, cameras)
