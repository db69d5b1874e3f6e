"""predictions.npz of the camera problem: every selection's relative pose of every pair, and the
true rigs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.datasets.pairs import RigOfSplit
from ghpt.data.formats.stored_npz import Member, read_rows
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.models.rows import HINT, WEIGHTS, Layout, RowWriter, check_arrays, read_tables, row_count
from ghpt.observations import RelativePoseEstimate

PROBLEM = "camera"


def _layout(names: Sequence[str]) -> Layout:
    layout: Layout = {}
    for name in names:
        layout |= {
            f"R_{name}": ("<f8", (3, 3)),
            f"t_{name}": ("<f8", (3,)),
            f"estimated_{name}": ("|b1", ()),
        }
    layout |= {"truth_R": ("<f8", (3, 3)), "truth_t": ("<f8", (3,))}
    return layout | {"rig": ("<i4", ()), "draw": ("<i8", ()), "pair": ("<i4", (2,))}


class PairWriter:
    """Writes the pairs of a test run: a ``RowWriter`` with a row for each."""

    def __init__(self, folder: str | Path, count: int, names: Sequence[str]) -> None:
        self._rows = RowWriter(folder, count, "pairs", names, _layout(names))

    def write(
        self,
        rows: Int[Tensor, " B"],
        estimates: Mapping[str, RelativePoseEstimate],
        truth: tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]],
        rig: Int[Tensor, " B"],
        draw: Int[Tensor, " B"],
        pair: Int[Tensor, "B 2"],
        weights: Mapping[str, Float[Tensor, " B"]],
    ) -> None:
        """Write pairs to their row numbers; t in mm. A pose that is not finite, or whose t is 0
        because nothing gave it a length, is written as not estimated.
        """
        self._rows.check(estimates, weights)
        values: dict[str, Tensor] = {
            "truth_R": truth[0],
            "truth_t": truth[1],
            "rig": rig,
            "draw": draw,
            "pair": pair,
        }
        for name, estimate in estimates.items():
            estimated = _usable(estimate.R, estimate.t, estimate.estimated)
            values[f"estimated_{name}"] = estimated
            values[f"R_{name}"] = estimate.R.masked_fill(~estimated[..., None, None], torch.nan)
            values[f"t_{name}"] = estimate.t.masked_fill(~estimated[..., None], torch.nan)
        self._rows.write(rows, values, weights)

    def finish(self, path: str | Path, rigs: Sequence[RigOfSplit], meta: Mapping[str, Any]) -> None:
        """Make the file ``path``; ``meta`` as of the pose problem, and ``frames`` (M)."""
        arrays = {
            "rig_K": torch.stack([rig.cameras.K for rig in rigs]),
            "rig_R": torch.stack([rig.cameras.R for rig in rigs]),
            "rig_t": torch.stack([rig.cameras.t for rig in rigs]),
            "rig_points": torch.stack([rig.points for rig in rigs]),
        }
        tables = {
            "rig_name": np.array([rig.name for rig in rigs], dtype=np.str_),
            "camera_name": np.array([rig.names for rig in rigs], dtype=np.str_),
            **{name: array.double().cpu().numpy().astype("<f8") for name, array in arrays.items()},
        }
        self._rows.finish(path, tables, {"problem": PROBLEM, **meta}, verify=open_pairs)


class PairChunk(NamedTuple):
    """Successive rows of the file, as masked values without NaN."""

    estimates: dict[str, RelativePoseEstimate]
    truth_R: Float[Tensor, "B 3 3"]
    truth_t: Float[Tensor, "B 3"]
    rig: Int[Tensor, " B"]
    draw: Int[Tensor, " B"]
    pair: Int[Tensor, "B 2"]
    weights: dict[str, Float[Tensor, " B"]]


@dataclass(frozen=True)
class PairPredictions:
    """An opened predictions file of the camera problem. Rows are read when asked for."""

    path: Path
    meta: dict[str, Any]
    names: tuple[str, ...]
    """The selections, then the baselines."""
    rig_name: tuple[str, ...]
    camera_name: tuple[tuple[str, ...], ...]
    """Of each rig, its views."""
    cameras: Cameras
    """The true ones, leading dimensions G V: of G rigs."""
    points: Float[Tensor, "G P 3"]
    """Random points X* of each rig's capture volume, world, mm."""
    _members: dict[str, Member]

    def __len__(self) -> int:
        return self._members["draw"].shape[0]

    def read(self, start: int, stop: int) -> PairChunk:
        """The rows from ``start`` up to ``stop``. Raises GhptDataError if they name a rig or view
        there is not.
        """
        arrays = [*_layout(self.names), *(f"weights_{summary}" for summary in WEIGHTS)]
        rows = {
            name: torch.from_numpy(read_rows(self.path, self._members[name], start, stop))
            for name in arrays
        }
        rig = rows["rig"].long()
        pair = rows["pair"].long()
        rigs, views = self.cameras.K.shape[:2]
        if ((rig < 0) | (rig >= rigs)).any():
            raise GhptDataError(self.path, "rig", "names a rig that is not listed", HINT)
        if ((pair < 0) | (pair >= views)).any() or (pair[:, 0] == pair[:, 1]).any():
            raise GhptDataError(self.path, "pair", f"is not two of the {views} views", HINT)
        if not (rows["truth_R"].isfinite().all() and rows["truth_t"].isfinite().all()):
            raise GhptDataError(self.path, "truth_R", "holds values that are not finite", HINT)
        estimates = {}
        for name in self.names:
            R = rows[f"R_{name}"]
            t = rows[f"t_{name}"]
            estimated = _usable(R, t, rows[f"estimated_{name}"])
            R = torch.where(estimated[:, None, None], R, torch.eye(3, dtype=R.dtype))
            estimates[name] = RelativePoseEstimate(
                R, torch.where(estimated[:, None], t, 0.0), estimated
            )
        weights = {summary: rows[f"weights_{summary}"] for summary in WEIGHTS}
        return PairChunk(
            estimates, rows["truth_R"], rows["truth_t"], rig, rows["draw"], pair, weights
        )

    def chunks(self, size: int) -> Iterator[PairChunk]:
        """All rows, ``size`` at a time."""
        return (
            self.read(start, min(start + size, len(self))) for start in range(0, len(self), size)
        )


def open_pairs(path: str | Path) -> PairPredictions:
    """Open and check a predictions file of the camera problem, as ``open_predictions`` does one of
    poses.
    """
    path = Path(path)
    members, tables, meta, names = read_tables(path, ("rig_name", "camera_name"))
    if meta.get("problem") != PROBLEM:
        raise GhptDataError(
            path, "meta.problem", f"is {meta.get('problem')!r}, not {PROBLEM!r}", HINT
        )
    check_arrays(path, members, _layout(names), row_count(members, "draw"))
    rigs = len(tables["rig_name"])
    views, points = (_second(members, name) for name in ("rig_K", "rig_points"))
    shapes = {"rig_K": (rigs, views, 3, 3), "rig_R": (rigs, views, 3, 3), "rig_t": (rigs, views, 3)}
    arrays = {}
    for name, shape in (shapes | {"rig_points": (rigs, points, 3)}).items():
        if (
            name not in members
            or members[name][1:] != (np.dtype("<f8"), shape)
            or not math.prod(shape)
        ):
            raise GhptDataError(path, name, f"is not <f8 of shape {shape}", HINT)
        arrays[name] = torch.from_numpy(read_rows(path, members[name], 0, rigs))
        if not arrays[name].isfinite().all():
            raise GhptDataError(path, name, "holds values that are not finite", HINT)
    if members["camera_name"].shape != (rigs, views):
        raise GhptDataError(path, "camera_name", f"is not of shape {(rigs, views)}", HINT)
    flat = tables["camera_name"]
    camera_names = tuple(flat[i * views : (i + 1) * views] for i in range(rigs))
    cameras = Cameras(arrays["rig_K"], arrays["rig_R"], arrays["rig_t"])
    return PairPredictions(
        path, meta, names, tables["rig_name"], camera_names, cameras, arrays["rig_points"], members
    )


def _usable(
    R: Float[Tensor, "B 3 3"], t: Float[Tensor, "B 3"], estimated: Bool[Tensor, " B"]
) -> Bool[Tensor, " B"]:
    return estimated & R.isfinite().flatten(-2).all(-1) & t.isfinite().all(-1) & (t != 0).any(-1)


def _second(members: Mapping[str, Member], name: str) -> int:
    """The second dimension of an array, 0 where it has none."""
    return members[name].shape[1] if name in members and len(members[name].shape) > 1 else 0
