"""karfly's ``human36m-multiview-labels-GTbboxes.npy``: a pickle, read without running it."""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.formats.restricted_pickle import PickledArray, load_pickle
from ghpt.data.formats.validate import check_array, npy_header, open_input
from ghpt.errors import GhptDataError

LABELS_FILE = "human36m-multiview-labels-GTbboxes.npy"
_HINT = "Get the file again, or prepare it anew with karfly/learnable-triangulation-pytorch."


@dataclass(frozen=True)
class Labels:
    """The labels of N frames of S subjects by C cameras, in the file's order."""

    path: Path
    subjects: tuple[str, ...]
    cameras: tuple[str, ...]
    actions: tuple[str, ...]
    """With the take: ``Greeting-2``."""
    K: Float[np.ndarray, "S C 3 3"]
    R: Float[np.ndarray, "S C 3 3"]
    t: Float[np.ndarray, "S C 3"]
    distortion: Float[np.ndarray, "S C 5"]
    subject: Int[np.ndarray, " N"]
    """Index into ``subjects`` of each frame."""
    action: Int[np.ndarray, " N"]
    frame: Int[np.ndarray, " N"]
    key_points: Float[np.ndarray, "N 17 3"]
    """World frame, mm, joints in the order of ``ghpt.skeleton.JOINTS``."""


def read_labels(path: Path) -> Labels:
    """Read and check a labels file.

    Raises GhptDataError if it is not what it should be or holds code.
    """
    content = _read_pickle(path)
    subjects = _names(path, "subject_names", content)
    actions = _names(path, "action_names", content)
    rigs = _cameras(path, content, len(subjects))
    table = _read_structure(path, "table", content, (None,))
    subject = _column(table, "subject_idx", (None,), "iu")
    action = _column(table, "action_idx", (None,), "iu")
    _check_range(subject, table, "subject_idx", "subject_names", len(subjects))
    _check_range(action, table, "action_idx", "action_names", len(actions))
    return Labels(
        path=path,
        subjects=subjects,
        cameras=rigs.names,
        actions=actions,
        K=rigs.K,
        R=rigs.R,
        t=rigs.t,
        distortion=rigs.distortion,
        subject=subject,
        action=action,
        frame=_column(table, "frame_idx", (None,), "iu"),
        key_points=_column(table, "keypoints", (None, 17, 3), "f"),
    )


@dataclass(frozen=True)
class LabelCameras:
    """C cameras of A actions, or of A subjects, in the file's own unit."""

    names: tuple[str, ...]
    K: Float[np.ndarray, "A C 3 3"]
    R: Float[np.ndarray, "A C 3 3"]
    t: Float[np.ndarray, "A C 3"]
    distortion: Float[np.ndarray, "A C 5"]


def read_label_cameras(path: Path) -> LabelCameras:
    """Return the cameras of a labels file of any data set.

    Raises GhptDataError if it is not what it should be or holds code.
    """
    return _cameras(path, _read_pickle(path), None)


def _cameras(path: Path, content: dict[str, Any], count: int | None) -> LabelCameras:
    """Return the cameras of so many subjects or, where that is None, of any number of actions."""
    names = _names(path, "camera_names", content)
    rigs = _read_structure(path, "cameras", content, (count, len(names)))
    if not len(rigs.array):
        raise GhptDataError(path, "cameras", "is empty", _HINT)
    return LabelCameras(
        names=names,
        K=_column(rigs, "K", (None, None, 3, 3), "f"),
        R=_column(rigs, "R", (None, None, 3, 3), "f"),
        t=_column(rigs, "t", (None, None, 3, 1), "f")[..., 0],
        distortion=_column(rigs, "dist", (None, None, 5), "f"),
    )


def _read_pickle(path: Path) -> dict[str, Any]:
    """Return the pickled dict, its arrays still as `PickledArray`."""
    with open_input(path) as handle:
        _, _, dtype = npy_header(path, "", handle, path.stat().st_size, pickled=True)
        if not dtype.hasobject:
            raise GhptDataError(path, "", f"holds {dtype}, not a pickled dict", _HINT)
        with mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                data.seek(handle.tell())
                (content,) = load_pickle(data).state[4]
            except Exception as error:  # damaged pickles raise almost anything
                problem = f"is not a labels file ({error!s:.200})"
                raise GhptDataError(path, "", problem, _HINT) from error
    if not isinstance(content, dict):
        raise GhptDataError(path, "", f"holds a {type(content).__name__}, not a dict", _HINT)
    return content


def _names(path: Path, key: str, content: dict[str, Any]) -> tuple[str, ...]:
    names = content.get(key)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise GhptDataError(path, key, "is not a list of names", _HINT)
    return tuple(names)


@dataclass(frozen=True)
class _Table:
    """A structured array of the file."""

    path: Path
    key: str
    array: np.ndarray


def _read_structure(
    path: Path,
    key: str,
    content: dict[str, Any],
    shape: tuple[int | None, ...],
) -> _Table:
    array = content.get(key)
    if not isinstance(array, PickledArray):
        raise GhptDataError(path, key, "is missing, or not an array", _HINT)
    try:
        built = array.build()
    except ValueError as error:
        raise GhptDataError(path, key, f"is not a numpy array ({error})", _HINT) from error
    return _Table(path, key, check_array(path, key, built, shape, "V"))


def _column(table: _Table, name: str, shape: tuple[int | None, ...], kinds: str) -> np.ndarray:
    where = f"{table.key}[{name!r}]"
    if name not in (table.array.dtype.names or ()):
        raise GhptDataError(table.path, where, "is missing", _HINT)
    return check_array(table.path, where, table.array[name], shape, kinds)


def _check_range(
    index: Int[np.ndarray, " N"],
    table: _Table,
    name: str,
    names: str,
    count: int,
) -> None:
    """Raise GhptDataError unless every index is one of ``count`` names."""
    if len(index) and (index.min() < 0 or index.max() >= count):
        problem = f"goes from {index.min()} to {index.max()}, with {count} {names}"
        raise GhptDataError(table.path, f"{table.key}[{name!r}]", problem, _HINT)
