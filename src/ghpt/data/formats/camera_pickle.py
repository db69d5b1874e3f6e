"""OpenCap's pickled camera (cameraIntrinsicsExtrinsics.pickle), read without running it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.data.formats.camera_entry import CameraContent
from ghpt.data.formats.camera_fields import camera_from_fields
from ghpt.data.formats.restricted_pickle import PickledArray, load_pickle
from ghpt.data.formats.validate import open_input
from ghpt.errors import GhptDataError

SUFFIXES = (".pickle", ".pkl")
_LARGEST = 1 << 20
"""Bytes; a camera needs a thousand."""
_HINT = "Give OpenCap's cameraIntrinsicsExtrinsics.pickle, or write the camera as TOML or JSON."


def read_camera_pickle(path: Path) -> CameraContent:
    """Return the camera of a file: world to camera, mm.

    It is called as the file, or as its folder where the file is called as all of OpenCap's are.
    OpenCap writes the image's height before its width. Raises GhptDataError for a file that holds
    code, or no dict of numbers.
    """
    fields = _read_dict(path)
    size = fields.get("imageSize")
    if isinstance(size, np.ndarray):
        fields["imageSize"] = size.ravel()[::-1]
    entry = camera_from_fields(path, path.stem, fields)
    return CameraContent("OpenCap", [entry], 1.0)


def _read_dict(path: Path) -> dict[str, Any]:
    with open_input(path) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise GhptDataError(path, "", f"has more than {_LARGEST >> 20} MiB", _HINT)
    try:
        content = load_pickle(io.BytesIO(data))
        if not isinstance(content, dict):
            raise ValueError(f"it holds a {type(content).__name__}")
        return {str(name): _plain(value) for name, value in content.items()}
    except Exception as error:  # damaged pickles raise almost anything
        problem = f"is not a pickled camera ({error!s:.200})"
        raise GhptDataError(path, "", problem, _HINT) from error


def _plain(value: object) -> object:
    return value.build() if isinstance(value, PickledArray) else value
