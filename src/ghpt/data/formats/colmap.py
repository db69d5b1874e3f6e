"""COLMAP's models: cameras and images as text or binary; each image is a camera of the rig.

Read without COLMAP's own library: what it does with a damaged file cannot be caught.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Iterator
from itertools import islice, takewhile
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from ghpt.data.formats.camera_entry import CameraEntry
from ghpt.data.formats.validate import MOST_VIEWS, check_view_count, open_input
from ghpt.errors import GhptDataError
from ghpt.geometry.rotations import quaternion_to_matrix

_LARGEST = 1 << 30
"""Bytes of images.bin or images.txt, which hold every image's points."""
_HINT = "Export the model again with COLMAP's model_converter."
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
}
"""Number in binary files -> name, count of parameters, of the models with a lens of
``ghpt.geometry.lens``.
"""
_FOCAL_ONE = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
"""The models with one focal length."""
_MOST_IMAGES = 20 * MOST_VIEWS
_SAME_ROTATION = 1e-4
"""Of two poses that are one, largest difference of a number of their unit quaternions."""
_SAME_PLACE = 1e-4
"""And of t, as a share of its length."""


class Image(NamedTuple):
    """An image of the model: its name, wxyz and t world to camera, the number of its camera."""

    name: str
    wxyz: tuple[float, ...]
    t: tuple[float, ...]
    camera: int


def is_colmap(folder: Path) -> bool:
    """Return whether a folder holds a model."""
    return any((folder / f"images.{end}").is_file() for end in ("bin", "txt"))


def read_colmap(folder: Path) -> list[CameraEntry]:
    """Return the cameras of a folder with cameras and images as .bin or .txt, by the images' names.

    Images of one camera in one place (the frames of a rig that stands still) are one. A camera is
    called as its image without ending or, where it has several or images are called alike
    (``cam1/0001.png``, ``cam2/0001.png``), as their folder. COLMAP's first pixel has its centre at
    (0.5, 0.5), ours at (0, 0). Raises GhptDataError for a damaged file, a lens of another model,
    and a camera that moves.
    """
    end = "bin" if (folder / "images.bin").is_file() else "txt"
    camera_file = folder / f"cameras.{end}"
    image_file = folder / f"images.{end}"
    read_cameras, read_images = (
        (_camera_bytes, _image_bytes) if end == "bin" else (_camera_lines, _image_lines)
    )
    try:
        found = list(islice(read_cameras(_content(camera_file)), MOST_VIEWS + 1))
    except (struct.error, ValueError, OverflowError) as error:
        raise GhptDataError(camera_file, "", f"is damaged ({error})", _HINT) from error
    try:
        images = sorted(islice(read_images(_content(image_file)), _MOST_IMAGES + 1))
    except (struct.error, ValueError, OverflowError) as error:
        raise GhptDataError(image_file, "", f"is damaged ({error})", _HINT) from error
    check_view_count(camera_file, len(found))
    cameras = {number: (model, size, values) for number, model, size, values in found}
    places = _places(image_file, images)
    check_view_count(image_file, len(places))
    names = _names(image_file, places)
    rig = []
    for (image, *_), (name, other) in zip(places, names, strict=True):
        if image.camera not in cameras:
            raise GhptDataError(
                image_file, f"image {image.name}", f"there is no camera {image.camera}", _HINT
            )
        model, size, parameters = cameras[image.camera]
        K, distortion, fisheye = _intrinsics(camera_file, name, model, parameters)
        entry = CameraEntry(
            name=name,
            other_name=other,
            K=K,
            distortion=distortion,
            size=list(size),
            R=_rotation(image_file, image),
            t=np.array(image.t),
            fisheye=fisheye,
        )
        rig.append(entry)
    return rig


def _places(where: Path, images: list[Image]) -> list[list[Image]]:
    """Return the images of each camera in each place, in the order of their names."""
    if len(images) > _MOST_IMAGES:
        problem = f"are more than {_MOST_IMAGES}"
        raise GhptDataError(where, "images", problem, "Give a model of the rig's cameras.")
    camera = np.array([image.camera for image in images], np.int64)
    wxyz = np.array([image.wxyz for image in images]).reshape(-1, 4)
    t = np.array([image.t for image in images]).reshape(-1, 3)
    free = np.ones(len(images), np.bool_)
    places: list[list[Image]] = []
    while free.any() and len(places) <= MOST_VIEWS:
        first = int(free.argmax())
        with np.errstate(all="ignore"):  # a damaged file may hold any number
            same = _same_pose(wxyz, t, first)
        same &= free & (camera == camera[first])
        same[first] = True
        places.append([images[index] for index in np.flatnonzero(same)])
        free &= ~same
    return places


def _content(path: Path) -> bytes:
    with open_input(path) as handle:
        if path.stat().st_size > _LARGEST:
            raise GhptDataError(
                path,
                "",
                f"has more than {_LARGEST >> 30} GiB",
                "Give a model of the rig's cameras.",
            )
        return handle.read()


def _camera_bytes(data: bytes) -> Iterator[tuple[int, int | str, tuple[int, int], list[float]]]:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if model not in _MODELS:
            yield number, model, (width, height), []
            return  # how many parameters it has is not known, so what follows is not either
        parameters = struct.unpack_from(f"<{_MODELS[model][1]}d", data, at + 24)
        at += 24 + 8 * len(parameters)
        yield number, _MODELS[model][0], (width, height), list(parameters)


def _image_bytes(data: bytes) -> Iterator[Image]:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(0, at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield Image(data[at + 64 : end].decode(), tuple(pose[:4]), tuple(pose[4:]), camera)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError(f"{points} points of an image are not there")


def _camera_lines(data: bytes) -> Iterator[tuple[int, int | str, tuple[int, int], list[float]]]:
    for line in _lines(data):
        if line:
            number, model, width, height, *parameters = line.split()
            yield (
                int(number),
                model,
                (int(width), int(height)),
                [float(value) for value in parameters],
            )


def _image_lines(data: bytes) -> Iterator[Image]:
    # a line of the image, then one of its points, which may be empty
    for line in islice(_lines(data), 0, None, 2):
        if line:
            _, w, x, y, z, t1, t2, t3, camera, name = line.split(maxsplit=9)
            yield Image(
                name,
                (float(w), float(x), float(y), float(z)),
                (float(t1), float(t2), float(t3)),
                int(camera),
            )


def _lines(data: bytes) -> Iterator[str]:
    text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig")
    return (line.strip() for line in text if not line.startswith("#"))


def _same_pose(
    wxyz: Float[np.ndarray, "N 4"], t: Float[np.ndarray, "N 3"], one: int
) -> Bool[np.ndarray, " N"]:
    """Return which poses are that of ``one``."""
    turned = np.minimum(np.abs(wxyz - wxyz[one]), np.abs(wxyz + wxyz[one])).max(1)
    moved = np.abs(t - t[one]).max(1)
    return (turned <= _SAME_ROTATION) & (moved <= _SAME_PLACE * np.linalg.norm(t[one]))


def _names(where: Path, places: list[list[Image]]) -> list[tuple[str, str]]:
    """Return a name and another for each camera: of its image, its folder, or what these share."""
    paths = [[PurePosixPath(image.name) for image in place] for place in places]
    for choice in (_own_stem, _own_folder, _shared_stem):
        names = [choice(each) for each in paths]
        if len({*names}) == len(names) and all(names):
            others = [str(each[0].parent / each[0].stem) for each in paths]
            return list(zip(names, others, strict=True))
    hint = "A rig's cameras stand still: keep one image of each, called as its view."
    problem = f"are of {len(paths)} places with names that tell no cameras apart"
    raise GhptDataError(where, "images", problem, hint)


def _own_stem(paths: list[PurePosixPath]) -> str:
    stems = {path.stem for path in paths}
    return stems.pop() if len(stems) == 1 else ""


def _own_folder(paths: list[PurePosixPath]) -> str:
    folders = {path.parent.name for path in paths}
    return folders.pop() if len(folders) == 1 else ""


def _shared_stem(paths: list[PurePosixPath]) -> str:
    """Return with what all names begin, without a part of a number: cam1 of cam1_001, cam1_002."""
    stems = [path.stem for path in paths]
    same = takewhile(lambda pair: pair[0] == pair[1], zip(min(stems), max(stems), strict=False))
    shared = "".join(character for character, _ in same)
    return re.sub(r"\d+$", "", shared).rstrip(" _.-")


def _intrinsics(
    where: Path, name: str, model: int | str, parameters: list[float]
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return K, the coefficients of the lens, and whether it is a fisheye."""
    counts = dict(_MODELS.values())
    if model not in counts or len(parameters) != counts[model]:
        problem = f"is of the model {model} with {len(parameters)} parameters"
        hint = f"Known: {', '.join(counts)}; undistort the images first."
        raise GhptDataError(where, f"camera {name}", problem, hint)
    focal = 1 if model in _FOCAL_ONE else 2
    fx = parameters[0]
    fy = parameters[focal - 1]
    cx = parameters[focal]
    cy = parameters[focal + 1]
    rest = parameters[focal + 2 :]
    fisheye = "FISHEYE" in str(model)
    lens = np.zeros(4 if fisheye else 8)
    lens[: len(rest)] = rest  # OpenCV's order
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), lens, fisheye


def _rotation(where: Path, image: Image) -> Float[np.ndarray, "3 3"]:
    length = math.hypot(*image.wxyz)
    if not 0.5 < length < 2:
        raise GhptDataError(
            where, f"image {image.name}", "has a quaternion that is not of length 1", _HINT
        )
    return quaternion_to_matrix(torch.tensor(image.wxyz, dtype=torch.float64) / length).numpy()
