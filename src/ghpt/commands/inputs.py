"""What calibrate.py, cameras.py and predict.py work on.

It is people's own files, or one recording of a data set.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.calibration.check.units import decide_unit
from ghpt.commands.outputs import OutputSettings
from ghpt.config import Target, build, suggest
from ghpt.data.datasets.store import prepare
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.contents import explain_cameras, explain_key_points
from ghpt.data.formats.key_points import Detections, read_key_points
from ghpt.data.formats.names import Name
from ghpt.data.people.persons import (
    detector_sequence,
    detector_sequences,
    person_sequence,
)
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Recording
from ghpt.report.tables import display_name

_UNIT_FRAMES = 64
"""Frames by which the person tells the unit of length."""
_DEMONSTRATION = "S9/Walking-1"


@dataclass(frozen=True, kw_only=True)
class InputSettings(OutputSettings):
    """The settings that name the input, alike in the three commands."""

    keypoints: str | None
    cameras: str | None
    subject: Name
    unit_mm: float | None
    views: list[Name] | None
    match: dict[Name, Name] | None
    skeleton: str | None
    format: str | None
    session: Name
    least_confidence: float
    rate_hz: float | None
    time: str
    recording: str | None
    data: Target

    def __post_init__(self) -> None:
        """Refuse cameras without key points: nobody means to see synthetic people by them."""
        if self.cameras and not self.keypoints:
            raise GhptConfigError("keypoints", "is missing", "Name the folder: keypoints=pose/")


def own_cameras(inputs: InputSettings, example: str) -> CameraSet:
    """Return the user's cameras. Raises GhptConfigError, with ``example``, if no file is named."""
    if not inputs.cameras:
        raise GhptConfigError("cameras", "is missing", f"Name the file: cameras={example}")
    try:
        return read_cameras(inputs.cameras, inputs.subject, inputs.unit_mm)
    except GhptDataError as error:
        key_points = Path(inputs.keypoints) if inputs.keypoints else None
        raise explain_cameras(error, Path(inputs.cameras), key_points) from error


def own_people(inputs: InputSettings) -> Detections:
    """Return everybody in the user's key points."""
    path = _required_path(inputs)
    try:
        return read_key_points(
            path,
            inputs.skeleton,
            inputs.rate_hz,
            inputs.format,
            inputs.session,
            inputs.least_confidence,
        )
    except GhptDataError as error:
        cameras = Path(inputs.cameras) if inputs.cameras else None
        raise explain_key_points(error, path, cameras, inputs.format is not None) from error


def own_sequence(
    inputs: InputSettings,
    people: Detections,
    cameras: CameraSet,
    person: int | None,
    check_sizes: bool = True,
) -> Sequence:
    """Return one person of the user's key points with their cameras.

    The arguments are those of `person_sequence`, which says what is raised.
    """
    sequence = person_sequence(
        people, cameras, inputs.match, inputs.views, person, own_title(inputs), check_sizes
    )
    return replace(sequence, source=str(_required_path(inputs).resolve()))


def own_detector_sequences(
    inputs: InputSettings, people: Detections, cameras: CameraSet, person: int | None
) -> list[Sequence]:
    """Return everybody with all key points of the detector, or one person alone.

    `detector_sequences` and `detector_sequence` say what is raised.
    """
    title = own_title(inputs)
    rig = (cameras, inputs.match, inputs.views)
    if person is None:
        found = detector_sequences(people, *rig, title)
    else:
        found = [detector_sequence(people, *rig, person, title)]
    source = str(_required_path(inputs).resolve())
    return [replace(sequence, source=source) for sequence in found]


def own_title(inputs: InputSettings) -> str:
    """Return what a report calls the user's files."""
    name = _required_path(inputs).resolve().name
    return f"{name} with {Path(inputs.cameras).name}" if inputs.cameras else name


def _required_path(inputs: InputSettings) -> Path:
    if not inputs.keypoints:
        raise GhptConfigError("keypoints", "is missing", "Name the file or folder: keypoints=pose/")
    return Path(inputs.keypoints)


def find_recording(inputs: InputSettings) -> tuple[Any, Recording]:
    """Return the DataModule and a recording of it by name; without one S9/Walking-1 or the first.

    The type of the DataModule is not named: Lightning takes seconds to import, and whoever gives
    files needs none of it.
    """
    data = build(inputs.data, "data")
    provenance = {"source": data.source, "split": data.evaluate}
    key = data.cache_key(data.evaluate)
    stored = prepare(data.cache, key, lambda: data.generate(data.evaluate), provenance)
    recordings = {recording.name: recording for recording in stored}
    name = inputs.recording
    if not name:
        first = next(iter(recordings), "")
        name = _DEMONSTRATION if _DEMONSTRATION in recordings else first
    if name not in recordings:
        raise GhptConfigError("recording", f"there is no {name!r}", suggest(name, recordings))
    return data, recordings[name]


def recording_sequence(inputs: InputSettings) -> Sequence:
    """Return a recording of the data set as a sequence, without its truth."""
    data, recording = find_recording(inputs)
    points = KeyPoints(
        pixels=np.array(recording.key_points),
        confidence=np.array(recording.confidence),
        valid=np.array(recording.valid),
    )
    rate = float(recording.rate_hz)
    return Sequence(
        title=f"{recording.name} of {display_name(data.name, data.source)}",
        source=data.source,
        cameras=CameraSet.from_cameras(recording.camera_names, recording.cameras, path=data.source),
        frame=np.array(recording.frame).astype(np.int64),
        rate_hz=None if np.isnan(rate) else rate,
        points=KeyPointArrays(points, points),
    )


def resolve_unit(sequence: Sequence, estimator: Estimator, ask: bool) -> Sequence:
    """Return the sequence with cameras in mm where their file does not say its unit.

    ``ask``: raise GhptDataError where the person does not tell it; see `decide_unit`.
    """
    cameras = sequence.cameras
    if cameras.unit_known or not cameras.calibrated or len(cameras) < 2:
        return sequence
    observations = sequence.as_joints().read(sequence.spread(_UNIT_FRAMES))
    return replace(sequence, cameras=decide_unit(cameras, observations, estimator, ask))
