"""How the metrics of a test run are shown."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.report.document import Document


@dataclass(frozen=True)
class Report:
    """What a problem shows of a test run, in the terminal and in files."""

    summary: Callable[[Any], Document]
    """Returns the main numbers of a `Measured`, for the terminal."""
    document: Callable[[Any], Document]
    """Returns all numbers, for report.md."""
    write_events: Callable[[Path, Any, Any], int]
    """Writes TensorBoard's events of the opened predictions and a `Measured` into a folder.

    It never raises, and returns how many parts could not be written.
    """
