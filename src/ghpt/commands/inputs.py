"""What calibrate.py, cameras.py and predict.py work on: people's own files, or one recording of a
data set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from ghpt.config import build, suggest
from ghpt.data.datasets.datamodule import KeyPointDataModule
from ghpt.data.datasets.store import prepare
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import KeyPoints, read_key_points
from ghpt.data.formats.names import Name
from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import CameraSet
from ghpt.observations import LabelledRecording


class InputSettings(TypedDict):
    """The settings that name the input, alike in the three commands."""

    keypoints: str | None
    cameras: str | None
    subject: Name
    unit_mm: float | None
    views: list[Name] | None
    match: dict[Name, Name] | None
    skeleton: str | None
    format: str | None
    rate_hz: float | None
    recording: str | None
    data: dict[str, Any]


def own_cameras(config: Mapping[str, Any], example: str) -> CameraSet:
    """The user's camera file. Raises GhptConfigError, with ``example``, if none is named."""
    if not config["cameras"]:
        raise GhptConfigError("cameras", "is missing", f"Name the file: cameras={example}")
    return read_cameras(config["cameras"], config["subject"], config["unit_mm"])


def own_key_points(config: Mapping[str, Any]) -> KeyPoints:
    """The user's key points, of one person in each view."""
    return read_key_points(
        config["keypoints"], config["skeleton"], config["rate_hz"], config["format"]
    )


def recording_of(config: Mapping[str, Any]) -> tuple[KeyPointDataModule, LabelledRecording]:
    """A recording of ``config["data"]`` by name; without a name S9/Walking-1 or the first."""
    data = build(config["data"], "data")
    made = {"source": data.source, "split": data.evaluate}
    stored = prepare(
        data.cache, data.cache_key(data.evaluate), lambda: data.generate(data.evaluate), made
    )
    recordings = {recording.name: recording for recording in stored}
    name = config["recording"] or (
        "S9/Walking-1" if "S9/Walking-1" in recordings else next(iter(recordings), "")
    )
    if name not in recordings:
        raise GhptConfigError("recording", f"there is no {name!r}", suggest(name, recordings))
    return data, recordings[name]
