"""What testing needs to know of a problem: how its predictions are collected, measured and shown."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.models.collect import Collect


@dataclass(frozen=True)
class Report:
    """One instance for each problem. ``metrics`` below is what ``evaluate`` returns, the content of
    metrics.json.
    """

    settings: type
    """The settings that test.py needs for this problem alone, a TypedDict."""
    estimators: Callable[[Mapping[str, Any], Any], dict[str, Callable[[Any], Any]]]
    """Configuration and model -> what is tested beside the selections, by name: each takes a batch.
    """
    collect: type[Collect]
    """Writes predictions.npz."""
    open: Callable[[Path], Any]
    """Opens and checks it."""
    evaluate: Callable[[Any], dict[str, Any]]
    """Opened predictions -> metrics."""
    print_table: Callable[[Mapping[str, Any]], None]
    write_report: Callable[[Path, Mapping[str, Any]], None]
    write_events: Callable[[Path, Any, Mapping[str, Any]], int]
    """Folder, opened predictions and metrics; never raises."""
    headline: str
    """The number of a selection, in mm, that sums a run up."""
