"""Recordings with a file for each frame of each view, whatever is in the files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.layout import arrange_frames
from ghpt.data.formats.source import Source
from ghpt.data.people.detections import Detections, detections_in_view
from ghpt.errors import GhptDataError


@dataclass(frozen=True)
class Person:
    """Somebody in an image."""

    joints: Float[np.ndarray, "K 3"]
    """x, y, confidence."""
    identity: int = -1
    """-1 where the file does not say."""


def read_frame_files(
    source: Source, files: Sequence[Path], read: Callable[[Path], list[Person]]
) -> list[Detections]:
    """Return the views of files under the source's folder, of which ``read`` gives the people.

    Raises GhptDataError for files of one view alone, and where the layout cannot be told.
    """
    root = source.path
    if not root.is_dir():
        problem = "is one frame of one view"
        raise GhptDataError(root, "", problem, "Name the folder with the folders of all views.")
    views = arrange_frames(root, [file.relative_to(root) for file in files], source.session)
    if len(views) == 1 and all(file.parent == root for file in files):
        problem = "holds the frames of one view"
        raise GhptDataError(root, "", problem, "Name the folder above.")
    found = []
    for view in views:
        own = {number: files[index] for number, index in view.files.items()}
        found.append(_read_view(root, view.view, own, read))
    return found


def _read_view(
    root: Path, view: str, files: dict[int, Path], read: Callable[[Path], list[Person]]
) -> Detections:
    """Return one view's people, all with the same number of joints."""
    found: list[Person] = []
    numbers: list[int] = []
    for number in sorted(files):
        people = read(files[number])
        for person in people:
            count = len(person.joints)
            expected = len((found[0] if found else person).joints)
            if count != expected:
                problem = f"has people of {count} joints, the files before of {expected}"
                hint = "Detect all frames with one model."
                raise GhptDataError(files[number], "people", problem, hint)
            found.append(person)
            numbers.append(number)
    values = np.stack([person.joints for person in found]) if found else np.zeros((0, 0, 3))
    return detections_in_view(
        root,
        view,
        frames=sorted(files),
        number=np.array(numbers, np.int64),
        values=values,
        identity=np.array([person.identity for person in found], np.int64),
    )
