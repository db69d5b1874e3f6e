"""predictions.npz: every selection's poses of a test run. It is written first; all numbers come from it."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.errors import GhptDataError, GhptError
from ghpt.files import atomic_write
from ghpt.recording import PoseEstimate, Recording
from ghpt.report.stored_npz import Member, add_member, members_of, text_table
from ghpt.skeleton import JOINTS

FORMAT_VERSION = 1
WEIGHTS = ("entropy", "max", "effective")
"""Summaries of a frame's weights: entropy (nats), the largest, and 1 / sum of squares (hypotheses in effect)."""

# What numpy writes, and no more: its own reader evaluates the header as Python and lets odd errors through.
_MEND = "Run the test again to make it anew"


def _layout(names: Sequence[str], joints: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Name -> (dtype, shape of one frame) of every array with a row for each frame."""
    layout: dict[str, tuple[str, tuple[int, ...]]] = {}
    for name in names:
        layout |= {f"points_{name}": ("<f4", (joints, 3)), f"estimated_{name}": ("|b1", (joints,))}
    layout |= {"truth": ("<f4", (joints, 3)), "truth_seen": ("|b1", (joints,))}
    layout |= {"recording": ("<i4", ()), "frame": ("<i8", ())}
    return layout | {f"weights_{summary}": ("<f4", ()) for summary in WEIGHTS}


class PredictionWriter:
    """Collects rows in any order, from any number of processes on one file system, at constant memory.

    Every process opens the same new ``folder`` and writes its rows; after all have, one calls ``finish``.
    """

    def __init__(self, folder: str | Path, count: int, names: Sequence[str], joints: int = len(JOINTS)) -> None:
        if count < 1 or not names or any(not re.fullmatch("[a-z][a-z0-9_]*", name) for name in names):
            raise GhptError(f"predictions of {count} frames of {list(names)}: need a frame and plain names")
        self.folder, self.count, self.names = Path(folder), count, tuple(names)
        self._layout = _layout(names, joints)
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, (dtype, shape) in (self._layout | {"written": ("|b1", ())}).items():
            with open(self.folder / name, "ab") as handle:  # a second process finds it at its full size
                handle.truncate(count * np.dtype(dtype).itemsize * int(np.prod(shape)))

    def write(
        self,
        rows: Int[Tensor, " B"],
        estimates: Mapping[str, PoseEstimate],
        truth: Float[Tensor, "B J 3"],
        truth_seen: Bool[Tensor, "B J"],
        recording: Int[Tensor, " B"],
        frame: Int[Tensor, " B"],
        weights: Mapping[str, Float[Tensor, " B"]],
    ) -> None:
        """Write frames to their row numbers. A point that is not finite is written as not estimated."""
        if set(estimates) != set(self.names) or set(weights) != set(WEIGHTS):
            raise GhptError(f"got {[*estimates, *weights]}, not {[*self.names, *WEIGHTS]}")
        values: dict[str, Tensor] = {"truth_seen": truth_seen, "recording": recording, "frame": frame}
        values["truth"] = truth.masked_fill(~truth_seen[..., None], torch.nan)
        for name, estimate in estimates.items():
            estimated = estimate.estimated & estimate.points.isfinite().all(-1)
            values[f"estimated_{name}"] = estimated
            values[f"points_{name}"] = estimate.points.masked_fill(~estimated[..., None], torch.nan)
        values |= {f"weights_{summary}": value for summary, value in weights.items()}
        index = rows.cpu().numpy()
        for name, value in values.items():
            self._map(name)[index] = value.detach().cpu().numpy()
        self._map("written")[index] = True

    def finish(self, path: str | Path, recordings: Sequence[Recording], meta: Mapping[str, Any]) -> None:
        """Zip all rows to ``path`` and remove the folder.

        ``meta``: ``data``, ``source`` ("embedded" or the path of the data), ``split``, ``seed`` and
        ``provenance``, as plain data. The same content gives the same bytes. Raises GhptError if a row is missing.
        """
        missing = self.count - int(self._map("written").sum())
        if missing:
            raise GhptError(f"{path}: {missing} of {self.count} frames have no prediction; nothing was written")
        meta = {"format_version": FORMAT_VERSION, "unit": "mm", "names": self.names, **meta}
        tables = {
            **{f"recording_{key}": np.array([getattr(r, key) for r in recordings], dtype=np.str_)
               for key in ("name", "subject", "action")},
            "joint_name": np.array(JOINTS),
            "meta": np.array(json.dumps(meta, allow_nan=False)),
        }  # fmt: skip
        with atomic_write(path, verify=open_predictions) as handle, zipfile.ZipFile(handle, "w") as archive:
            for name, (dtype, shape) in self._layout.items():
                with open(self.folder / name, "rb") as rows:
                    add_member(archive, name, np.dtype(dtype), (self.count, *shape), rows)
            for name, table in tables.items():
                add_member(archive, name, table.dtype, table.shape, table.tobytes())
        shutil.rmtree(self.folder, ignore_errors=True)

    def _map(self, name: str) -> np.memmap:
        # Mapped anew for each use: what a map has touched counts as the process's memory while it is open.
        dtype, shape = (self._layout | {"written": ("|b1", ())})[name]
        return np.memmap(self.folder / name, dtype, "r+", shape=(self.count, *shape))


class PredictionChunk(NamedTuple):
    """Successive rows of a predictions file, as masked values without NaN."""

    estimates: dict[str, PoseEstimate]
    truth: Float[Tensor, "B J 3"]
    truth_seen: Bool[Tensor, "B J"]
    recording: Int[Tensor, " B"]
    frame: Int[Tensor, " B"]
    weights: dict[str, Float[Tensor, " B"]]


@dataclass(frozen=True)
class Predictions:
    """An opened predictions file. Rows are read when asked for."""

    path: Path
    meta: dict[str, Any]
    names: tuple[str, ...]
    """The selections, then the baselines."""
    recording_name: tuple[str, ...]
    recording_subject: tuple[str, ...]
    recording_action: tuple[str, ...]
    _members: dict[str, Member]

    def __len__(self) -> int:
        return self._members["frame"].shape[0]

    def read(self, start: int, stop: int) -> PredictionChunk:
        """The rows from ``start`` up to ``stop``. Raises GhptDataError if they name a recording there is not."""
        rows = {name: torch.from_numpy(self._rows(name, start, stop)) for name in _layout(self.names, len(JOINTS))}
        recording = rows["recording"].long()
        if ((recording < 0) | (recording >= len(self.recording_name))).any():
            raise GhptDataError(self.path, "recording", "names a recording that is not listed", _MEND)
        estimates = {}
        for name in self.names:
            points = rows[f"points_{name}"]
            estimated = rows[f"estimated_{name}"] & points.isfinite().all(-1)
            estimates[name] = PoseEstimate(torch.where(estimated[..., None], points, 0.0), estimated)
        seen = rows["truth_seen"] & rows["truth"].isfinite().all(-1)
        truth = torch.where(seen[..., None], rows["truth"], 0.0)
        weights = {summary: rows[f"weights_{summary}"] for summary in WEIGHTS}
        return PredictionChunk(estimates, truth, seen, recording, rows["frame"], weights)

    def chunks(self, size: int) -> Iterator[PredictionChunk]:
        """All rows, ``size`` at a time."""
        return (self.read(start, min(start + size, len(self))) for start in range(0, len(self), size))

    def _rows(self, name: str, start: int, stop: int) -> np.ndarray:
        member = self._members[name]
        each = int(np.prod(member.shape[1:]))
        offset = member.offset + start * each * member.dtype.itemsize
        return np.fromfile(self.path, member.dtype, (stop - start) * each, offset=offset).reshape(-1, *member.shape[1:])


def open_predictions(path: str | Path) -> Predictions:
    """Open and check a predictions file; nothing in it is executed or unpacked.

    Raises GhptDataError if it is missing, damaged (every byte is compared with its checksum), of another version,
    or if its arrays do not belong together.
    """
    path = Path(path)
    try:
        members = members_of(path)
        tables = {name: text_table(path, members, name) for name in
                  ("recording_name", "recording_subject", "recording_action", "joint_name", "meta")}  # fmt: skip
        meta = json.loads(tables["meta"][0])
    except FileNotFoundError as error:
        raise GhptDataError(path, "", "there is no such file", "Run test.py first") from error
    except (OSError, ValueError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
        raise GhptDataError(path, "", f"is not a readable predictions file ({error})", _MEND) from error
    version = meta.get("format_version") if isinstance(meta, dict) else None
    if version != FORMAT_VERSION:
        raise GhptDataError(path, "meta.format_version", f"is {version!r}; this ghpt reads {FORMAT_VERSION}", _MEND)
    names = meta.get("names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise GhptDataError(path, "meta.names", "is not a list of selections", _MEND)
    if tuple(tables["joint_name"]) != JOINTS:
        raise GhptDataError(path, "joint_name", "is not the 17 joints in ghpt's order", _MEND)
    count = members["frame"].shape[0] if "frame" in members and members["frame"].shape else 0
    for name, (dtype, shape) in _layout(names, len(JOINTS)).items():
        if name not in members or members[name][1:] != (np.dtype(dtype), (count, *shape)):
            raise GhptDataError(path, name, f"is not {dtype} of shape {(count, *shape)}", _MEND)
    recordings = [tables[f"recording_{key}"] for key in ("name", "subject", "action")]
    if len({len(table) for table in recordings}) != 1:
        raise GhptDataError(path, "recording_name", "subjects and actions are not as many", _MEND)
    return Predictions(path, meta, tuple(names), *recordings, members)
