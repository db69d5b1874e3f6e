"""What predictions.npz of the camera problem holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.data.datasets.pairs import RigOfSplit
from ghpt.geometry.cameras import Cameras
from ghpt.models.predictions import Chunk, InvalidArray, Predictions, Record, Schema, Tables
from ghpt.observations import Batch, RelativePoseEstimate


@dataclass(frozen=True)
class PairSample(Batch):
    """A pair's true relative pose, and where it is from."""

    truth_R: Float[Tensor, "B 3 3"]
    truth_t: Float[Tensor, "B 3"]
    """mm."""
    rig: Int[Tensor, " B"]
    """Index of the rig in the tables."""
    draw: Int[Tensor, " B"]
    """Number of the draw of frames, over all rigs."""
    pair: Int[Tensor, "B 2"]
    """The views: reference, then target."""


@dataclass(frozen=True)
class RigTables(Tables):
    """The G true rigs of a test run, with V cameras each."""

    dtypes: ClassVar = {
        "rig_name": "U",
        "camera_name": "U",
        "rig_K": "<f8",
        "rig_R": "<f8",
        "rig_t": "<f8",
        "rig_points": "<f8",
    }

    rig_name: np.ndarray
    camera_name: np.ndarray
    """[G, V]."""
    rig_K: Float[np.ndarray, ...]
    rig_R: Float[np.ndarray, ...]
    rig_t: Float[np.ndarray, ...]
    """World to camera, mm."""
    rig_points: Float[np.ndarray, ...]
    """[G, P, 3]: random points X* of each rig's capture volume, world, mm."""

    @staticmethod
    def from_rigs(rigs: Sequence[RigOfSplit]) -> RigTables:
        """Return the tables of these rigs."""
        return RigTables(
            rig_name=np.array([rig.name for rig in rigs], np.str_),
            camera_name=np.array([rig.names for rig in rigs], np.str_),
            rig_K=_stack([rig.cameras.K for rig in rigs]),
            rig_R=_stack([rig.cameras.R for rig in rigs]),
            rig_t=_stack([rig.cameras.t for rig in rigs]),
            rig_points=_stack([rig.points for rig in rigs]),
        )

    @cached_property
    def cameras(self) -> Cameras:
        """The true cameras, leading dimensions G V."""
        K, R, t = (torch.from_numpy(x) for x in (self.rig_K, self.rig_R, self.rig_t))
        return Cameras(K, R, t)

    @cached_property
    def points(self) -> Float[Tensor, "G P 3"]:
        """The points X* of each rig."""
        return torch.from_numpy(self.rig_points)

    def check(self) -> None:
        """Raise InvalidArray unless all arrays are of the same rigs and cameras."""
        rigs = self.rig_name.shape[0] if self.rig_name.shape else 0
        views = self.rig_K.shape[1] if self.rig_K.ndim > 1 else 0
        points = self.rig_points.shape[1] if self.rig_points.ndim > 1 else 0
        shapes = {
            "rig_K": (rigs, views, 3, 3),
            "rig_R": (rigs, views, 3, 3),
            "rig_t": (rigs, views, 3),
            "rig_points": (rigs, points, 3),
            "camera_name": (rigs, views),
        }
        for name, shape in shapes.items():
            array: np.ndarray = getattr(self, name)
            if array.shape != shape or not array.size:
                raise InvalidArray(name, f"is not of shape {shape}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise InvalidArray(name, "holds values that are not finite")

    def check_sample(self, sample: PairSample) -> None:
        """Raise InvalidArray if a pair is of no rig, or not two of its views, or has no truth."""
        rigs, views = self.camera_name.shape
        rig = sample.rig
        pair = sample.pair
        if ((rig < 0) | (rig >= rigs)).any():
            raise InvalidArray("rig", "names a rig that is not listed")
        if ((pair < 0) | (pair >= views)).any() or (pair[:, 0] == pair[:, 1]).any():
            raise InvalidArray("pair", f"is not two of the {views} views")
        if not (sample.truth_R.isfinite().all() and sample.truth_t.isfinite().all()):
            raise InvalidArray("truth_R", "holds values that are not finite")


def _stack(values: Sequence[Tensor]) -> np.ndarray:
    return torch.stack(list(values)).double().cpu().numpy().astype("<f8")


_ESTIMATE = {"R": ("<f8", (3, 3)), "t": ("<f8", (3,)), "estimated": ("|b1", ())}
_SAMPLE = {
    "truth_R": ("<f8", (3, 3)),
    "truth_t": ("<f8", (3,)),
    "rig": ("<i4", ()),
    "draw": ("<i8", ()),
    "pair": ("<i4", (2,)),
}

PAIRS = Schema(
    "camera", Record(RelativePoseEstimate, _ESTIMATE), Record(PairSample, _SAMPLE), RigTables
)
PairPredictions = Predictions[RelativePoseEstimate, PairSample, RigTables]
PairChunk = Chunk[RelativePoseEstimate, PairSample]
