"""What passes between the stages: recordings, batches of observations, truths, and estimates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.epipolar import normalise

RecordingT = TypeVar("RecordingT", bound="Recording")
BatchT = TypeVar("BatchT", bound="Batch")
EstimateT = TypeVar("EstimateT", bound="Estimate")


@dataclass(frozen=True)
class Recording:
    """One take of one person by one rig: T frames, V views, J = 17 joints.

    All quirks of a data set end here: millimetres, ideal pinhole pixels (lens distortion is
    undone), world to camera, joints in the order of ``ghpt.skeleton.JOINTS``. A value whose mask is
    False is finite but meaningless. Arrays may be memory maps.
    """

    name: str
    """Unique in its data set, e.g. ``S9/Greeting-2``."""
    subject: str
    action: str
    rate_hz: float
    camera_names: tuple[str, ...]
    cameras: Cameras
    """K, R, t with leading dimension V, float64, on the CPU."""
    key_points: Float[np.ndarray, "T V J 2"]
    """Undistorted pixels, float32."""
    confidence: Float[np.ndarray, "T V J"]
    """The detector's own, in [0, 1]; 1 where the detector gives none."""
    valid: Bool[np.ndarray, "T V J"]
    frame: Int[np.ndarray, " T"]
    """The data set's own frame number."""

    def __len__(self) -> int:
        return len(self.frame)

    def frames(self: RecordingT, rows: Int[np.ndarray, " N"]) -> RecordingT:
        """Return the recording of the frames at these positions."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {name: x[rows] for name, x in values.items() if isinstance(x, np.ndarray)}
        return replace(self, **arrays)


@dataclass(frozen=True)
class LabelledRecording(Recording):
    """A recording with the true poses."""

    truth: Float[np.ndarray, "T J 3"]
    """World frame, mm."""
    truth_valid: Bool[np.ndarray, "T J"]


@dataclass(frozen=True)
class Batch:
    """Tensors, cameras and other batches that share the leading dimension B."""

    def to(self: BatchT, *args: Any, **kwargs: Any) -> BatchT:
        """Move to a device or convert to a data type, as ``Tensor.to`` does."""
        return self._apply(lambda value: value.to(*args, **kwargs))

    def pin_memory(self: BatchT) -> BatchT:
        """Copy into page-locked memory, from which a GPU reads faster."""
        return self._apply(lambda value: value.pin_memory())

    def rows(self: BatchT, index: Int[Tensor, " b"] | Bool[Tensor, " B"] | slice) -> BatchT:
        """Return the items at these places."""
        return self._apply(lambda value: _items(value, index))

    def _apply(self: BatchT, function: Callable[[Any], Any]) -> BatchT:
        values = {field.name: function(getattr(self, field.name)) for field in fields(self)}
        return replace(self, **values)


def _items(value: Batch | Cameras | Tensor, index: Any) -> Batch | Cameras | Tensor:
    if isinstance(value, Batch):
        return value.rows(index)
    if isinstance(value, Cameras):
        return value.index(index)
    return value[index]


@dataclass(frozen=True)
class Samples(Batch):
    """A batch of a data set's samples."""

    index: Int[Tensor, " B"]
    """Position in the data set: the key of the sample's random draws, whatever batch or process it
    is in.
    """

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True)
class Observations(Samples):
    """What the cameras saw in B frames, from any recordings of one camera arrangement."""

    recording: Int[Tensor, " B"]
    """Index of the frame's recording in the data set."""
    cameras: Cameras
    """K, R, t with leading dimensions B V, float64."""
    key_points: Float[Tensor, "B V J 2"]
    """Undistorted pixels."""
    confidence: Float[Tensor, "B V J"]
    valid: Bool[Tensor, "B V J"]


@dataclass(frozen=True)
class Truth(Batch):
    """The true poses of B frames."""

    points: Float[Tensor, "*B J 3"]
    """World frame, mm."""
    valid: Bool[Tensor, "*B J"]


@dataclass(frozen=True)
class PairObservations(Samples):
    """What the cameras saw of B pairs of cameras, each with M frames of one person before its rig.

    All views travel with a pair, so that whoever estimates a whole rig has the same frames; the
    pairs of one ``draw`` share theirs.
    """

    rig: Int[Tensor, " B"]
    """Index of the rig among those of the split."""
    draw: Int[Tensor, " B"]
    """Number of the draw of frames, over all rigs."""
    pair: Int[Tensor, "B 2"]
    """The views: reference a, then target b; ``x_b = R x_a + t``."""
    K: Float[Tensor, "B V 3 3"]
    """Intrinsics, pixels, float64."""
    baseline: Float[Tensor, " B"]
    """Distance between the two cameras, mm: the one length that the paper takes as known."""
    key_points: Float[Tensor, "B V M J 2"]
    """Undistorted pixels."""
    confidence: Float[Tensor, "B V M J"]
    valid: Bool[Tensor, "B V M J"]

    def select_pair(self, values: Tensor) -> Tensor:
        """Select from values [B, V, ...] those of the two views: [B, 2, ...]."""
        return select_views(values, self.pair)

    def correspondences(
        self,
    ) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
        """Return the points in a, those in b, and which of them both views see.

        N = M x J; normalised image coordinates, float64. A point that one view misses is 0.
        """
        pixels = self.select_pair(self.key_points).flatten(2, 3)
        points = normalise(self.select_pair(self.K), pixels)
        finite = torch.isfinite(points).all(-1).all(1)
        both = self.select_pair(self.valid).flatten(2, 3).all(dim=1) & finite
        points = torch.where(both[:, None, :, None], points, 0.0)
        return points[:, 0], points[:, 1], both


@dataclass(frozen=True)
class PairTruth(Batch):
    """The true cameras of B pairs, and the points on which errors are measured."""

    cameras: Cameras
    """The reference, then the target camera; leading dimensions B 2, float64."""
    points: Float[Tensor, "B P 3"]
    """Random points of the capture volume, world, mm: the paper's X*."""

    def relative_pose(self) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
        """Return R and t (mm) of ``x_b = R x_a + t``."""
        return self.cameras.relative_pose(0, 1)


def select_views(
    values: Float[Tensor, "B V *shape"] | Bool[Tensor, "B V *shape"], views: Int[Tensor, "B N"]
) -> Float[Tensor, "B N *shape"] | Bool[Tensor, "B N *shape"]:
    """Return the values of each item's own choice of N views."""
    item = torch.arange(len(views), device=values.device)[:, None]
    return values[item, views]


ObservationsT = TypeVar("ObservationsT", bound=Samples)
TruthT = TypeVar("TruthT", bound=Batch)


@dataclass(frozen=True)
class Labelled(Batch, Generic[ObservationsT, TruthT]):
    """What training and testing load: observations, and the truth beside them."""

    observations: ObservationsT
    truth: TruthT

    def __len__(self) -> int:
        return len(self.observations)


@dataclass(frozen=True)
class Estimate(Batch, ABC):
    """What an aggregation or a classical estimator gives: tensors, and a mask ``estimated``."""

    @abstractmethod
    def valid(self) -> Bool[Tensor, "*B"]:
        """Return where the estimate means something: estimated, and finite."""

    def mask_invalid(self: EstimateT) -> EstimateT:
        """Return the estimate with zeros where it is not valid, and not ``estimated`` there."""
        valid = self.valid()
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        masked = {name: torch.where(expand_mask(valid, x), x, 0) for name, x in values.items()}
        return replace(self, **masked | {"estimated": valid})


@dataclass(frozen=True)
class PoseEstimate(Estimate):
    """3D poses from any aggregation or classical estimator.

    A joint that is not ``estimated`` is finite but meaningless: it had too few views, and nothing
    was invented for it.
    """

    points: Float[Tensor, "*B J 3"]
    """World frame, mm."""
    estimated: Bool[Tensor, "*B J"]

    def valid(self) -> Bool[Tensor, "*B J"]:
        """Return which joints are estimated and finite."""
        return self.estimated & self.points.isfinite().all(-1)


@dataclass(frozen=True)
class RelativePoseEstimate(Estimate):
    """Relative camera poses ``x_b = R x_a + t`` from any aggregation or classical estimator.

    One that is not ``estimated`` is the identity with t = 0 and means nothing.
    """

    R: Float[Tensor, "*B 3 3"]
    t: Float[Tensor, "*B 3"]
    """mm; of length 1 where nothing has given it a scale."""
    estimated: Bool[Tensor, "*B"]

    def valid(self) -> Bool[Tensor, "*B"]:
        """Return which poses are estimated, finite, and have a translation of some length."""
        finite = self.R.isfinite().flatten(-2).all(-1) & self.t.isfinite().all(-1)
        return self.estimated & finite & (self.t != 0).any(-1)

    def mask_invalid(self) -> RelativePoseEstimate:
        """Return the poses with the identity and t = 0 where they are not valid."""
        valid = self.valid()
        eye = torch.eye(3, dtype=self.R.dtype, device=self.R.device)
        R = torch.where(valid[..., None, None], self.R, eye)
        return RelativePoseEstimate(R, torch.where(valid[..., None], self.t, 0.0), valid)


def expand_mask(mask: Bool[Tensor, "*B"], values: Tensor) -> Bool[Tensor, ...]:
    """Return the mask with as many trailing dimensions of length 1 as ``values`` has more."""
    return mask.reshape(*mask.shape, *[1] * (values.dim() - mask.dim()))


def joints_with_enough_views(valid: Bool[Tensor, "*B V J"], least: int = 2) -> Bool[Tensor, "*B J"]:
    """Return which joints are seen in at least ``least`` views, the fewest to triangulate from."""
    return valid.sum(dim=-2) >= least
