"""The mended files: a calibration as Pose2Sim's, and key points where these had to change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ghpt.checkup.examination import Checkup
from ghpt.data.camera_files import CameraFile
from ghpt.data.camera_writers import write_pose2sim
from ghpt.data.key_points import KeyPoints, write_key_points
from ghpt.data.rigs import Rig
from ghpt.data.skeletons import joints17
from ghpt.geometry.cameras import Cameras
from ghpt.skeleton import JOINTS, MIRROR

MENDED = ("cameras.toml", "keypoints.npz")


def write_mended(
    output: Path, cameras: CameraFile, checkup: Checkup, points: KeyPoints | None, at: Sequence[int]
) -> None:
    """``cameras.toml``; and ``keypoints.npz``, the 17 joints, where a view was shifted, mirrored or its sides
    exchanged. Exchanged views are mended by their cameras' names alone."""
    setup = checkup.setup
    names = tuple(cameras.names[source] for source in setup.source)
    size = (2 * cameras.K[:, :2, 2] + 1).round().long() if cameras.size is None else cameras.size
    rig = Rig(names, Cameras(setup.K, setup.R, setup.t), setup.lens, size)
    said = "; ".join(finding.text for finding in checkup.findings if finding.mended)
    write_pose2sim(output / MENDED[0], rig, {"adjusted": True, "mended": said})
    if points is not None and (any(setup.shift) or any(setup.mirrored) or any(setup.sides)):
        write_key_points(output / MENDED[1], mended_points(points, at, cameras, checkup))


def mended_points(points: KeyPoints, at: Sequence[int], cameras: CameraFile, checkup: Checkup) -> KeyPoints:
    """The key points as the mended cameras are to be shown them, in the order and by the names of these."""
    setup = checkup.setup
    at = list(at)
    arrays = points.key_points[:, at], points.confidence[:, at], points.seen[:, at]
    pixels, sure, seen = (array.copy() for array in joints17(points.path, points.joints, *arrays))
    old = pixels.copy(), sure.copy(), seen.copy()
    for view, source in enumerate(setup.source):
        wanted = points.frame + setup.shift[view]
        rows = np.searchsorted(points.frame, wanted).clip(0, len(points.frame) - 1)
        for new, given in zip((pixels, sure, seen), old, strict=True):
            moved = given[rows, source]
            new[:, view] = moved[:, list(MIRROR)] if setup.sides[view] else moved
        seen[:, view] &= (points.frame[rows] == wanted)[:, None]
        if setup.mirrored[view]:
            pixels[:, view, :, 0] = setup.width[view] - 1 - pixels[:, view, :, 0]
    names = tuple(cameras.names[source] for source in setup.source)
    several = tuple(points.several[at[source]] for source in setup.source)
    return KeyPoints(points.path, names, JOINTS, points.frame, pixels.astype(np.float64), sure.astype(np.float64),
                     seen, points.rate_hz, several)  # fmt: skip
