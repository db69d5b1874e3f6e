"""CSV of DeepLabCut and LightningPose and SLEAP's .slp, read by the package ``movement``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.data.formats.layout import find_files
from ghpt.data.formats.source import Source
from ghpt.data.formats.tracks import Tracks, read_tracks
from ghpt.data.people.detections import Detections
from ghpt.errors import GhptDataError

_INSTALL = "Install it: pip install movement"
_LOADERS = {
    "DeepLabCut": "from_dlc_file",
    "LightningPose": "from_lp_file",
    "SLEAP": "from_sleap_file",
}
_LARGEST = 2 << 30
"""Bytes."""


def read_deeplabcut_csv(source: Source) -> Detections:
    """Return everybody in a folder with DeepLabCut's CSV of each camera."""
    return _read(source, ".csv", "DeepLabCut")


def read_lightning_pose(source: Source) -> Detections:
    """Return the one person of a folder with LightningPose's CSV of each camera."""
    return _read(source, ".csv", "LightningPose")


def read_sleap_labels(source: Source) -> Detections:
    """Return everybody in a folder with SLEAP's .slp of each camera."""
    return _read(source, ".slp", "SLEAP")


def _read(source: Source, ending: str, software: str) -> Detections:
    if find_files(source.path, (ending,)):
        _load_poses(source.path, software)
    return read_tracks(source, (ending,), lambda file: _read_file(file, software))


def _load_poses(where: Path, software: str) -> Any:
    """Return movement's readers. Raises GhptDataError if the package is not installed."""
    try:
        from movement.io import load_poses
    except ImportError as error:
        problem = f"{software}'s files need the package movement"
        raise GhptDataError(where, "", problem, _INSTALL) from error
    return load_poses


def _read_file(file: Path, software: str) -> Tracks:
    if file.stat().st_size > _LARGEST:
        problem = f"has more than {_LARGEST >> 30} GiB"
        raise GhptDataError(file, "", problem, "Split the recording.")
    load = getattr(_load_poses(file, software), _LOADERS[software])
    try:
        with warnings.catch_warnings():
            # of a missing frame rate, which does not matter here
            warnings.simplefilter("ignore")
            return _tracks(load(file))
    except Exception as error:  # whatever pandas, h5py and movement raise for a damaged file
        problem = f"is damaged, or not {software}'s ({' '.join(str(error).split())[:200]})"
        raise GhptDataError(file, "", problem, "Export it again.") from error


def _tracks(data: Any) -> Tracks:
    """Return movement's data set: time, space, keypoints, individuals."""
    order = ("time", "individuals", "keypoints")
    position = np.asarray(data["position"].transpose(*order, "space"), dtype=np.float64)
    confidence = np.asarray(data["confidence"].transpose(*order), dtype=np.float64)
    values = np.concatenate([position[..., :2], confidence[..., None]], -1)
    return Tracks(values, tuple(str(name) for name in data["keypoints"].values))
