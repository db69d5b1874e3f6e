"""Other people's calibration and triangulation, each called in its own way on the same input.

An adapter is a function. It imports its package when it is called, so that the benchmarks run with
whichever packages are installed. The triangulations are those that predict.py compares with.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import butter, filtfilt

from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.peers import Aniposelib, Pose2Sim
from ghpt.observations import Observations, PoseEstimate

MSAC_PIXELS = 10.0
"""Inlier threshold of aniposelib-pytorch's robust triangulation."""
POSE2SIM_PIXELS = 15.0
"""Largest mean reprojection error of a point of Pose2Sim's."""
POSE2SIM_LIKELIHOOD = 0.3
POSE2SIM_SUBSETS = 500
"""Most subsets of views in a step of the exclusion."""
POSE2SIM_GAP = 20
"""Frames; shorter gaps are interpolated."""
POSE2SIM_CUTOFF_HZ = 6.0
CALISCOPE_FILTER = 2.5
"""Per cent of the key points that caliscope takes away between its adjustments."""
ANIPOSE_SCHEDULE = ((200, 100, 50), (40, 20, 10, 5), (20, 10, 5))
"""Thresholds of the adjustments of aniposelib-pytorch, pixels."""


@dataclass(frozen=True)
class Evidence:
    """What a calibration is given: one person in V views of F frames, and the intrinsics."""

    key_points: Float[np.ndarray, "V F 17 2"]
    """Undistorted pixels."""
    valid: Bool[np.ndarray, "V F 17"]
    K: Float[np.ndarray, "V 3 3"]
    size: Int[np.ndarray, "V 2"]
    """Width and height of the images, pixels."""

    @property
    def with_nan(self) -> Float[np.ndarray, "V F 17 2"]:
        """The key points, NaN where they are missing."""
        return np.where(self.valid[..., None], self.key_points, np.nan)


Calibrate = Callable[[Evidence], Cameras]
"""Returns all cameras in a world and unit of its own. Raises whatever it likes where it fails."""


class NotPlaced(Exception):
    """A rig without some of its cameras."""


@dataclass(frozen=True)
class Peer:
    """A method, and the package that it needs (None: ghpt alone)."""

    name: str
    package: str | None
    calibrate: Calibrate


def installed(package: str | None) -> bool:
    """Return whether the package is there; say on the terminal which is not."""
    if package is None:
        return True
    try:
        version(package)
    except PackageNotFoundError:
        print(f"Left out: {package} is not installed.", file=sys.stderr)
        return False
    return True


def cameras_of(K: np.ndarray, R: np.ndarray, t: np.ndarray) -> Cameras:
    """Return the cameras of three arrays, float64."""
    return Cameras(*(torch.from_numpy(np.asarray(x, dtype=np.float64)) for x in (K, R, t)))


def caliscope(evidence: Evidence, filter_percentile: float = CALISCOPE_FILTER) -> Cameras:
    """Return caliscope's rig: essential matrices, then adjustments with a filter between them."""
    import pandas
    from caliscope.api import CameraArray, CameraData, ImagePoints, calibrate_extrinsics

    view, frame, joint = np.nonzero(evidence.valid)
    pixels = evidence.key_points[view, frame, joint]
    columns = {
        "sync_index": frame,
        "cam_id": view,
        "object_id": np.zeros_like(view),
        "keypoint_id": joint,
        "img_loc_x": pixels[:, 0],
        "img_loc_y": pixels[:, 1],
    }
    views = range(len(evidence.K))
    array = CameraArray(
        {
            v: CameraData(
                cam_id=v,
                size=tuple(evidence.size[v].tolist()),
                matrix=evidence.K[v],
                distortions=np.zeros(5),
            )
            for v in views
        }
    )
    run = calibrate_extrinsics(
        ImagePoints(pandas.DataFrame(columns)),
        array,
        None,
        refine_intrinsics=False,
        filter_percentile=filter_percentile,
    )
    placed = run.capture_volume.camera_array.posed_cameras
    if len(placed) < len(views):
        raise NotPlaced(f"{len(placed)} of {len(views)} cameras")
    R = np.stack([placed[v].rotation for v in views])
    t = np.stack([placed[v].translation for v in views])
    return cameras_of(evidence.K, R, t)


def aniposelib(
    evidence: Evidence, schedule: tuple[tuple[int, ...], ...] = ANIPOSE_SCHEDULE
) -> Cameras:
    """Return aniposelib-pytorch's rig: structure from motion, then robust adjustments."""
    from aniposelib.init import calibrate_from_points

    views = range(len(evidence.K))
    names = [f"c{v}" for v in views]
    group, _ = calibrate_from_points(
        evidence.with_nan,
        names,
        evidence.size,
        dict(zip(names, evidence.K, strict=True)),
        ba_kwargs={"schedule": schedule},
        report=False,
        rng=0,
    )
    if group.get_names() != names:
        raise NotPlaced(f"{len(group.get_names())} of {len(views)} cameras")
    pose = np.stack([np.asarray(c.get_extrinsics_mat().detach()) for c in group.cameras])
    return cameras_of(evidence.K, pose[:, :3, :3], pose[:, :3, 3])


def as_estimate(points: Float[np.ndarray, "T J 3"]) -> PoseEstimate:
    """Return points, NaN where there is none, as an estimate."""
    found = torch.from_numpy(points)
    return PoseEstimate(found.nan_to_num(0.0), found.isfinite().all(-1))


def anipose_linear(batch: Observations) -> PoseEstimate:
    """Return aniposelib-pytorch's triangulation from all views."""
    return Aniposelib(None)(batch)


def anipose_msac(batch: Observations, tau: float = MSAC_PIXELS) -> PoseEstimate:
    """Return aniposelib-pytorch's robust triangulation; ``tau`` in pixels."""
    return Aniposelib(tau)(batch)


def pose2sim(batch: Observations, largest_error: float = POSE2SIM_PIXELS) -> PoseEstimate:
    """Return Pose2Sim's weighted triangulation with exclusion of cameras."""
    return Pose2Sim(largest_error, POSE2SIM_LIKELIHOOD, POSE2SIM_SUBSETS)(batch)


def pose2sim_filtered(
    batch: Observations, rate_hz: float, largest_error: float = POSE2SIM_PIXELS
) -> PoseEstimate:
    """Return `pose2sim` with what Pose2Sim does to whole recordings by default.

    Short gaps are filled linearly; a Hampel filter and a Butterworth filter of 6 Hz follow.
    """
    found = pose2sim(batch, largest_error)
    points = torch.where(found.estimated[..., None], found.points, torch.nan).numpy()
    columns = points.reshape(len(points), -1)
    smooth = [_smooth(column, rate_hz) for column in columns.T]
    return as_estimate(np.stack(smooth, axis=-1).reshape(points.shape))


def _smooth(column: Float[np.ndarray, " T"], rate_hz: float) -> Float[np.ndarray, " T"]:
    known = np.flatnonzero(np.isfinite(column))
    if not len(known):
        return column
    filled = np.interp(np.arange(len(column)), known, column[known])
    gap = np.diff(known) - 1
    inside = np.concatenate([[False], np.repeat(gap < POSE2SIM_GAP, np.diff(known))])
    start = known[0]
    column = column.copy()
    part = column[start : known[-1] + 1]
    part[inside] = filled[start : known[-1] + 1][inside]
    runs = np.flatnonzero(np.diff(np.isfinite(column), prepend=False, append=False))
    b, a = butter(2, POSE2SIM_CUTOFF_HZ / (rate_hz / 2), "low")
    for first, last in runs.reshape(-1, 2):
        if last - first > 3 * max(len(a), len(b)):
            column[first:last] = filtfilt(b, a, _hampel(column[first:last]))
    return column


def _hampel(column: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Replace values that are 2 robust deviations from the median of 7 by that median."""
    windows = sliding_window_view(column, 7)
    median = np.median(windows, axis=-1)
    spread = np.median(np.abs(windows - median[:, None]), axis=-1)
    middle = column[3:-3]
    outlier = (spread > 0) & (0.6745 * np.abs(middle - median) > 2 * spread)
    result = column.copy()
    result[3:-3] = np.where(outlier, median, middle)
    return result
