"""The mended files: a calibration as Pose2Sim's, and key points where these had to change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ghpt.calibration.check.camera_check import CameraCheckResult
from ghpt.calibration.check.evidence import moment
from ghpt.calibration.check.setup import Setup
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.key_points import KeyPoints, write_key_points
from ghpt.data.formats.skeletons import joints17
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import JOINTS, MIRROR

CAMERAS_FILE = "cameras.toml"
KEY_POINTS_FILE = "keypoints.npz"
MENDED = (CAMERAS_FILE, KEY_POINTS_FILE)


def write_mended(
    output: Path,
    cameras: CameraSet,
    result: CameraCheckResult,
    points: KeyPoints | None,
    views: Sequence[int],
) -> None:
    """Write the mended cameras, and the mended key points where a view was shifted, thinned to the
    others' frames, mirrored or its sides exchanged.

    Exchanged views are mended by their cameras' names alone. ``views``: which of the key points'
    views the cameras are of.
    """
    setup = result.setup
    rig = replace(
        cameras,
        names=_names(cameras, setup),
        K=setup.K,
        R=setup.R,
        t=setup.t,
        distortion=setup.lens,
        size=cameras.image_size,
    )
    mended = "; ".join(finding.text for finding in result.findings if finding.mended)
    write_pose2sim(output / CAMERAS_FILE, rig, {"adjusted": True, "mended": mended})
    if points is not None and _changes_points(setup):
        write_key_points(output / KEY_POINTS_FILE, mend_points(points, views, cameras, setup))


def mend_points(
    points: KeyPoints, views: Sequence[int], cameras: CameraSet, setup: Setup
) -> KeyPoints:
    """Return the key points as the mended cameras are given them, in their order and by their
    names.
    """
    at = list(views)
    given, confidence, valid = joints17(
        points.path,
        points.joints,
        points.key_points[:, at],
        points.confidence[:, at],
        points.valid[:, at],
    )
    new_points = given.astype(np.float64)
    new_confidence = confidence.astype(np.float64)
    new_valid = valid.copy()
    for view, source in enumerate(setup.source):
        rows, exists = moment(points.frame, setup.rate[view], setup.shift[view])
        order = list(MIRROR) if setup.sides[view] else slice(None)
        new_points[:, view] = given[rows, source][:, order]
        new_confidence[:, view] = confidence[rows, source][:, order]
        new_valid[:, view] = valid[rows, source][:, order] & exists[:, None]
        if setup.mirrored[view]:
            new_points[:, view, :, 0] = setup.width[view] - 1 - new_points[:, view, :, 0]
    several = tuple(points.several[at[source]] for source in setup.source)
    return replace(
        points,
        views=_names(cameras, setup),
        joints=JOINTS,
        key_points=new_points,
        confidence=new_confidence,
        valid=new_valid,
        several=several,
    )


def _names(cameras: CameraSet, setup: Setup) -> tuple[str, ...]:
    return tuple(cameras.names[source] for source in setup.source)


def _changes_points(setup: Setup) -> bool:
    rates = any(rate != 1 for rate in setup.rate)
    return rates or any(setup.shift) or any(setup.mirrored) or any(setup.sides)
