"""freemocap's 2D array of all cameras."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from ghpt.data.formats.layout import find_files
from ghpt.data.formats.skeletons import SKELETONS, recognise
from ghpt.data.formats.source import Source
from ghpt.data.formats.validate import check_view_count, finite_points, read_npy
from ghpt.data.people.detections import Detections, joints_for
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

_log = logging.getLogger(__name__)
_NAME = re.compile(r".*2d[ _]?data.*\.npy", re.IGNORECASE)
_FARTHEST = 1e6
"""Pixels."""
_BODY = len(SKELETONS["mediapipe_33"])
_WITH_BODY = (33, 75, 543, 553)
"""Points of MediaPipe's holistic model: the body; then both hands; then a face of 468 or 478."""


def is_freemocap_file(path: Path) -> bool:
    """Return whether a file has the name of freemocap's 2D data."""
    return _NAME.fullmatch(path.name) is not None


def read_freemocap(source: Source) -> Detections:
    """Return the one person of ``<tracker>_2dData_..._pixelXY.npy``, or of the folder it is in.

    The array [V, T, K, 2 or more] has x and y in pixels and NaN for what was not found. The views
    are ``cam_0``, ``cam_1``, ..., in the order of freemocap's calibration; there is no confidence.
    Of MediaPipe's points the body's are read. Raises GhptDataError.
    """
    path = _file(source.path)
    array = read_npy(path, (None, None, None, None), "f")
    views, frames, count, coordinates = array.shape
    check_view_count(path, views)
    if coordinates not in (2, 3) or not frames:
        problem = f"has shape {' x '.join(map(str, array.shape))}"
        hint = "It must be cameras x frames x points x 2 or 3 numbers."
        raise GhptDataError(path, "", problem, hint)
    if source.skeleton is None and count in _WITH_BODY:
        if count > _BODY:
            _log.info("%s: of %d points the body's %d are read.", path, count, _BODY)
        count = _BODY
    pixels = array[:, :, :count, :2].astype(np.float64).swapaxes(0, 1)
    valid = finite_points(pixels) & (np.abs(np.nan_to_num(pixels)) < _FARTHEST).all(-1)
    pixels = np.where(valid[..., None], pixels, 0)
    people = valid.reshape(-1, count)
    name = source.skeleton or recognise(path, pixels.reshape(-1, count, 2), people)
    joints = joints_for(path, name, count)
    names = tuple(f"cam_{view}" for view in range(views))
    points = KeyPoints(pixels, valid.astype(np.float64), valid)
    return Detections.of_person(path, names, joints, np.arange(frames), points)


def _file(root: Path) -> Path:
    if not root.is_dir():
        return root
    files = [file for file in find_files(root, (".npy",)) if is_freemocap_file(file)]
    if len(files) == 1:
        return files[0]
    names = ", ".join(str(file.relative_to(root)) for file in files[:5])
    problem = f"holds {names}" if files else "holds no 2dData .npy"
    raise GhptDataError(root, "", problem, "Name one such file.")
