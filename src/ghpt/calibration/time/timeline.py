"""What the views see of one person, by the numbers of their frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.observations import typical_size
from ghpt.geometry.epipolar import normalise


@dataclass(frozen=True)
class Timeline:
    """Key points of V views at N consecutive frames, in sizes of the person in each view."""

    xy: Float[Tensor, "V N J 2"]
    """Normalised image coordinates over ``size``; 0 where not valid."""
    valid: Bool[Tensor, "V N J"]
    size: Float[Tensor, " V"]
    """Of the person, in normalised image coordinates; 1 where nobody is seen."""
    first: int = 0
    """The number of the first frame."""

    @property
    def frames(self) -> int:
        """N."""
        return self.valid.shape[1]

    def select(self, views: Sequence[int]) -> Timeline:
        """Return some of the views."""
        at = list(views)
        return replace(self, xy=self.xy[at], valid=self.valid[at], size=self.size[at])

    def thin(self, views: Sequence[bool], step: int) -> Timeline:
        """Return every ``step``-th frame of some views, and as many of the first of the others."""
        count = -(-self.frames // step)
        xy = self.xy[:, :count].clone()
        valid = self.valid[:, :count].clone()
        for view, is_thinned in enumerate(views):
            if is_thinned:
                xy[view] = self.xy[view, ::step]
                valid[view] = self.valid[view, ::step]
        return replace(self, xy=xy, valid=valid)

    def smooth(self, width: int) -> Timeline:
        """Return running means over ``width`` frames (odd) of what is valid among them; what was
        not valid is not.
        """
        half = width // 2
        weight = self.valid.double()[..., None]
        total = torch.zeros_like(self.xy)
        count = torch.zeros_like(weight)
        for offset in range(-half, half + 1):
            start = max(0, offset)
            stop = self.frames + min(0, offset)
            there = slice(start, stop)
            here = slice(start - offset, stop - offset)
            total[:, here] += self.xy[:, there] * weight[:, there]
            count[:, here] += weight[:, there]
        mean = total / count.clamp(min=1)
        return replace(self, xy=torch.where(self.valid[..., None], mean, 0.0))


def timeline_of(
    K: Float[Tensor, "V 3 3"],
    key_points: Float[np.ndarray, "T V J 2"],
    valid: Bool[np.ndarray, "T V J"],
    frame: Int[np.ndarray, " T"],
    most: int,
) -> Timeline:
    """Return the views' undistorted key points (pixels) by the numbers of their frames.

    Of a longer recording the ``most`` frames about the middle of what was detected are kept.
    """
    seen = frame[valid.any((1, 2))]
    first, last = (int(seen[0]), int(seen[-1])) if len(seen) else (0, 0)
    if last - first >= most:
        first = int(np.median(seen)) - most // 2
        last = first + most - 1
    inside = (frame >= first) & (frame <= last)
    at = torch.from_numpy((frame[inside] - first).astype(np.int64))
    pixels = torch.from_numpy(np.nan_to_num(key_points[inside].astype(np.float64)))
    shown = torch.from_numpy(valid[inside])
    size = typical_size(pixels, shown) / (K[:, 0, 0] * K[:, 1, 1]).sqrt()
    size = torch.where(torch.isfinite(size) & (size > 0), size, 1.0)
    views, joints = shown.shape[1:]
    xy = normalise(K, pixels.transpose(0, 1).flatten(1, 2)).unflatten(1, shown.shape[::2])
    xy = torch.where(shown.transpose(0, 1)[..., None], xy / size[:, None, None, None], 0.0)
    count = last - first + 1
    all_xy = torch.zeros(views, count, joints, 2, dtype=torch.float64)
    all_valid = torch.zeros(views, count, joints, dtype=torch.bool)
    all_xy[:, at] = xy
    all_valid[:, at] = shown.transpose(0, 1)
    return Timeline(all_xy, all_valid, size, first)
