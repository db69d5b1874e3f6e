"""The mended files: a calibration as Pose2Sim's, and key points where these had to change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ghpt.calibration.check.camera_check import CameraCheckResult
from ghpt.calibration.check.evidence import moment
from ghpt.calibration.check.setup import Setup
from ghpt.calibration.findings import Finding
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.key_points import write_key_points
from ghpt.data.people.sequence import Sequence
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import JOINTS, MIRROR

CAMERAS_FILE = "cameras.toml"
KEY_POINTS_FILE = "keypoints.npz"
MENDED = (CAMERAS_FILE, KEY_POINTS_FILE)


def write_mended(
    output: Path,
    cameras: CameraSet,
    result: CameraCheckResult,
    sequence: Sequence | None,
    time: tuple[Finding, ...] = (),
) -> None:
    """Write the mended cameras, and the mended key points where a view was shifted, thinned to the
    others' frames, mirrored or its sides exchanged.

    Exchanged views are mended by their cameras' names alone. ``time``: what was wrong with the time
    of the views, which is undone in ``sequence`` already.
    """
    setup = result.setup
    names = tuple(cameras.names[source] for source in setup.source)
    rig = replace(
        cameras,
        names=names,
        K=setup.K,
        R=setup.R,
        t=setup.t,
        distortion=setup.lens,
        size=torch.tensor([setup.width, setup.height]).T.round().long(),
    )
    every = (*time, *result.findings)
    mended = "; ".join(finding.text for finding in every if finding.mended)
    changed = sequence is not None and (bool(time) or _changes_points(setup))
    if changed:  # they are in one time now
        rig = replace(rig, clock=None)
    write_pose2sim(output / CAMERAS_FILE, rig, {"adjusted": True, "mended": mended})
    if sequence is not None and changed:
        points = mend_points(sequence, setup)
        path = output / KEY_POINTS_FILE
        write_key_points(path, names, JOINTS, sequence.frame, points, sequence.rate_hz)


def mend_points(sequence: Sequence, setup: Setup) -> KeyPoints:
    """Return the key points as the mended cameras are given them, in their order."""
    given = sequence.detected()
    pixels = given.pixels.astype(np.float64)
    confidence = given.confidence.astype(np.float64)
    valid = given.valid.copy()
    for view, source in enumerate(setup.source):
        rows, exists = moment(sequence.frame, setup.rate[view], setup.shift[view])
        order = list(MIRROR) if setup.sides[view] else slice(None)
        own = given[rows, source]
        pixels[:, view] = own.pixels[:, order]
        confidence[:, view] = own.confidence[:, order]
        valid[:, view] = own.valid[:, order] & exists[:, None]
        if setup.mirrored[view]:
            pixels[:, view, :, 0] = setup.width[view] - 1 - pixels[:, view, :, 0]
    return KeyPoints(pixels, confidence, valid)


def _changes_points(setup: Setup) -> bool:
    rates = any(rate != 1 for rate in setup.rate)
    return rates or any(setup.shift) or any(setup.mirrored) or any(setup.sides)
