"""The rig beside the extrinsics in the cameras' file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.check.evidence import gather
from ghpt.calibration.check.setup import setup_of
from ghpt.calibration.comparison import align, rig_difference
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.commands.calibration.case import Case, spread_rows
from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.calibration.solution import RigSolution
from ghpt.commands.time import calibrate_people
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.observations import Recording
from ghpt.report.calibration import Differences

_ESTIMATED = "estimated"


def compare_halves(
    case: Case, solution: RigSolution, calibration: RigCalibration, settings: CalibrateSettings
) -> dict[str, list[Recording]]:
    """Return both halves of the recording, as each calibration sees them, by its name.

    The rig of a half is calibrated from the *other* one: of the key points that it was fitted to
    any rig explains too much. Nothing is returned unless both halves place the same cameras.
    """
    count = len(case.sequence)
    placed = solution.placed
    rows = [np.arange(count // 2), np.arange(count // 2, count)]
    seen = [spread_rows(half, settings.evaluated_frames // 2) for half in rows]
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


def difference(
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


def check_reference(
    case: Case, camera_check: CameraCheck, estimate: RigEstimate | None = None
) -> tuple[Finding, ...]:
    """Return what the camera check finds in the user's own extrinsics.

    ``estimate``: the rig from the people, by which it tells what has moved.
    They are warnings: the calibrated rig does not rest on these extrinsics.
    """
    cameras = case.sequence.cameras
    if not case.is_own or not cameras.calibrated:
        return ()
    try:
        evidence = gather(case.sequence, camera_check.frames, camera_check.shift)
    except GhptDataError:  # no frame shows enough: nothing can be told
        return ()
    findings = camera_check(evidence, setup_of(cameras), estimate).findings
    return tuple(replace(found, severity=Severity.WARNING) for found in findings)
