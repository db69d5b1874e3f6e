"""The mended files: a calibration as Pose2Sim's, and key points where these had to change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ghpt.calibration.check.evidence import moment
from ghpt.calibration.check.examination import Checkup
from ghpt.calibration.check.setup import Setup
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.key_points import KeyPoints, write_key_points
from ghpt.data.formats.skeletons import joints17
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.skeleton import JOINTS, MIRROR

MENDED = ("cameras.toml", "keypoints.npz")


def write_mended(
    output: Path, cameras: CameraSet, checkup: Checkup, points: KeyPoints | None, at: Sequence[int]
) -> None:
    """``cameras.toml``; and ``keypoints.npz``, the 17 joints, where a view was shifted, thinned to
    the others' frames, mirrored or its sides exchanged. Exchanged views are mended by their
    cameras' names alone.
    """
    setup = checkup.setup
    names = tuple(cameras.names[source] for source in setup.source)
    rig = CameraSet.from_cameras(
        names, Cameras(setup.K, setup.R, setup.t), setup.lens, cameras.image_size
    )
    said = "; ".join(finding.text for finding in checkup.findings if finding.mended)
    write_pose2sim(output / MENDED[0], rig, {"adjusted": True, "mended": said})
    if points is not None and (_changes_points(setup)):
        write_key_points(output / MENDED[1], mended_points(points, at, cameras, checkup))


def _changes_points(setup: Setup) -> bool:
    rates = any(rate != 1 for rate in setup.rate)
    return rates or any(setup.shift) or any(setup.mirrored) or any(setup.sides)


def mended_points(
    points: KeyPoints, at: Sequence[int], cameras: CameraSet, checkup: Checkup
) -> KeyPoints:
    """The key points as the mended cameras are to be shown them, in the order and by the names of
    these.
    """
    setup = checkup.setup
    at = list(at)
    arrays = points.key_points[:, at], points.confidence[:, at], points.valid[:, at]
    pixels, sure, valid = (array.copy() for array in joints17(points.path, points.joints, *arrays))
    old = pixels.copy(), sure.copy(), valid.copy()
    for view, source in enumerate(setup.source):
        rows, there = moment(points.frame, setup.rate[view], setup.shift[view])
        for new, given in zip((pixels, sure, valid), old, strict=True):
            moved = given[rows, source]
            new[:, view] = moved[:, list(MIRROR)] if setup.sides[view] else moved
        valid[:, view] &= there[:, None]
        if setup.mirrored[view]:
            pixels[:, view, :, 0] = setup.width[view] - 1 - pixels[:, view, :, 0]
    names = tuple(cameras.names[source] for source in setup.source)
    several = tuple(points.several[at[source]] for source in setup.source)
    return KeyPoints(
        points.path,
        names,
        JOINTS,
        points.frame,
        pixels.astype(np.float64),
        sure.astype(np.float64),
        valid,
        points.rate_hz,
        several,
    )
