"""How the metrics of a test run are shown."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.report.document import Document

Metrics = Mapping[str, Any]
"""The content of metrics.json."""


@dataclass(frozen=True)
class Report:
    """What a problem shows of a test run, in the terminal and in files."""

    summary: Callable[[Metrics], Document]
    """Returns the main numbers, for the terminal."""
    document: Callable[[Metrics], Document]
    """Returns all numbers, for report.md."""
    write_events: Callable[[Path, Any, Metrics], int]
    """Writes TensorBoard's events of the opened predictions and metrics into a folder.

    It never raises, and returns how many parts could not be written.
    """
