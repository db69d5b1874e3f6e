"""The camera check, asked about a recording that was predicted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ghpt.calibration.check.evidence import choose
from ghpt.calibration.check.examination import Checkup, Doctor
from ghpt.calibration.check.setup import as_filed
from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError

_WHOLE = 2048
"""Frames: a longer recording is looked at in windows."""
_WINDOWS = 12


def check_cameras(sequence: Sequence, doctor: Doctor) -> Checkup | None:
    """Return what the camera check finds on a bounded number of frames.

    Returns None where no frame shows enough.
    """
    rows = _windows(len(sequence))
    points = sequence.detected(rows)
    try:
        evidence = choose(
            sequence.cameras.names,
            points.pixels.astype(np.float64),
            np.array(points.valid),
            sequence.frame[rows],
            doctor.frames,
            doctor.shift,
            sequence.source,
        )
    except GhptDataError:  # no frame has enough joints in two views: nothing can be told
        return None
    return doctor(evidence, as_filed(sequence.cameras))


def _windows(count: int) -> Int[np.ndarray, " N"]:
    """All rows, or evenly spread windows, long enough for the shifts that are tried."""
    if count <= _WHOLE:
        return np.arange(count)
    length = _WHOLE // _WINDOWS
    starts = np.linspace(0, count - length, _WINDOWS).astype(np.int64)
    return (starts[:, None] + np.arange(length)).reshape(-1)
