"""Calibration: from key points and intrinsics to a rig in the formats that others read."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.check.evidence import gather
from ghpt.calibration.check.recording_time import unknown_time
from ghpt.calibration.check.setup import setup_of
from ghpt.calibration.comparison import (
    align,
    explain,
    rig_difference,
    triangulate_recording,
)
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.intrinsics import IntrinsicsEstimation
from ghpt.calibration.millimetres import (
    RigScale,
    ScaleSettings,
    ScaleSource,
    in_millimetres,
    read_scale,
    scale_findings,
)
from ghpt.calibration.mistakes import SEVERAL_PEOPLE
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.calibration.time.uncalibrated import UncalibratedShifts
from ghpt.calibration.uncertainty import LensErrors
from ghpt.calibration.whose import attach_views, one_person
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.inputs import (
    InputSettings,
    own_cameras,
    own_people,
    own_title,
    recording_sequence,
    resolve_unit,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.next_commands import commands_on, prediction_by
from ghpt.commands.time import calibrate_people, clock_of, log_time, time_of_rig
from ghpt.config import Target, build, suggest
from ghpt.data.formats.names import Name
from ghpt.data.people.detections import Detections
from ghpt.data.people.matching import match_views
from ghpt.data.people.persons import (
    detector_sequence,
    detector_sequences,
    tracks_of_views,
    with_lenses,
)
from ghpt.data.people.pooled import among_cameras, pool_detectors
from ghpt.data.people.retimed import retime
from ghpt.data.people.sequence import Rows, Sequence
from ghpt.errors import GhptDataError, check
from ghpt.files import remove, sweep_temporaries
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import MEASURED_FRAMES
from ghpt.observations import Recording
from ghpt.provenance import provenance
from ghpt.report.calibration import CalibrationResult, Differences, calibration_summary
from ghpt.report.rig_figure import DrawnPerson, DrawnRig
from ghpt.report.rig_files import (
    RIG_FILES,
    calibrated_cameras,
    write_poses,
    write_result,
    write_rig,
)
from ghpt.report.terminal import print_document

_REPORTS = ("calibration.json", "report.md", "report.html", "rig.png", "rig.svg")
_ESTIMATED = "estimated"
_UPRIGHT = (
    "z along the people's upright, x where the first camera looks, the floor at their lowest ankles"
)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(InputSettings):
    """The settings of calibrate.py."""

    scale: ScaleSettings
    calibration: Target
    baselines: dict[str, Target]
    camera_check: Target
    estimator: str
    start_times: Target
    intrinsics: Target
    image_size: list[int] | None
    more_keypoints: list[str] | None
    evaluated_frames: int
    seed: int

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = self.evaluated_frames
        check(frames >= 1, "evaluated_frames", f"is {frames}", "Give 1 or more.")
        if self.image_size is not None:
            sane = len(self.image_size) == 2 and min(self.image_size) > 0
            example = "Give width and height: image_size=[1920,1080]."
            check(sane, "image_size", f"is {self.image_size}", example)
            hint = "Give the image size or the cameras' file."
            check(not self.cameras, "image_size", "is given beside cameras", hint)
        hint = "Name the first detector's key points: keypoints=pose/"
        alone = bool(self.more_keypoints) and not self.keypoints
        check(not alone, "more_keypoints", "is given without keypoints", hint)
        name = self.estimator
        hint = suggest(name, self.baselines)
        check(name in self.baselines, "estimator", f"is {name!r}", hint)


@dataclass(frozen=True)
class Crowd:
    """Detections of several people, who are told apart once a rig is known."""

    people: Detections
    match: dict[Name, Name] | None
    views: list[Name] | None

    def follow(self, cameras: CameraSet, calibration: RigCalibration, seed: int) -> Sequence:
        """Return one person, the same in all views, whose cameras need no extrinsics."""
        tracks = self.tracks(cameras)
        return one_person(tracks, calibration.pairs, calibration.noise, seed)

    def among(self, cameras: CameraSet, placed: list[int]) -> list[Sequence]:
        """Return everybody whom some calibrated cameras tell apart, the most visible first."""
        at, _ = match_views(self.people.path, self.people.views, cameras, self.match, self.views)
        views = [self.people.views[at[view]] for view in placed]
        return detector_sequences(self.people, cameras.select(placed), self.match, views)

    def tracks(self, cameras: CameraSet) -> list[Sequence]:
        """Return those whom each view follows by itself."""
        return tracks_of_views(self.people, cameras, self.match, self.views)

    def persons(self, cameras: CameraSet) -> list[Sequence]:
        """Return everybody whom calibrated cameras tell apart, the most visible first."""
        return detector_sequences(self.people, cameras, self.match, self.views)


@dataclass(frozen=True)
class Case:
    """What is calibrated, and what it can be compared with."""

    sequence: Sequence
    """The 17 joints."""
    evidence: Sequence
    """All key points of the detector, which the rig is calibrated from."""
    reference: str
    """What the extrinsics of the sequence's cameras, where there are any, are, in words.

    They are never used but for the comparison and the world.
    """
    is_own: bool
    """Whether they are the user's, which may be wrong."""
    notes: tuple[Finding, ...] = ()
    crowd: Crowd | None = None
    """Everybody's detections, where the views show several people."""
    more: tuple[Crowd, ...] = ()
    """What other detectors found of the same recording."""
    intrinsics: str | None = None
    """What was estimated of the intrinsics, in words; None where they were given."""
    lenses: LensErrors | None = None
    """What is not known of them."""

    @property
    def reference_cameras(self) -> Cameras | None:
        """The calibrated cameras to compare with, if there are any."""
        cameras = self.sequence.cameras
        return cameras.cameras if cameras.calibrated else None

    def recording(self, views: list[int], cameras: Cameras) -> Recording:
        """Return the recording as a calibration of some of its cameras sees it."""
        sequence = self.sequence.select_views(views)
        points = sequence.undistorted()
        return Recording(
            name=sequence.title,
            subject=sequence.title,
            action="unknown",
            rate_hz=sequence.rate_hz or float("nan"),
            camera_names=sequence.cameras.names,
            cameras=cameras.index(views),
            key_points=points.pixels,
            confidence=points.confidence,
            valid=points.valid,
            frame=sequence.frame,
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


def files(settings: CalibrateSettings) -> Files:
    """Return what a calibration reads and writes."""
    check_apart(settings.keypoints, settings.output)
    more = settings.more_keypoints or []
    root = settings.data.get("root")
    reads = input_paths(settings.cameras, settings.keypoints, *more, root)
    return Files(reads, (*RIG_FILES, *_REPORTS))


def calibrate(settings: CalibrateSettings, output: Path) -> CalibrationResult:
    """Calibrate the cameras of the user's key points, or of a recording of the data set.

    Writes calibration.json, report.md and the figure into ``output``, and of a usable rig
    `RIG_FILES`; prints the table. Raises GhptDataError after writing if a finding is an error: then
    only the cameras that it does not concern are in the rig's files, and with fewer than two there
    are none. Returns what calibration.json holds.
    """
    calibration: RigCalibration = build(settings.calibration, "calibration")
    name = settings.estimator
    estimator: Estimator = build(settings.baselines[name], f"baselines.{name}")
    camera_check: CameraCheck = build(settings.camera_check, "camera_check")
    case = of_one_person(open_case(settings, estimator), calibration, settings.seed)
    case = in_one_time(settings, case, calibration, camera_check)
    case = with_intrinsics(settings, case, calibration)
    cameras = case.sequence.cameras
    source = read_scale(settings.scale, cameras.names)
    sweep_temporaries(output)
    for file in RIG_FILES:  # of an earlier run: they must not pass for this one's
        remove(output / file)

    solution = solve_rig(case, calibration, estimator, source, settings.seed)
    estimate = solution.estimate
    scale = solution.scale
    placed = solution.placed
    usable = solution.usable
    change = solution.change
    rig = solution.rig
    reference = case.reference_cameras
    halves = _halves(case, solution, calibration, settings)
    result = CalibrationResult(
        data=case.sequence.title,
        source=case.sequence.source,
        cameras_file=cameras.path,
        frames=len(case.sequence),
        seed=settings.seed,
        scale=scale,
        intrinsics=case.intrinsics,
        world=solution.world,
        reference=None if reference is None else case.reference,
        triangulation=settings.estimator,
        converged=estimate.converged,
        usable=tuple(cameras.names[view] for view in usable),
        cameras=calibrated_cameras(estimate, change, cameras),
        evidence=estimate.evidence,
        difference=_difference(estimate, rig, reference, placed),
        explains=explain(halves, estimator),
        findings=_findings(case, solution, camera_check),
        provenance=provenance(settings.seed),
        command=_next_command(settings, bool(usable), output),
    )
    points = change.points(estimate.points)
    estimated = estimate.estimated
    if usable:
        recording = case.recording(usable, rig)
        points, estimated = triangulate_recording(recording, estimator)
        write_rig(output, cameras.select(usable).with_cameras(rig.index(usable)), result)
        write_poses(output / "poses.npz", recording, points, estimated, result)
    covariance = change.covariance(estimate.covariance)
    drawn = DrawnRig(cameras.names, rig, (DrawnPerson(points, estimated),), covariance)
    write_result(output, result, drawn, estimate.calibrated, reference)
    print_document(calibration_summary(result))
    beside = "the figure and the rig" if usable else "the figure"
    report = display_path(output / "report.html")
    _log.info("Report: %s, beside it %s.", report, beside)
    _raise_errors(result, report)
    return result


def _next_command(settings: CalibrateSettings, has_rig: bool, output: Path) -> str:
    """Return what to type after the calibration: predict by the rig, or calibrate better."""
    if has_rig:
        return prediction_by(settings, output, cameras=output / "rig.toml")
    return commands_on(settings, {}, output).calibrate


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
        recording = _spread(case.recording(used, rig), MEASURED_FRAMES)
        return triangulate_recording(recording, estimator)

    estimate, scale = in_millimetres(estimate, source, measure)
    usable = _indices(usable_cameras(estimate))
    world, change = _choose_world(estimate, placed, case)
    return RigSolution(estimate, people, scale, placed, usable, world, change)


def _from_everybody(
    case: Case, calibration: RigCalibration, seed: int
) -> tuple[tuple[Sequence, ...], RigEstimate]:
    """Return the rig from the person who was followed, or from everybody whom that rig tells apart
    in the key points of all detectors; and who it was.
    """
    followed = (case.evidence,)
    estimate = calibrate_people(calibration, followed, seed, lenses=case.lenses)
    cameras = case.evidence.cameras
    in_one_time = cameras.clock is None or cameras.clock.is_synchronised
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


def _halves(
    case: Case, solution: RigSolution, calibration: RigCalibration, settings: CalibrateSettings
) -> dict[str, list[Recording]]:
    """Return both halves of the recording, as each calibration sees them, by its name.

    The rig of a half is calibrated from the *other* one: of the key points that it was fitted to
    any rig explains too much. Nothing is returned unless both halves place the same cameras.
    """
    count = len(case.sequence)
    placed = solution.placed
    rows = [np.arange(count // 2), np.arange(count // 2, count)]
    seen = [_spread_rows(half, settings.evaluated_frames // 2) for half in rows]
    if not placed or not all(len(half) for half in seen):
        return {}
    rigs = []
    for other in reversed(rows):
        estimate = calibrate_people(calibration, solution.people, settings.seed, other)
        if not bool(estimate.calibrated[placed].all()):
            return {}
        own = estimate.cameras.index(placed)
        similarity = align(own, solution.rig.index(placed))
        rigs.append(similarity.cameras(estimate.cameras))
    found = {_ESTIMATED: rigs}
    if case.reference_cameras is not None:
        found[case.reference] = [case.reference_cameras] * 2
    return {
        name: [
            case.recording(placed, rig).frames(half) for rig, half in zip(own, seen, strict=True)
        ]
        for name, own in found.items()
    }


def _raise_errors(result: CalibrationResult, report: str) -> None:
    """Raise GhptDataError if a finding is an error."""
    errors = [found.text for found in result.findings if found.severity == Severity.ERROR]
    if errors:
        written = "no rig is written"
        if result.usable:
            written = f"only {', '.join(result.usable)} are in the rig's files"
        problem = f"{errors[0].rstrip('.')}; {written}"
        raise GhptDataError(result.source, "calibration", problem, f"See {report}.")


def summary(result: CalibrationResult) -> str:
    """Return the result in words."""
    errors = [
        camera.reprojection_px for camera in result.cameras if camera.reprojection_px is not None
    ]
    return f"{result.data}: {len(errors)} cameras, {max(errors):.1f} px at most"


def open_case(settings: CalibrateSettings, estimator: Estimator) -> Case:
    """Return the user's own key points and cameras, or without any a recording of the data set,
    whose true extrinsics serve the comparison alone.

    Extrinsics are in mm where the person tells their unit.
    """
    if not settings.keypoints:
        recording = recording_sequence(settings)
        return Case(recording, recording, "the truth", is_own=False)
    people = own_people(settings)
    cameras = _given_cameras(settings, people)
    people.skeleton.require_joints(people.path)
    wanted = (settings.match, settings.views, None, own_title(settings))
    evidence = detector_sequence(people, cameras, *wanted)
    evidence = replace(evidence, source=str(Path(str(settings.keypoints)).resolve()))
    sequence = resolve_unit(evidence.as_joints(), estimator, ask=False)
    notes = people_findings(people)
    own = "the file's own calibration"
    crowd = Crowd(people, settings.match, settings.views) if notes else None
    more = tuple(_other_detector(settings, path) for path in settings.more_keypoints or [])
    return Case(sequence, evidence, own, is_own=True, notes=notes, crowd=crowd, more=more)


def _other_detector(settings: CalibrateSettings, path: str) -> Crowd:
    """Return what another detector found of the same recording."""
    own = replace(settings, keypoints=path, format=None, skeleton=None, session=None)
    return Crowd(own_people(own), settings.match, settings.views)


def of_one_person(case: Case, calibration: RigCalibration, seed: int) -> Case:
    """Return the case with a person whom all views follow, where there are several."""
    if case.crowd is None:
        return case
    given = case.evidence
    found = case.crowd.follow(given.cameras, calibration, seed)
    evidence = replace(given, points=found.points)
    joints = evidence.as_joints()
    return replace(case, evidence=evidence, sequence=replace(case.sequence, points=joints.points))


def _given_cameras(settings: CalibrateSettings, people: Detections) -> CameraSet:
    """Return the user's cameras, or without a file first guesses by the size of the images."""
    if settings.image_size is None:
        cameras = own_cameras(settings, "intrinsics.toml, or image_size=[1920,1080]")
        return cameras.without_extrinsics() if cameras.unposed else cameras
    estimation: IntrinsicsEstimation = build(settings.intrinsics, "intrinsics")
    return estimation.guess_cameras(people.views, torch.tensor(settings.image_size))


def with_intrinsics(settings: CalibrateSettings, case: Case, calibration: RigCalibration) -> Case:
    """Return the case with estimated focal lengths where only the image size is known."""
    if settings.image_size is None:
        return case
    estimation: IntrinsicsEstimation = build(settings.intrinsics, "intrinsics")
    sequence = case.sequence
    points = sequence.detected()
    found = estimation(
        calibration,
        sequence.cameras,
        torch.from_numpy(points.pixels).double(),
        torch.from_numpy(points.confidence).double(),
        torch.from_numpy(points.valid),
        settings.seed,
    )
    cameras = replace(sequence.cameras, K=found.K, distortion=found.distortion)
    notes = (*case.notes, *found.findings)
    return replace(
        case,
        sequence=with_lenses(sequence, cameras),
        evidence=with_lenses(case.evidence, cameras),
        notes=notes,
        intrinsics=found.text,
        lenses=found.errors,
    )


def in_one_time(
    settings: CalibrateSettings, case: Case, calibration: RigCalibration, camera_check: CameraCheck
) -> Case:
    """Return the case with all views in one time, and the clock in its cameras."""
    sequence = case.sequence
    cameras = sequence.cameras
    notes = case.notes
    if settings.time == "estimate":
        starts: UncalibratedShifts = build(settings.start_times, "start_times")
        found = time_of_rig(sequence, calibration, starts, camera_check.time, settings.seed)
        log_time(cameras.names, found)
        notes += unknown_time(cameras.names, found)
        clock = found.clock
    else:
        clock = clock_of(settings.time, sequence, camera_check.time)
    timed = replace(cameras, clock=clock)
    return replace(
        case,
        sequence=replace(retime(sequence, clock), cameras=timed),
        evidence=replace(retime(case.evidence, clock), cameras=timed),
        notes=notes,
    )


def people_findings(people: Detections) -> tuple[Finding, ...]:
    """Return a warning where one of several people was followed."""
    crowded = people.crowded_frames()
    if not crowded:
        return ()
    frames = ", ".join(f"{count} frames of {view}" for view, count in crowded.items())
    most = max(crowded.values())
    return (SEVERAL_PEOPLE.finding(tuple(crowded), float(most), frames_of_views=frames),)


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


def _spread(recording: Recording, frames: int) -> Recording:
    """Return at most so many frames of a recording, evenly spread."""
    return recording.frames(_spread_rows(np.arange(len(recording)), frames))


def _spread_rows(rows: Rows, count: int) -> Rows:
    """Return at most so many of some rows, evenly spread."""
    if not len(rows):
        return rows
    at = np.linspace(0, len(rows) - 1, min(max(count, 1), len(rows)))
    return rows[np.unique(at.astype(int))]


def _choose_world(estimate: RigEstimate, placed: list[int], case: Case) -> tuple[str, Similarity]:
    """Return the world that the rig is written in, in words, and the way there."""
    reference = case.reference_cameras
    if reference is not None and placed:
        own = estimate.cameras.index(placed)
        return f"that of {case.reference}", align(own, reference.index(placed), rigid=True)
    cameras = estimate.cameras.index(placed or slice(None))
    return _UPRIGHT, upright(estimate.points, estimate.estimated, cameras)


def _difference(
    estimate: RigEstimate, rig: Cameras, reference: Cameras | None, placed: list[int]
) -> Differences | None:
    """Return how far the reference differs; None where the recording does not determine a rig."""
    of_all = [f for f in estimate.findings if f.severity == Severity.ERROR and not f.cameras]
    if reference is None or not placed or of_all:
        return None
    found = rig_difference(rig.index(placed), reference.index(placed))
    names = [estimate.names[view] for view in placed]
    rotation = dict(zip(names, found.rotation_deg.tolist(), strict=True))
    centre = dict(zip(names, found.centre_mm.tolist(), strict=True))
    return Differences(rotation, centre, found.scale)


def _findings(case: Case, solution: RigSolution, camera_check: CameraCheck) -> tuple[Finding, ...]:
    """Return what is wrong with the recording, the rig, and the extrinsics in the user's file."""
    notes = case.notes
    if len(solution.people) > 1:  # nobody had to be chosen
        notes = tuple(found for found in notes if found.code != SEVERAL_PEOPLE.code)
    own = (*notes, *solution.findings)
    said = {(found.code, frozenset(found.cameras)) for found in own}
    of_file = [
        found
        for found in check_reference(case, camera_check)
        if (found.code, frozenset(found.cameras)) not in said
    ]
    return (*own, *of_file)


def check_reference(case: Case, camera_check: CameraCheck) -> tuple[Finding, ...]:
    """Return what the camera check finds in the user's own extrinsics.

    They are warnings: the calibrated rig does not rest on these extrinsics.
    """
    cameras = case.sequence.cameras
    if not case.is_own or not cameras.calibrated:
        return ()
    try:
        evidence = gather(case.sequence, camera_check.frames, camera_check.shift)
    except GhptDataError:  # no frame shows enough: nothing can be told
        return ()
    findings = camera_check(evidence, setup_of(cameras)).findings
    return tuple(replace(found, severity=Severity.WARNING) for found in findings)


COMMAND = Command(
    name="calibrate", settings=CalibrateSettings, task=calibrate, summary=summary, files=files
)


if __name__ == "__main__":
    run_by_name("calibrate")
