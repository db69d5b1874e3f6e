"""The mended files: a calibration as Pose2Sim's, and key points where these had to change."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ghpt.calibration.check.evidence import moment
from ghpt.calibration.check.examination import Checkup
from ghpt.calibration.check.setup import Setup
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.key_points import write_key_points
from ghpt.data.people.sequence import Sequence
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.skeleton import JOINTS, MIRROR

MENDED = ("cameras.toml", "keypoints.npz")


def write_mended(
    output: Path, cameras: CameraSet, checkup: Checkup, sequence: Sequence | None
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
    if sequence is not None and _changes_points(setup):
        points = mended_points(sequence, checkup)
        path = output / MENDED[1]
        write_key_points(path, names, JOINTS, sequence.frame, points, sequence.rate_hz)


def _changes_points(setup: Setup) -> bool:
    rates = any(rate != 1 for rate in setup.rate)
    return rates or any(setup.shift) or any(setup.mirrored) or any(setup.sides)


def mended_points(sequence: Sequence, checkup: Checkup) -> KeyPoints:
    """Return the key points as the mended cameras are to be shown them, in their order."""
    setup = checkup.setup
    old = sequence.detected()
    pixels = old.pixels.copy()
    confidence = old.confidence.copy()
    valid = old.valid.copy()
    for view, source in enumerate(setup.source):
        rows, there = moment(sequence.frame, setup.rate[view], setup.shift[view])
        moved = old[rows, source]
        joints = list(MIRROR) if setup.sides[view] else slice(None)
        pixels[:, view] = moved.pixels[:, joints]
        confidence[:, view] = moved.confidence[:, joints]
        valid[:, view] = moved.valid[:, joints] & there[:, None]
        if setup.mirrored[view]:
            pixels[:, view, :, 0] = setup.width[view] - 1 - pixels[:, view, :, 0]
    return KeyPoints(pixels.astype(np.float64), confidence.astype(np.float64), valid)
