"""The camera check, asked about a recording that was predicted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.check.evidence import gather_rows
from ghpt.calibration.check.recording_time import in_one_time
from ghpt.calibration.check.setup import setup_of
from ghpt.calibration.findings import Finding
from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError

_WHOLE = 2048
"""Frames; a longer recording is looked at in windows."""
_WINDOWS = 12


def check_cameras(sequence: Sequence, camera_check: CameraCheck) -> tuple[Finding, ...]:
    """Return what the camera check finds on a bounded number of frames; nothing where no frame
    shows enough.
    """
    try:
        timed = in_one_time(sequence, camera_check)
        sequence = timed.sequence
        rows = _windows(len(sequence))
        evidence = gather_rows(sequence, rows, camera_check.frames, camera_check.shift)
    except GhptDataError:  # no frame has enough joints in two views: nothing can be told
        return ()
    found = camera_check(evidence, setup_of(sequence.cameras)).findings
    return (*timed.findings, *found)


def _windows(count: int) -> Int[np.ndarray, " N"]:
    """Return all rows, or evenly spread windows, long enough for the shifts that are tried."""
    if count <= _WHOLE:
        return np.arange(count)
    length = _WHOLE // _WINDOWS
    starts = np.linspace(0, count - length, _WINDOWS).astype(np.int64)
    return (starts[:, None] + np.arange(length)).reshape(-1)
