"""What of the cameras is not known and is estimated first: their time and their focal lengths."""

from __future__ import annotations

from dataclasses import replace

import torch

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.check.recording_time import unknown_time
from ghpt.calibration.intrinsics import IntrinsicsEstimation
from ghpt.calibration.rig import RigCalibration
from ghpt.calibration.time.uncalibrated import UncalibratedShifts
from ghpt.commands.calibration.case import Case
from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.time import clock_of, log_time, time_of_rig
from ghpt.config import build
from ghpt.data.people.persons import with_lenses
from ghpt.data.people.retimed import retime


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
