"""COLMAP's models: cameras and images as text or binary; each image is a camera of the rig.

Read without COLMAP's own library: what it does with a damaged file cannot be caught.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

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
    6: ("FULL_OPENCV", 12),
}
"""Number in binary files -> name, count of parameters, of the models whose lens OpenCV's k1 k2 p1
p2 k3 can be.
"""


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

    An image's camera is called as the image, without its ending; where images are called alike
    (``cam1/0001.png``, ``cam2/0001.png``), as their folders. COLMAP's first pixel has its centre at
    (0.5, 0.5), ours at (0, 0). Raises GhptDataError for a damaged file, a lens that is not k1 k2 p1
    p2 k3, and several images of one camera.
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
        images = sorted(islice(read_images(_content(image_file)), MOST_VIEWS + 1))
    except (struct.error, ValueError, OverflowError) as error:
        raise GhptDataError(image_file, "", f"is damaged ({error})", _HINT) from error
    check_view_count(camera_file, len(found))
    check_view_count(image_file, len(images))
    cameras = {number: (model, size, values) for number, model, size, values in found}
    names = _names(image_file, [PurePosixPath(image.name) for image in images])
    rig = []
    for image, (name, other) in zip(images, names, strict=True):
        if image.camera not in cameras:
            raise GhptDataError(
                image_file, f"image {image.name}", f"there is no camera {image.camera}", _HINT
            )
        model, size, parameters = cameras[image.camera]
        K, distortion = _intrinsics(camera_file, name, model, parameters)
        entry = CameraEntry(
            name=name,
            other_name=other,
            K=K,
            distortion=distortion,
            size=list(size),
            R=_rotation(image_file, image),
            t=np.array(image.t),
        )
        rig.append(entry)
    return rig


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


def _names(where: Path, paths: list[PurePosixPath]) -> list[tuple[str, str]]:
    """A name and another for each camera."""
    for of in (lambda p: p.stem, lambda p: p.parent.name):
        names = [of(path) for path in paths]
        if len({*names}) == len(names) and all(names):
            return [
                (name, str(path.parent / path.stem))
                for name, path in zip(names, paths, strict=True)
            ]
    hint = "A rig's cameras stand still: keep one image of each, called as its view."
    raise GhptDataError(
        where, "images", f"are {len(paths)} with names that tell no cameras apart", hint
    )


def _intrinsics(
    where: Path, name: str, model: int | str, parameters: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    counts = dict(_MODELS.values())
    if model not in counts or len(parameters) != counts[model]:
        problem = f"is of the model {model} with {len(parameters)} parameters"
        raise GhptDataError(
            where,
            f"camera {name}",
            problem,
            f"Known: {', '.join(counts)}; undistort the images first.",
        )
    focal = 1 if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else 2
    fx = parameters[0]
    fy = parameters[focal - 1]
    (cx, cy) = parameters[focal : focal + 2]
    rest = parameters[focal + 2 :]
    lens = np.zeros(8)
    lens[: len(rest)] = rest  # k1 k2 p1 p2 k3 k4 k5 k6, OpenCV's order
    if lens[5:].any():
        raise GhptDataError(
            where, f"camera {name}", "has k4, k5 or k6", "Calibrate it with the model OPENCV."
        )
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), lens[:5]


def _rotation(where: Path, image: Image) -> Float[np.ndarray, "3 3"]:
    length = math.hypot(*image.wxyz)
    if not 0.5 < length < 2:
        raise GhptDataError(
            where, f"image {image.name}", "has a quaternion that is not of length 1", _HINT
        )
    return quaternion_to_matrix(torch.tensor(image.wxyz, dtype=torch.float64) / length).numpy()
