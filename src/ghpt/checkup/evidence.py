"""What the doctor looks at: a choice of frames, each with the frames around it, as the detector gave them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.camera_files import CameraFile
from ghpt.data.key_points import KeyPoints
from ghpt.data.names import Name
from ghpt.data.skeletons import joints17
from ghpt.data.views import matched
from ghpt.errors import GhptDataError

_LEAST_JOINTS = 6
"""Seen in two views for a frame to be looked at."""


@dataclass(frozen=True)
class Evidence:
    """F frames of V views of one person, each with its 2N neighbours in time (S = 2N + 1, the frame itself at N)."""

    names: tuple[str, ...]
    pixels: Float[Tensor, "V S F J 2"]
    """As detected, through the lens."""
    seen: Bool[Tensor, "V S F J"]
    frame: Int[Tensor, " F"]

    @property
    def reach(self) -> int:
        """N: the largest shift in time that can be tried, in frames."""
        return (self.seen.shape[1] - 1) // 2


def gather(
    points: KeyPoints,
    cameras: CameraFile,
    match: Mapping[Name, Name],
    views: Sequence[Name] | None,
    frames: int,
    reach: int,
) -> tuple[Evidence, CameraFile, tuple[int, ...]]:
    """At most ``frames`` frames, evenly spread over those in which people are seen; their cameras in the order of the
    views; and which of the key points' views these are. ``reach``: the largest shift, at most a quarter of the frames.

    Raises GhptDataError where views and cameras do not match, without extrinsics, and with fewer than two views.
    """
    pairs = matched(points.path, points.views, cameras, match, views)
    if len(pairs) < 2:
        raise GhptDataError(points.path, "views", f"{len(pairs)} with a camera", "Give two views or more.")
    at, ordered = [view for view, _ in pairs], cameras.select([camera for _, camera in pairs])
    if ordered.cameras is None:
        mend = "Calibrate them first: python calibrate.py --help"
        raise GhptDataError(cameras.path, "extrinsics", "are missing: there is nothing to check", mend)
    arrays = points.key_points[:, at], points.confidence[:, at], points.seen[:, at]
    pixels, _, seen = joints17(points.path, points.joints, *arrays)
    return choose(ordered.names, pixels, seen, points.frame, frames, reach, points.path), ordered, tuple(at)


def choose(
    names: tuple[str, ...], pixels: Float[np.ndarray, "T V J 2"], seen: Bool[np.ndarray, "T V J"],
    frame: Int[np.ndarray, " T"], frames: int, reach: int, where: str,
) -> Evidence:  # fmt: skip
    """The evidence of a recording's detected pixels; a frame number that is left out is a gap in time."""
    usable = np.flatnonzero((seen.sum(1) >= 2).sum(-1) >= _LEAST_JOINTS)
    if not len(usable):
        mend = "Check that the views show the same person at the same time."
        raise GhptDataError(where, "key points", f"no frame has {_LEAST_JOINTS} joints in two views", mend)
    rows = usable[np.unique(np.linspace(0, len(usable) - 1, min(frames, len(usable))).round().astype(int))]
    reach = min(reach, len(usable) // 4)
    wanted = frame[rows][None] + np.arange(-reach, reach + 1)[:, None]
    index = np.searchsorted(frame, wanted).clip(0, len(frame) - 1)
    there = frame[index] == wanted
    finite = np.isfinite(pixels).all(-1)
    seen = (seen & finite)[index] & there[..., None, None]
    pixels = np.where(seen[..., None], pixels[index], 0.0)
    order = (2, 0, 1, 3)
    return Evidence(
        names, torch.from_numpy(pixels.transpose(*order, 4)).double(), torch.from_numpy(seen.transpose(*order).copy()),
        torch.from_numpy(frame[rows].astype(np.int64)),
    )  # fmt: skip
