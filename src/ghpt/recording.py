"""What crosses the borders between the stages: a recording, and the batch drawn from it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.cameras import Cameras
from ghpt.geometry.epipolar import normalise


@dataclass(frozen=True)
class Recording:
    """One take of one person by one rig: T frames, V views, J = 17 joints. Arrays may be memory
    maps.

    All quirks of a data set end here: millimetres, ideal pinhole pixels (lens distortion is
    undone), world to camera, joints in the order of ``ghpt.skeleton.JOINTS``. A value whose mask is
    False is finite but meaningless.
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
    truth: Float[np.ndarray, "T J 3"]
    """World frame, mm."""
    truth_valid: Bool[np.ndarray, "T J"]
    """All False in a recording without ground truth."""
    frame: Int[np.ndarray, " T"]
    """The data set's own frame number."""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Observations:
    """B frames, from any recordings of one camera arrangement."""

    sample: Int[Tensor, " B"]
    """Position in the data set: the key of the frame's random draws, whatever batch or process it
    is in.
    """
    recording: Int[Tensor, " B"]
    """Index of the frame's recording in the data set."""
    cameras: Cameras
    """K, R, t with leading dimensions B V, float64."""
    key_points: Float[Tensor, "B V J 2"]
    confidence: Float[Tensor, "B V J"]
    valid: Bool[Tensor, "B V J"]
    truth: Float[Tensor, "B J 3"]
    truth_valid: Bool[Tensor, "B J"]

    def __len__(self) -> int:
        return len(self.sample)

    def to(self, *args: Any, **kwargs: Any) -> Observations:
        """Move to a device."""
        return Observations(
            **{f.name: getattr(self, f.name).to(*args, **kwargs) for f in fields(self)}
        )

    def rows(self, index: Int[Tensor, " b"]) -> Observations:
        """The frames at these places."""
        parts = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "cameras"}
        return Observations(cameras=self.cameras.index(index), **parts)

    def pin_memory(self) -> Observations:
        return Observations(**{f.name: getattr(self, f.name).pin_memory() for f in fields(self)})


@dataclass(frozen=True)
class PoseEstimate:
    """3D poses from any selection or classical estimator. A joint that is not ``estimated`` is
    finite but meaningless: it had too few views, and nothing was invented for it.
    """

    points: Float[Tensor, "*B J 3"]
    """World frame, mm."""
    estimated: Bool[Tensor, "*B J"]


@dataclass(frozen=True)
class PairBatch:
    """B pairs of cameras, each with M frames of one person before its rig. All views travel with a
    pair, so that whoever estimates a whole rig has the same frames; the pairs of one ``draw`` share
    theirs.
    """

    sample: Int[Tensor, " B"]
    """Position in the data set: the key of the pair's random draws."""
    rig: Int[Tensor, " B"]
    """Index of the rig among those of the split."""
    draw: Int[Tensor, " B"]
    """Number of the draw of frames, over all rigs."""
    pair: Int[Tensor, "B 2"]
    """The views: reference a, then target b; ``x_b = R x_a + t``."""
    cameras: Cameras
    """K (known) and the true R, t (for errors and the known scale alone), leading dimensions B V,
    float64.
    """
    key_points: Float[Tensor, "B V M J 2"]
    confidence: Float[Tensor, "B V M J"]
    valid: Bool[Tensor, "B V M J"]
    points: Float[Tensor, "B P 3"]
    """Random points of the capture volume, world, mm: the paper's X*."""

    def __len__(self) -> int:
        return len(self.sample)

    def to(self, *args: Any, **kwargs: Any) -> PairBatch:
        return PairBatch(
            **{f.name: getattr(self, f.name).to(*args, **kwargs) for f in fields(self)}
        )

    def pin_memory(self) -> PairBatch:
        return PairBatch(**{f.name: getattr(self, f.name).pin_memory() for f in fields(self)})

    def of_pair(self, values: Tensor) -> Tensor:
        """Of values [B, V, ...] those of the pair: [B, 2, ...]."""
        return values[torch.arange(len(self), device=values.device)[:, None], self.pair]

    def correspondences(
        self,
    ) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
        """The pairs' points in a and in b, N = M x J, normalised image coordinates (float64), and
        which of them both see; the others are 0.
        """
        points = normalise(
            self.of_pair(self.cameras.K), self.of_pair(self.key_points).flatten(2, 3)
        )
        both = self.of_pair(self.valid).flatten(2, 3).all(dim=1) & torch.isfinite(points).all(
            -1
        ).all(1)
        points = torch.where(both[:, None, :, None], points, 0.0)
        return points[:, 0], points[:, 1], both

    def pair_cameras(self) -> Cameras:
        """The reference and the target camera, [B, 2]."""
        return Cameras(*(self.of_pair(getattr(self.cameras, name)) for name in ("K", "R", "t")))


@dataclass(frozen=True)
class RelativePoseEstimate:
    """Relative camera poses from any selection or classical estimator: ``x_b = R x_a + t``. One
    that is not ``estimated`` is the identity with t = 0 and means nothing.
    """

    R: Float[Tensor, "*B 3 3"]
    t: Float[Tensor, "*B 3"]
    """mm; of length 1 where nothing has given it a scale."""
    estimated: Bool[Tensor, "*B"]


def joints_with_enough_views(valid: Bool[Tensor, "*B V J"], least: int = 2) -> Bool[Tensor, "*B J"]:
    """Which joints are seen in at least ``least`` views, the fewest that triangulation needs."""
    return valid.sum(dim=-2) >= least
