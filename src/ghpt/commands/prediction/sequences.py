"""Who is predicted: the people in the user's files, or a recording of the data set."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.commands.inputs import (
    own_cameras,
    own_people,
    own_title,
    recording_sequence,
    resolve_unit,
)
from ghpt.commands.prediction.settings import PredictSettings
from ghpt.commands.time import clock_of, people_in_one_time
from ghpt.data.people.retimed import retime
from ghpt.data.people.sequence import Sequence
from ghpt.data.people.stored import open_stored, stored_sequence
from ghpt.models.estimators.joint_means import JointMeans, all_joints, human_joints
from ghpt.skeleton import Skeleton

_LEAST_FRAMES = 10
"""Of a person beside the first, seen by two views: fewer tell nothing of the noise."""
_FEW_JOINTS = (
    "%s: the key points give too few of the 17 joints by name: the size of the person, the cameras "
    "and exchanged sides are not checked (docs/skeletons.md)."
)
_log = logging.getLogger(__name__)


def open_sequences(settings: PredictSettings, camera_check: CameraCheck) -> list[Sequence]:
    """Return who is predicted: the people in the user's own key points, or a recording of the data
    set.

    The most visible person comes first, and tells the unit of length.
    """
    if not settings.keypoints:
        return [recording_sequence(settings)]
    found = _files_sequences(settings, camera_check)
    sequences = [needed_key_points(settings, sequence) for sequence in found]
    first = sequences[0]
    first.cameras.check_calibrated(first.source)
    first = resolve_unit(first, camera_check.consensus, ask=True)
    return [replace(sequence, cameras=first.cameras) for sequence in sequences]


def needed_key_points(settings: PredictSettings, sequence: Sequence) -> Sequence:
    """Return the sequence of those key points that the joints of the files are made of.

    Raises GhptDataError where the 17 joints are needed, and the detector gives too few of them.
    """
    skeleton = sequence.skeleton
    if settings.ckpt or settings.joints == "human36m":
        skeleton.require_joints(sequence.source)
    if not skeleton.has_joints:
        _log.warning(_FEW_JOINTS, sequence.source)
    if settings.joints == "detector":
        return sequence
    parts = np.flatnonzero(skeleton.joint_weights.any(0))
    return sequence.select_key_points(parts.tolist())


def _files_sequences(settings: PredictSettings, camera_check: CameraCheck) -> list[Sequence]:
    cameras = own_cameras(settings, "Calib.toml")
    cameras.check_calibrated(str(settings.cameras))
    if settings.format in (None, "npz") and settings.session is None:
        path = str(settings.keypoints)
        least = settings.least_confidence
        stored = open_stored(path, settings.skeleton, settings.rate_hz, least)
        if stored is not None:
            title = own_title(settings)
            sequence = stored_sequence(stored, cameras, settings.match, settings.views, title)
            return [retime(sequence, clock_of(settings.time, sequence, camera_check.time))]
    people = own_people(settings)
    found = people_in_one_time(settings, people, cameras, settings.person, camera_check.time)
    if settings.person is None:
        return _long_enough(found)
    crowded = people.crowded_frames()
    if crowded:
        words = ", ".join(f"{count} frames of {view}" for view, count in crowded.items())
        _log.warning("Several people are in %s: person %d is followed.", words, settings.person)
    return found


def _long_enough(found: list[Sequence]) -> list[Sequence]:
    """Return the first person, and those of the others who can be predicted, with their numbers."""
    frames = [int((each.detected().valid.any(-1).sum(1) >= 2).sum()) for each in found]
    kept = [each for each, count in zip(found, frames, strict=True) if count >= _LEAST_FRAMES]
    left_out = sum(count < _LEAST_FRAMES for count in frames[1:])
    if left_out:
        text = "Left out: %d more, of whom each is seen by two views in fewer than %d frames."
        _log.warning(text, left_out, _LEAST_FRAMES)
    if len(kept) < 2:
        return found[:1]
    if frames[0] < _LEAST_FRAMES:
        kept = [found[0], *kept]
    names = enumerate(kept)
    return [replace(each, title=f"{each.title}, person {number}") for number, each in names]


def joints_of(settings: PredictSettings, skeleton: Skeleton) -> JointMeans:
    """Return the joints of the files."""
    return human_joints(skeleton) if settings.joints == "human36m" else all_joints(skeleton)
