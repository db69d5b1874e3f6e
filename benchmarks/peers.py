"""Other people's calibration and triangulation, each called in its own way on the same input.

An adapter is a function. It imports its package when it is called, so that the benchmarks run with
whichever packages are installed. Pose2Sim's triangulation is written here from its publication,
because the package brings a whole pipeline with it.
"""

from __future__ import annotations

import itertools
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
from ghpt.observations import Observations, PoseEstimate

MSAC_PIXELS = 10.0
"""Inlier threshold of aniposelib-pytorch's robust triangulation."""
POSE2SIM_PIXELS = 15.0
"""Largest mean reprojection error of a point of Pose2Sim's."""
POSE2SIM_LIKELIHOOD = 0.3
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


def key_points_with_nan(batch: Observations) -> Float[np.ndarray, "V T J 2"]:
    """Return key points as aniposelib takes them."""
    shown = torch.where(batch.valid[..., None], batch.key_points.double(), torch.nan)
    return shown.transpose(0, 1).numpy()


def anipose_group(cameras: Cameras) -> object:
    """Return the cameras as aniposelib's."""
    from aniposelib.init import from_extrinsics

    pose = torch.cat((cameras.R, cameras.t[..., None]), dim=-1).double().numpy()
    views = len(pose)
    last_row = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (views, 1, 4))
    matrices = np.concatenate((pose, last_row), axis=1)
    names = [f"c{v}" for v in range(views)]
    return from_extrinsics(names, matrices, K=cameras.K.double().numpy())


def anipose_linear(batch: Observations) -> PoseEstimate:
    """Return aniposelib-pytorch's triangulation from all views."""
    group = anipose_group(batch.cameras.index(0))
    return as_estimate(group.triangulate(key_points_with_nan(batch)))


def anipose_msac(batch: Observations, tau: float = MSAC_PIXELS) -> PoseEstimate:
    """Return aniposelib-pytorch's robust triangulation; ``tau`` in pixels."""
    group = anipose_group(batch.cameras.index(0))
    return as_estimate(group.triangulate_robust(key_points_with_nan(batch), tau=tau).p3d)


def pose2sim(batch: Observations, largest_error: float = POSE2SIM_PIXELS) -> PoseEstimate:
    """Return Pose2Sim's weighted triangulation with exclusion of cameras (Pagnon et al. 2022).

    Each point is triangulated from all its views, and while its mean reprojection error exceeds
    ``largest_error`` (pixels) from all subsets with one view fewer, of which the best is taken. A
    point that no two views explain is missing.
    """
    frames, views, joints = batch.valid.shape
    camera = batch.cameras.index(0)
    metres = camera.t / 1000
    P = (camera.K @ torch.cat((camera.R, metres[..., None]), dim=-1)).double().numpy()
    pixels = batch.key_points.double().numpy().swapaxes(1, 2).reshape(-1, views, 2)
    weight = batch.confidence.double().numpy().swapaxes(1, 2).reshape(-1, views)
    valid = batch.valid.numpy().swapaxes(1, 2).reshape(-1, views)
    weight = np.where(valid & (weight >= POSE2SIM_LIKELIHOOD), weight, 0.0)
    points = np.full((len(pixels), 3), np.nan)
    count = (weight > 0).sum(-1)
    for excluded in range(views - 1):
        rows = np.flatnonzero(np.isnan(points[:, 0]) & (count - excluded >= 2))
        best = np.full(len(rows), np.inf)
        for out in itertools.combinations(range(views), excluded):
            own = weight[rows]
            own[:, out] = 0.0
            found, error = _weighted_dlt(P, pixels[rows], own)
            better = (error < best) & (error <= largest_error)
            points[rows[better]] = found[better]
            best = np.where(better, error, best)
    return as_estimate(1000 * points.reshape(frames, joints, 3))


def _weighted_dlt(
    P: Float[np.ndarray, "V 3 4"],
    pixels: Float[np.ndarray, "N V 2"],
    weight: Float[np.ndarray, "N V"],
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Return points and their mean reprojection error over the views of weight above 0."""
    rows = pixels[..., None] * P[:, None, 2] - P[:, :2]
    rows = (weight[..., None, None] * rows).reshape(len(pixels), 2 * len(P), 4)
    _, _, Vt = np.linalg.svd(rows, full_matrices=False)
    solution = Vt[:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        point = solution[:, :3] / solution[:, 3:]
        image = np.einsum("vij,nj->nvi", P, solution)
        offset = image[..., :2] / image[..., 2:] - pixels
        distance = np.where(weight > 0, np.linalg.norm(offset, axis=-1), 0.0)
        error = distance.sum(-1) / (weight > 0).sum(-1)
    return point, np.where(np.isfinite(error), error, np.inf)


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
