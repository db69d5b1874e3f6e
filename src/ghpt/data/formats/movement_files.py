"""DeepLabCut, SLEAP and LightningPose, read by the package ``movement``."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.data.formats.skeletons import canonical
from ghpt.data.formats.validate import finite_points
from ghpt.data.people.detections import Detections, detections_in_view, merge_views
from ghpt.errors import GhptDataError

EXTENSIONS = (".csv", ".h5", ".slp")
_INSTALL = "Install it: pip install movement"
_LOADERS = {
    "DeepLabCut": "from_dlc_file",
    "LightningPose": "from_lp_file",
    "SLEAP": "from_sleap_file",
}
_LARGEST = 2 << 30
"""Bytes."""


def read_deeplabcut(path: Path, skeleton: str | None) -> Detections:
    """Return everybody in a folder with DeepLabCut's CSV of each camera.

    Its .h5 files are refused: they hold pickles.
    """
    return _read(path, skeleton, "DeepLabCut", (".csv",))


def read_lightning_pose(path: Path, skeleton: str | None) -> Detections:
    """Return the one person of a folder with LightningPose's CSV of each camera."""
    return _read(path, skeleton, "LightningPose", (".csv",))


def read_sleap(path: Path, skeleton: str | None) -> Detections:
    """Return everybody in a folder with SLEAP's .slp or analysis .h5 of each camera."""
    return _read(path, skeleton, "SLEAP", (".slp", ".h5"))


def _read(path: Path, skeleton: str | None, software: str, endings: tuple[str, ...]) -> Detections:
    files = (
        [f for f in sorted(path.iterdir()) if f.suffix.lower() in endings]
        if path.is_dir()
        else [path]
    )
    if not files or any(file.suffix.lower() not in endings for file in files):
        problem = f"holds no {' or '.join(endings)} of {software}"
        raise GhptDataError(path, "", problem, f"Export {endings[0]} files, one for each camera.")
    try:
        from movement.io import load_poses
    except ImportError as error:
        raise GhptDataError(
            path, "", f"{software}'s files need the package movement", _INSTALL
        ) from error
    found = []
    named: dict[tuple[str, ...], Path] = {}
    for file in files:
        if file.stat().st_size > _LARGEST:
            raise GhptDataError(
                file, "", f"has more than {_LARGEST >> 30} GiB", "Split the recording."
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # of a missing frame rate, which does not matter here
                data = getattr(load_poses, _LOADERS[software])(file)
            view = _view(file, data)
        except GhptDataError:
            raise
        except Exception as error:  # whatever pandas, h5py and movement raise for a damaged file
            problem = f"is damaged, or not {software}'s ({' '.join(str(error).split())[:200]})"
            raise GhptDataError(file, "", problem, "Export it again.") from error
        named.setdefault(view.joints, file)
        found.append(view)
    if len(named) > 1:
        raise GhptDataError(
            list(named.values())[1],
            "keypoints",
            "are named otherwise than in the files before",
            "Track all views with one model.",
        )
    return merge_views(path, found, skeleton)


def _view(file: Path, data: Any) -> Detections:
    """Return the detections of movement's data set: time, space, keypoints, individuals."""
    order = ("time", "individuals", "keypoints")
    position = np.asarray(data["position"].transpose(*order, "space"), dtype=np.float64)[..., :2]
    confidence = np.asarray(data["confidence"].transpose(*order), dtype=np.float64)
    near = np.abs(np.nan_to_num(position)) < 1e6
    valid = finite_points(position) & near.all(-1)
    # SLEAP's hand-made labels have no score, LightningPose and DeepLabCut a likelihood
    score = np.where(np.isfinite(confidence), confidence, 1.0)
    values = np.where(valid[..., None], np.concatenate([position, score[..., None]], -1), 0)
    frame, person = np.nonzero(valid.any(-1))
    joints = canonical([str(name) for name in data["keypoints"].values])
    name = re.split(r"DLC_|[_.-]?(?:predictions|analysis)", file.stem)[0] or file.stem
    return detections_in_view(
        file, name, np.arange(len(valid)), frame, values[frame, person], joints=joints
    )
