"""A finding: one thing that is wrong with cameras, with key points, or with what came of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding matters."""

    WARNING = "warning"
    """The result is worth a look."""
    ERROR = "error"
    """The result, or what the named cameras give to it, is not to be used."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, as calibrate.py, cameras.py and predict.py all say it.

    Its fields are the keys of a finding in calibration.json, cameras.json and prediction.json.
    """

    code: str
    """The name of the mistake, see `ghpt.calibration.mistakes`."""
    severity: Severity
    text: str
    """What is wrong and what to do, as a sentence without its full stop."""
    cameras: tuple[str, ...] = ()
    """The cameras it is about; empty where it is about all of them, or about the recording."""
    value: int | float = 0.0
    """The number that shows it; 0 where there is none."""
    limit: int | float = 0.0
    """The number that ``value`` is compared with; 0 where there is none."""
    before_px: float = 0.0
    """The held-out error of the cameras as the files have them, median, pixels; 0: not measured."""
    after_px: float = 0.0
    """The same once the mistake is undone; ``before_px`` where it cannot be."""
    mended: bool = False
    """Whether the mistake was undone."""
    command: str = ""
    """What to type next; empty where no command helps."""
