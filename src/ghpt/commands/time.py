"""The time of the user's views: as the camera file says it, or from the people in view."""

from __future__ import annotations

import logging
from collections.abc import Sequence as Items

import numpy as np
import torch

from ghpt.calibration.check.recording_time import (
    estimate_time,
    timeline_of_sequence,
    unknown_time,
)
from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.calibration.time.estimation import TimeEstimate, TimeEstimation
from ghpt.calibration.time.uncalibrated import UncalibratedShifts
from ghpt.calibration.uncertainty import LensErrors
from ghpt.clock import Clock
from ghpt.commands.inputs import InputSettings, own_detector_sequences, own_sequence
from ghpt.data.people.detections import Detections
from ghpt.data.people.matching import match_views
from ghpt.data.people.retimed import retime, shift_detections
from ghpt.data.people.sequence import Rows, Sequence
from ghpt.errors import check
from ghpt.geometry.cameras import CameraSet

TIMES = ("file", "estimate", "none")
"""Where the time of the views comes from: the camera file, the people in view, the numbers of the
frames alone.
"""
_SMOOTH = 3
_log = logging.getLogger(__name__)


def check_time(time: str) -> None:
    """Raise GhptConfigError for another word than `TIMES`."""
    check(time in TIMES, "time", f"is {time!r}", f"Choose from {', '.join(TIMES)}.")


def clock_of(time: str, sequence: Sequence, estimation: TimeEstimation) -> Clock:
    """Return when the views' frames were taken, and say what is not as their numbers say."""
    check_time(time)
    synchronised = Clock.synchronised(len(sequence.cameras))
    if time == "none":
        return synchronised
    if time == "file":
        return sequence.cameras.clock or synchronised
    estimate = estimate_time(sequence, estimation)
    log_time(sequence.cameras.names, estimate)
    return estimate.clock


def people_in_one_time(
    inputs: InputSettings,
    people: Detections,
    cameras: CameraSet,
    person: int | None,
    estimation: TimeEstimation,
) -> list[Sequence]:
    """Return everybody with all key points of the detector, and all views in one time.

    ``person`` is the one who is wanted alone.

    Who is tracked best in each view tells the time. Views are shifted by whole frames before people
    are told apart across them, and by parts of a frame afterwards.
    """
    check_time(inputs.time)
    if inputs.time != "estimate" and (inputs.time == "none" or cameras.clock is None):
        return own_detector_sequences(inputs, people, cameras, person)
    tracked = own_sequence(inputs, people, cameras, person=None)
    whole, rest = clock_of(inputs.time, tracked, estimation).split()
    at, _ = match_views(people.path, people.views, cameras, inputs.match, inputs.views)
    by = np.zeros(len(people.views), np.int64)
    by[at] = whole
    shifted = shift_detections(people, by)
    found = own_detector_sequences(inputs, shifted, cameras, person)
    return [retime(sequence, rest) for sequence in found]


def log_time(names: tuple[str, ...], estimate: TimeEstimate) -> None:
    """Say what was found of the time of the views."""
    clock = estimate.clock
    for view, name in enumerate(names):
        if (clock.rate[view], clock.shift[view]) == (1, 0):
            continue
        own = "n" if clock.rate[view] == 1 else f"{clock.rate[view]:g} n"
        spread = "whole frames" if estimate.whole else f"± {estimate.std[view]:.2f} frames"
        shift = clock.shift[view]
        _log.info("Time: frame %s%+.2f of %s is the rig's frame n (%s).", own, shift, name, spread)
    for finding in unknown_time(names, estimate):
        _log.warning("%s.", finding.text)
    if estimate.is_synchronised and any(estimate.determined):
        _log.info("The views are of one time, as far as can be told.")


def time_of_rig(
    sequence: Sequence,
    calibration: RigCalibration,
    starts: UncalibratedShifts,
    estimation: TimeEstimation,
    seed: int,
) -> TimeEstimate:
    """Return when the frames of views without extrinsics were taken.

    Whole frames come from essential matrices; a rig of the views in that time then tells parts of
    a frame, and what is determined at all.
    """
    views = len(sequence.cameras)
    timeline = timeline_of_sequence(sequence, estimation.frames)
    whole = starts(timeline.smooth(_SMOOTH), seed)
    begun = Clock((1.0,) * views, tuple(whole.shift.double().tolist()))
    rig = calibrate_sequence(calibration, retime(sequence, begun), seed)
    placed = [view for view, is_placed in enumerate(rig.calibrated.tolist()) if is_placed]
    if len(placed) < 2:
        return TimeEstimate.unknown(views)
    found = estimation(timeline.select(placed), rig.cameras.index(placed))
    return found.among(placed, views)


def calibrate_sequence(calibration: RigCalibration, sequence: Sequence, seed: int) -> RigEstimate:
    """Return the rig that a recording of one person shows."""
    return calibrate_people(calibration, (sequence,), seed)


def calibrate_people(
    calibration: RigCalibration,
    people: Items[Sequence],
    seed: int,
    rows: Rows | None = None,
    lenses: LensErrors | None = None,
) -> RigEstimate:
    """Return the rig that everybody shows whose sequences these are, in some frames or in all.

    ``lenses``: what is not known of the cameras' intrinsics.
    """
    cameras = people[0].cameras
    parts = [sequence.undistorted(rows) for sequence in people]
    frames = people[0].frame if rows is None else people[0].frame[rows]
    frame = np.tile(frames, len(people))
    person = np.repeat(np.arange(len(people)), len(frames))
    pixels = np.concatenate([part.pixels for part in parts])
    confidence = np.concatenate([part.confidence for part in parts])
    valid = np.concatenate([part.valid for part in parts])
    order = np.lexsort((person, frame))
    if len(people) > 1:
        # what two views alone see of a bystander any rig explains: it would only dilute the rest
        least = min(3, len(cameras))
        order = order[valid[order].any(-1).sum(-1) >= least]
    return calibration(
        cameras.names,
        cameras.K,
        torch.from_numpy(pixels[order]).double(),
        torch.from_numpy(confidence[order]).double(),
        torch.from_numpy(valid[order]),
        cameras.size,
        seed,
        torch.from_numpy(frame[order]),
        torch.from_numpy(person[order]),
        people[0].skeleton,
        lenses,
    )
