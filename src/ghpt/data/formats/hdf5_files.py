"""HDF5 files of SLEAP (analysis and .slp), DeepLabCut and anipose, read by h5py.

Nothing is unpickled.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.formats.layout import find_files
from ghpt.data.formats.pickled_names import read_names
from ghpt.data.formats.source import Source
from ghpt.data.formats.tracks import Tracks, grid_of_columns, read_tracks
from ghpt.data.people.detections import Detections
from ghpt.errors import GhptDataError

ENDINGS = (".h5", ".hdf5", ".slp")
_INSTALL = "Install it: pip install h5py"
_LARGEST = 2 << 30
"""Bytes of an array."""
_DENSEST = 1000
"""Bytes of an array for each that is stored: a track without anybody compresses well."""
_SMALL = 16 << 20
"""Bytes of an array that may be asked for whatever is stored."""
_MOST_NAMES = 10_000
_CENTRES = 1.1
"""Version from which SLEAP's pixels are counted from the centre of the first one."""


def read_hdf5(source: Source) -> Detections:
    """Return everybody in a folder with an HDF5 file of each camera.

    Known are SLEAP's analysis files and its .slp of one video each, and the tables of DeepLabCut
    and anipose, of one person or several. Raises GhptDataError, also where h5py is missing.
    """
    if find_files(source.path, ENDINGS):
        _require_h5py(source.path)
    return read_tracks(source, ENDINGS, _read_file)


def _require_h5py(where: Path) -> Any:
    """Return the package h5py. Raises GhptDataError if it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise GhptDataError(where, "", "HDF5 files need the package h5py", _INSTALL) from error
    return h5py


def _read_file(file: Path) -> Tracks:
    h5py = _require_h5py(file)
    try:
        with h5py.File(file, "r") as content:
            if "tracks" in content and "node_names" in content:
                return _sleap(content)
            if "frames" in content and "instances" in content:
                return _labels(content)
            tables = [key for key in content if _is_table(content, key)]
            if len(tables) == 1:
                return _pandas(content[tables[0]])
    except GhptDataError:
        raise
    except Exception as error:  # whatever HDF5 says of a damaged file, of any type
        problem = f"is damaged ({' '.join(str(error).split())[:200]})"
        raise GhptDataError(file, "", problem, "Export it again.") from error
    problem = "is HDF5 of neither SLEAP, DeepLabCut nor anipose"
    hint = "Export SLEAP's analysis HDF5 or DeepLabCut's h5 or CSV."
    raise GhptDataError(file, "", problem, hint)


def _is_table(content: Any, key: str) -> bool:
    group = content[key]
    return "pandas_type" in group.attrs


def _sleap(content: Any) -> Tracks:
    """Return SLEAP's analysis: tracks [P 2 K T], or [T P K 2] in the files of some exporters."""
    tracks = _array(content, "tracks")
    names = _texts(content, "node_names")
    if tracks.ndim != 4:
        raise ValueError("tracks has not four dimensions")
    scores = _array(content, "point_scores") if "point_scores" in content else None
    count = len(names)
    as_matlab = tracks.shape[1:3] == (2, count)
    if as_matlab and tracks.shape[2:] == (count, 2) and scores is not None:
        as_matlab = scores.shape == (tracks.shape[0], *tracks.shape[2:])
    points = tracks.transpose(3, 0, 2, 1) if as_matlab else tracks
    if points.shape[2:] != (count, 2):
        raise ValueError(f"tracks is not of the {count} joints that are named")
    if scores is None:
        scores = np.full(points.shape[:3], np.nan)
    elif as_matlab:
        scores = scores.transpose(2, 0, 1)
    return Tracks.of_grid(np.arange(len(points)), _join(points, scores), names)


def _labels(content: Any) -> Tracks:
    """Return a .slp file's instances of one video.

    A hand-made instance is there in place of the prediction that it corrects. Raises ValueError.
    """
    frames = _array(content, "frames", "V")
    instances = _array(content, "instances", "V")
    if len(np.unique(frames["video"])) > 1:
        raise ValueError("it holds several videos: export the analysis HDF5 of each")
    names = _node_names(content)
    corrected = instances["from_predicted"][instances["from_predicted"] >= 0]
    instances = instances[~np.isin(instances["instance_id"], corrected)]
    order = np.argsort(frames["frame_id"])
    place = np.searchsorted(frames["frame_id"], instances["frame_id"], sorter=order)
    own = frames[order[place]]
    if (own["frame_id"] != instances["frame_id"]).any():
        raise ValueError("an instance is of no frame")
    frame = own["frame_idx"].astype(np.int64)
    predicted = instances["instance_type"] == 1
    values = np.full((len(instances), len(names), 3), np.nan)
    for table, rows in (("points", ~predicted), ("pred_points", predicted)):
        values[rows] = _instance_points(_array(content, table, "V"), instances[rows], len(names))
    if float(content["metadata"].attrs.get("format_id", 1.0)) < _CENTRES:
        values[..., :2] -= 0.5
    track = instances["track"].astype(np.int64)
    return Tracks(np.unique(frames["frame_idx"]).astype(np.int64), frame, track, values, names)


def _instance_points(
    points: np.ndarray, instances: np.ndarray, count: int
) -> Float[np.ndarray, "N K 3"]:
    """Return the points of some instances, which lie one behind the other in a table."""
    start = instances["point_id_start"].astype(np.int64)
    if not (instances["point_id_end"].astype(np.int64) - start == count).all():
        raise ValueError(f"an instance has not the {count} points of the skeleton")
    own = points[start[:, None] + np.arange(count)]
    score = own["score"] if "score" in (own.dtype.names or ()) else np.full(own.shape, np.nan)
    values = np.stack([own["x"], own["y"], score], -1)
    return np.where(own["visible"][..., None], values, np.nan)


def _node_names(content: Any) -> tuple[str, ...]:
    """Return the names of the skeleton's nodes, in the order of an instance's points."""
    metadata = json.loads(_text(content["metadata"].attrs["json"]))
    if len(metadata["skeletons"]) != 1:
        raise ValueError("it has several skeletons")
    nodes = [node["name"] for node in metadata["nodes"]]
    return tuple(_text(nodes[node["id"]]) for node in metadata["skeletons"][0]["nodes"])


def _pandas(group: Any) -> Tracks:
    """Return DeepLabCut's table, whose columns are named scorer, (individual,) joint, coordinate.

    pandas stores it in a fixed form, in blocks of columns of a type, or as a table of rows.
    """
    form = _text(group.attrs["pandas_type"])
    columns, values, index = _of_rows(group) if form == "frame_table" else _of_blocks(group)
    return Tracks.of_grid(_frames(index, len(values)), *grid_of_columns(columns, values))


def _of_rows(group: Any) -> tuple[list[tuple[str, ...]], Float[np.ndarray, "T C"], np.ndarray]:
    table = _array(group, "table", "V")
    columns: list[tuple[str, ...]] = []
    values = []
    for field in table.dtype.names or ():
        if field.startswith("values_block_"):
            columns += read_names(bytes(group["table"].attrs[f"{field}_kind"]))
            values.append(table[field].reshape(len(table), -1))
    return columns, np.concatenate(values, 1).astype(np.float64), table["index"]


def _of_blocks(group: Any) -> tuple[list[tuple[str, ...]], Float[np.ndarray, "T C"], np.ndarray]:
    columns: list[tuple[str, ...]] = []
    values = []
    for block in range(int(group.attrs["nblocks"])):
        levels = []
        for level in range(int(group.attrs[f"block{block}_items_nlevels"])):
            names = _texts(group, f"block{block}_items_level{level}")
            labels = _array(group, f"block{block}_items_label{level}", "iu")
            levels.append([names[label] for label in labels.tolist()])
        columns += zip(*levels, strict=True)
        values.append(_array(group, f"block{block}_values"))
    return columns, np.concatenate(values, 1), _array(group, "axis1", "iuS")


def _frames(index: np.ndarray, count: int) -> Int[np.ndarray, " T"]:
    """Return the rows' frame numbers, or their places where they are no rising numbers."""
    if index.dtype.kind in "iu" and len(index) == count and (np.diff(index, prepend=-1) > 0).all():
        return index.astype(np.int64)
    return np.arange(count)


def _join(points: np.ndarray, scores: np.ndarray) -> Float[np.ndarray, "T P K 3"]:
    if scores.shape != points.shape[:-1]:
        raise ValueError("scores and points are not of as many joints")
    return np.concatenate([points, scores[..., None]], -1).astype(np.float64)


def _array(group: Any, name: str, kinds: str = "f") -> np.ndarray:
    """Return an array that lies in this file, whole; its size is checked before it is read."""
    data = group[name]
    link = group.get(name, getlink=True)
    if type(link).__name__ != "HardLink" or data.is_virtual or data.external:
        raise ValueError(f"{name} lies in another file")
    if data.dtype.kind not in kinds:
        raise ValueError(f"{name} holds {data.dtype}")
    size = math.prod(data.shape) * data.dtype.itemsize
    stored = data.id.get_storage_size()
    if size > min(_LARGEST, max(_SMALL, _DENSEST * stored)):
        raise ValueError(f"{name} claims {size} bytes, and {stored} are stored")
    return np.asarray(data[...])


def _texts(group: Any, name: str) -> tuple[str, ...]:
    data = group[name]
    if math.prod(data.shape) > _MOST_NAMES:
        raise ValueError(f"{name} has too many names")
    kinds = "O" if data.dtype.kind == "O" else "S"
    return tuple(_text(value) for value in _array(group, name, kinds).reshape(-1).tolist())


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8")
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is no text")
    return value
