"""The camera check, asked about a recording that was predicted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ghpt.calibration.check.evidence import choose
from ghpt.calibration.check.examination import Checkup, Doctor
from ghpt.calibration.check.setup import as_filed
from ghpt.commands.prediction.frames import Frames
from ghpt.errors import GhptDataError

_WHOLE = 2048
"""Frames: a longer recording is looked at in windows."""
_WINDOWS = 12


def check_cameras(frames: Frames, doctor: Doctor) -> Checkup | None:
    """What the camera check finds on a bounded number of frames; None where no frame shows enough."""
    if frames.detected is None:
        return None
    rows = _windows(len(frames))
    file = frames.detected.cameras
    pixels, _, valid = frames.detected.read(rows)
    pixels = np.asarray(pixels, np.float64)
    try:
        evidence = choose(
            file.names,
            pixels,
            np.array(valid),
            frames.frame[rows],
            doctor.frames,
            doctor.shift,
            frames.source,
        )
    except GhptDataError:  # no frame has enough joints in two views: nothing can be told
        return None
    return doctor(evidence, as_filed(file))


def _windows(count: int) -> Int[np.ndarray, " N"]:
    """All rows, or evenly spread windows, long enough for the shifts that are tried."""
    if count <= _WHOLE:
        return np.arange(count)
    length = _WHOLE // _WINDOWS
    starts = np.linspace(0, count - length, _WINDOWS).astype(np.int64)
    return (starts[:, None] + np.arange(length)).reshape(-1)
