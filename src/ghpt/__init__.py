"""Generalizable human pose triangulation: 3D people from 2D key points in several cameras.

The names below are all that `import ghpt` promises; docs/python.md shows each in five lines. They
are imported when they are first asked for, and PyTorch with them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ghpt.api import (
        Poses,
        Predictor,
        calibrate_rig,
        check_cameras,
        mpjpe,
        relative_pose_errors,
        triangulate,
        write_poses,
    )
    from ghpt.data.formats.camera_files import read_cameras
    from ghpt.data.formats.key_points import read_key_points
    from ghpt.geometry.cameras import CameraSet
    from ghpt.models.checkpoint import load_model

__all__ = [
    "CameraSet",
    "Poses",
    "Predictor",
    "calibrate_rig",
    "check_cameras",
    "load_model",
    "mpjpe",
    "read_cameras",
    "read_key_points",
    "relative_pose_errors",
    "triangulate",
    "write_poses",
]

_HOMES = {
    "CameraSet": "ghpt.geometry.cameras",
    "load_model": "ghpt.models.checkpoint",
    "read_cameras": "ghpt.data.formats.camera_files",
    "read_key_points": "ghpt.data.formats.key_points",
}
"""The modules of the names that are not in `ghpt.api`."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("ghpt")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES.get(name, "ghpt.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__, "__version__"]
