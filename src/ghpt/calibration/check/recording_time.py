"""The time of a recording's views, as every command asks for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ghpt.calibration.check.agreement import agreement
from ghpt.calibration.check.camera_check import CameraCheck, pixels_of
from ghpt.calibration.check.evidence import gather
from ghpt.calibration.check.setup import RayCache, setup_of
from ghpt.calibration.findings import Finding
from ghpt.calibration.mistakes import FRAME_RATE, OUT_OF_SYNC, TIME_UNKNOWN
from ghpt.calibration.time.estimation import TimeEstimate, TimeEstimation
from ghpt.calibration.time.timeline import Timeline, timeline_of
from ghpt.clock import Clock
from ghpt.data.people.retimed import retime
from ghpt.data.people.sequence import Sequence


@dataclass(frozen=True)
class TimedRecording:
    """A recording in one time."""

    sequence: Sequence
    clock: Clock
    """What was undone."""
    findings: tuple[Finding, ...]
    """The views whose frames were taken at other times than their numbers say."""
    given_px: tuple[float, ...] = ()
    """The held-out error of each view before, pixels; empty where nothing was undone."""


def timeline_of_sequence(sequence: Sequence, most: int) -> Timeline:
    """Return the key points of the middle ``most`` frames by the numbers of the frames."""
    first = max(0, (len(sequence) - most) // 2)
    rows = np.arange(first, min(first + most, len(sequence)))
    shown = sequence.as_joints() if sequence.skeleton.has_joints else sequence
    points = shown.undistorted(rows)
    K = sequence.cameras.K
    return timeline_of(K, points.pixels, points.valid, sequence.frame[rows], most)


def estimate_time(sequence: Sequence, estimation: TimeEstimation) -> TimeEstimate:
    """Return when the frames of the views of a calibrated rig were taken."""
    timeline = timeline_of_sequence(sequence, estimation.frames)
    return estimation(timeline, sequence.cameras.cameras)


@torch.no_grad()
def in_one_time(sequence: Sequence, camera_check: CameraCheck) -> TimedRecording:
    """Return the recording in one time, where the people in view say that it is not.

    What does not bring the views together is not undone, and not said. Raises GhptDataError where
    no frame shows enough.
    """
    estimate = estimate_time(sequence, camera_check.time)
    nothing = TimedRecording(sequence, Clock.synchronised(len(sequence.cameras)), ())
    if estimate.is_synchronised:
        return nothing
    retimed = retime(sequence, estimate.clock)
    before, before_px = _errors(sequence, camera_check)
    after, after_px = _errors(retimed, camera_check)
    if after >= before:
        return nothing
    findings = [
        replace(found, before_px=before_px[view], after_px=after_px[view], mended=True)
        for view, found in time_findings(sequence.cameras.names, estimate).items()
    ]
    return TimedRecording(retimed, estimate.clock, tuple(findings), tuple(before_px))


def time_findings(names: tuple[str, ...], estimate: TimeEstimate) -> dict[int, Finding]:
    """Return what is wrong with the time of each view where anything is."""
    found = {}
    for view, name in enumerate(names):
        rate = estimate.clock.rate[view]
        shift = round(estimate.clock.shift[view], 2)
        if rate != 1:
            found[view] = FRAME_RATE.finding((name,), rate)
        elif shift:
            found[view] = OUT_OF_SYNC.finding((name,), shift)
    return found


def unknown_time(names: tuple[str, ...], estimate: TimeEstimate) -> tuple[Finding, ...]:
    """Return a warning of the views whose time cannot be told; empty where all can."""
    unknown = tuple(
        name for name, known in zip(names, estimate.determined, strict=True) if not known
    )
    return (TIME_UNKNOWN.finding(unknown),) if unknown else ()


def _errors(sequence: Sequence, camera_check: CameraCheck) -> tuple[float, list[float]]:
    """Return the mean held-out error of the views, in sizes of the person, and each in pixels."""
    cache = RayCache(gather(sequence, camera_check.frames, 0))
    setup = setup_of(sequence.cameras)
    limits = camera_check.thresholds
    found = agreement(cache, setup, limits.estimator, limits.level, limits.pairs)
    return found.cost, pixels_of(cache, setup, found.error).tolist()
