"""One camera of a file as the file has it, before anything is checked."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraEntry:
    """One camera, in the file's own unit of length; values are whatever the file holds."""

    name: str
    other_name: str
    """What else the file calls it; '' where nothing."""
    K: object
    distortion: object
    size: object = None
    """Width and height, pixels."""
    R: object = None
    """A 3x3 matrix or a rotation vector."""
    t: object = None
    time: object = None
    """``rate`` and ``shift`` of a `Clock`; None where the file does not say it."""
