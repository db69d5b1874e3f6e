"""One person's key points with the names around them, to write and to read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.data.formats.key_points import read_key_points, write_key_points
from ghpt.data.people.detections import Detections
from ghpt.data.people.following import follow_views
from ghpt.data.points import KeyPoints


@dataclass(frozen=True)
class SinglePerson:
    """T frames of V views of one person, in the pixels of the images as they were."""

    path: str
    views: tuple[str, ...]
    joints: tuple[str, ...]
    frame: np.ndarray
    key_points: np.ndarray
    confidence: np.ndarray
    valid: np.ndarray
    rate_hz: float | None = None

    @property
    def points(self) -> KeyPoints:
        return KeyPoints(self.key_points, self.confidence, self.valid)

    @property
    def detections(self) -> Detections:
        return Detections.of_person(
            self.path, self.views, self.joints, self.frame, self.points, self.rate_hz
        )


def read_person(path: str | Path, *arguments: Any, **settings: Any) -> SinglePerson:
    """Return the one person who is followed through each view of a file."""
    people = read_key_points(path, *arguments, **settings)
    points = people.points.take(follow_views(people))
    return SinglePerson(
        people.path,
        people.views,
        people.joints,
        people.frame,
        points.pixels,
        points.confidence,
        points.valid,
        people.rate_hz,
    )


def write_person(path: str | Path, person: SinglePerson) -> None:
    """Write our npz file of a person."""
    write_key_points(path, person.views, person.joints, person.frame, person.points, person.rate_hz)
