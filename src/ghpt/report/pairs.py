"""The report of the camera problem."""

from typing import Any, TypedDict

from ghpt.report.collect import CollectPairs
from ghpt.report.pair_evaluate import evaluate_pairs
from ghpt.report.pair_predictions import open_pairs
from ghpt.report.pair_tables import print_pair_tables, write_pair_report
from ghpt.report.pair_tensorboard import write_pair_events
from ghpt.report.report import Report


class Settings(TypedDict):
    """See ``Report.settings``."""

    camera_baselines: dict[str, Any]


PAIRS = Report(
    Settings,
    "camera_baselines",
    CollectPairs,
    open_pairs,
    evaluate_pairs,
    print_pair_tables,
    write_pair_report,
    write_pair_events,
    "E_3D",
)
