"""Calibration: from key points and intrinsics to a rig in the formats that others read."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.comparison import explain, triangulate_recording
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.millimetres import read_scale
from ghpt.calibration.mistakes import (
    FRAME_RATE,
    NOTHING_LINKED,
    OUT_OF_SYNC,
    SEVERAL_PEOPLE,
    UNLINKED,
)
from ghpt.calibration.rig import RigCalibration
from ghpt.commands.app import Command
from ghpt.commands.calibration.beside import check_reference, compare_halves, difference
from ghpt.commands.calibration.case import Case, of_one_person, open_case
from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.calibration.solution import RigSolution, solve_rig
from ghpt.commands.calibration.unknowns import in_one_time, with_intrinsics
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.next_commands import (
    EXAMPLE_HEIGHT,
    command_line,
    given_settings,
    prediction_by,
)
from ghpt.config import build
from ghpt.errors import GhptDataError
from ghpt.files import remove, sweep_temporaries
from ghpt.models.estimators.classical import Estimator
from ghpt.provenance import provenance
from ghpt.report.calibration import CalibrationResult, calibration_summary
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
_OF_TIME = (OUT_OF_SYNC.code, FRAME_RATE.code, UNLINKED.code, NOTHING_LINKED.code)
"""Findings that cameras which did not start together may explain."""
_log = logging.getLogger(__name__)


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
    halves = compare_halves(case, solution, calibration, settings)
    findings = _findings(case, solution, camera_check)
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
        difference=difference(estimate, rig, reference, placed),
        explains=explain(halves, estimator),
        findings=findings,
        provenance=provenance(settings.seed),
        command=_next_command(settings, bool(usable), findings, output),
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


def _next_command(
    settings: CalibrateSettings, has_rig: bool, findings: Sequence[Finding], output: Path
) -> str:
    """Return what to type after the calibration: predict by the rig, or calibrate better, in one
    time where the cameras' clocks may be to blame.
    """
    if has_rig:
        return prediction_by(settings, output, cameras=output / "rig.toml")
    given = given_settings(settings) | _own_settings(settings)
    if any(found.code in _OF_TIME for found in findings):
        given["time"] = "estimate"
    return command_line("calibrate.py", given, f"{display_path(output)}_calibrated")


def _own_settings(settings: CalibrateSettings) -> dict[str, object]:
    """Return what was given of the settings that calibrate.py alone has and that a next run needs;
    a body height where no length was given.
    """
    scale = settings.scale
    lengths = {
        "scale.height": scale.height,
        "scale.segments": scale.segments,
        "scale.baseline": scale.baseline,
    }
    own: dict[str, object] = {key: value for key, value in lengths.items() if value is not None}
    own = own or {"scale.height": EXAMPLE_HEIGHT}
    if settings.image_size is not None:
        own["image_size"] = settings.image_size
    if settings.more_keypoints:
        own["more_keypoints"] = settings.more_keypoints
    return own


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


def _findings(case: Case, solution: RigSolution, camera_check: CameraCheck) -> tuple[Finding, ...]:
    """Return what is wrong with the recording, the rig, and the extrinsics in the user's file."""
    notes = case.notes
    if len(solution.people) > 1:  # nobody had to be chosen
        notes = tuple(found for found in notes if found.code != SEVERAL_PEOPLE.code)
    own = (*notes, *solution.findings)
    said = {(found.code, frozenset(found.cameras)) for found in own}
    of_file = [
        found
        for found in check_reference(case, camera_check, solution.estimate)
        if (found.code, frozenset(found.cameras)) not in said
    ]
    return (*own, *of_file)


COMMAND = Command(
    name="calibrate", settings=CalibrateSettings, task=calibrate, summary=summary, files=files
)


if __name__ == "__main__":
    run_by_name("calibrate")
