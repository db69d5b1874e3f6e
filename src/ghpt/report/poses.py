"""The report of the pose problem."""

from typing import Any, TypedDict

from ghpt.report.collect import CollectPoses
from ghpt.report.evaluate import evaluate
from ghpt.report.predictions import open_predictions
from ghpt.report.report import Report
from ghpt.report.tables import print_table, write_report
from ghpt.report.tensorboard import write_events


class Settings(TypedDict):
    """See ``Report.settings``."""

    baselines: dict[str, Any]


POSES = Report(
    Settings,
    "baselines",
    CollectPoses,
    open_predictions,
    evaluate,
    print_table,
    write_report,
    write_events,
    "mpjpe_relative",
)
