"""One camera of a file as the file has it, before anything is checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

KNOWN_CAMERAS = (
    "Known: TOML of Pose2Sim, aniposelib, caliscope or freemocap; intri.yml (with extri.yml beside "
    "it) of OpenCV or EasyMocap; calibration JSON of CMU Panoptic; camera-parameters.json of "
    "Human3.6M; a folder with a COLMAP model; a file for each camera, of OpenCap or JSON."
)
"""What to say of a file that is none."""


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
    fisheye: bool = False
    """Whether the distortion is k1 k2 k3 k4 of Kannala and Brandt's lens."""
    to_world: bool = False
    """Whether R and t take the camera to the world, not the world to the camera."""
    time: object = None
    """``rate`` and ``shift`` of a `Clock`; None where the file does not say it."""


@dataclass(frozen=True)
class CameraContent:
    """What a file of a format holds."""

    format: str
    entries: Sequence[CameraEntry]
    unit_mm: float
    """The format's unit of length, or what it is taken for."""
    unit_known: bool = True
