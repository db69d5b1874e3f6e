"""predictions.npz: every selection's poses of a test run. It is written first; all numbers come
from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.formats.stored_npz import Member, read_rows
from ghpt.errors import GhptDataError
from ghpt.models.rows import HINT, WEIGHTS, Layout, RowWriter, check_arrays, read_tables, row_count
from ghpt.observations import PoseEstimate, Recording, Truth
from ghpt.skeleton import JOINTS


def _layout(names: Sequence[str], joints: int) -> Layout:
    layout: Layout = {}
    for name in names:
        layout |= {f"points_{name}": ("<f4", (joints, 3)), f"estimated_{name}": ("|b1", (joints,))}
    layout |= {"truth": ("<f4", (joints, 3)), "truth_seen": ("|b1", (joints,))}
    return layout | {"recording": ("<i4", ()), "frame": ("<i8", ())}


class PredictionWriter:
    """Writes the frames of a test run: a ``RowWriter`` with a row for each."""

    def __init__(
        self, folder: str | Path, count: int, names: Sequence[str], joints: int = len(JOINTS)
    ) -> None:
        self._rows = RowWriter(folder, count, "frames", names, _layout(names, joints))

    def write(
        self,
        rows: Int[Tensor, " B"],
        estimates: Mapping[str, PoseEstimate],
        truth: Truth,
        recording: Int[Tensor, " B"],
        frame: Int[Tensor, " B"],
        weights: Mapping[str, Float[Tensor, " B"]],
    ) -> None:
        """Write frames to their row numbers. A point that is not finite is written as not
        estimated.
        """
        self._rows.check(estimates, weights)
        values: dict[str, Tensor] = {
            "truth_seen": truth.valid,
            "recording": recording,
            "frame": frame,
        }
        values["truth"] = truth.points.masked_fill(~truth.valid[..., None], torch.nan)
        for name, estimate in estimates.items():
            estimated = estimate.estimated & estimate.points.isfinite().all(-1)
            values[f"estimated_{name}"] = estimated
            values[f"points_{name}"] = estimate.points.masked_fill(~estimated[..., None], torch.nan)
        self._rows.write(rows, values, weights)

    def finish(
        self, path: str | Path, recordings: Sequence[Recording], meta: Mapping[str, Any]
    ) -> None:
        """Make the file ``path``.

        ``meta``: ``data``, ``source`` ("synthetic" or the path of the data), ``split``, ``seed``
        and ``provenance``, as plain data. The same content gives the same bytes. Raises GhptError
        if a row is missing.
        """
        tables = {
            **{
                f"recording_{key}": np.array([getattr(r, key) for r in recordings], dtype=np.str_)
                for key in ("name", "subject", "action")
            },
            "joint_name": np.array(JOINTS),
        }
        self._rows.finish(path, tables, meta, verify=open_predictions)


class PredictionChunk(NamedTuple):
    """Successive rows of a predictions file, as masked values without NaN."""

    estimates: dict[str, PoseEstimate]
    truth: Truth
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
        """The rows from ``start`` up to ``stop``. Raises GhptDataError if they name a recording
        there is not.
        """
        arrays = [*_layout(self.names, len(JOINTS)), *(f"weights_{summary}" for summary in WEIGHTS)]
        rows = {
            name: torch.from_numpy(read_rows(self.path, self._members[name], start, stop))
            for name in arrays
        }
        recording = rows["recording"].long()
        if ((recording < 0) | (recording >= len(self.recording_name))).any():
            raise GhptDataError(
                self.path, "recording", "names a recording that is not listed", HINT
            )
        estimates = {}
        for name in self.names:
            points = rows[f"points_{name}"]
            estimated = rows[f"estimated_{name}"] & points.isfinite().all(-1)
            estimates[name] = PoseEstimate(
                torch.where(estimated[..., None], points, 0.0), estimated
            )
        valid = rows["truth_seen"] & rows["truth"].isfinite().all(-1)
        truth = Truth(torch.where(valid[..., None], rows["truth"], 0.0), valid)
        weights = {summary: rows[f"weights_{summary}"] for summary in WEIGHTS}
        return PredictionChunk(estimates, truth, recording, rows["frame"], weights)

    def chunks(self, size: int) -> Iterator[PredictionChunk]:
        """All rows, ``size`` at a time."""
        return (
            self.read(start, min(start + size, len(self))) for start in range(0, len(self), size)
        )


def open_predictions(path: str | Path) -> Predictions:
    """Open and check a predictions file; nothing in it is executed or unpacked.

    Raises GhptDataError if it is missing, damaged (every byte is compared with its checksum), of
    another version, or if its arrays do not belong together.
    """
    path = Path(path)
    texts = ("recording_name", "recording_subject", "recording_action", "joint_name")
    members, tables, meta, names = read_tables(path, texts)
    if tables["joint_name"] != JOINTS:
        raise GhptDataError(path, "joint_name", "is not the 17 joints in ghpt's order", HINT)
    check_arrays(path, members, _layout(names, len(JOINTS)), row_count(members, "frame"))
    recordings = [tables[name] for name in texts[:3]]
    if len({len(table) for table in recordings}) != 1:
        raise GhptDataError(path, "recording_name", "subjects and actions are not as many", HINT)
    return Predictions(path, meta, names, *recordings, members)
