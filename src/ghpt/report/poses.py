"""The report of the pose problem."""

from collections.abc import Callable, Mapping
from typing import Any, NotRequired, TypedDict

from ghpt.config import build
from ghpt.models.collect import CollectPoses
from ghpt.models.module import StochasticEstimator
from ghpt.models.pose.evaluation import evaluate
from ghpt.models.pose.predictions import open_predictions
from ghpt.observations import Observations, PoseEstimate
from ghpt.report.report import Report
from ghpt.report.tables import print_table, write_report
from ghpt.report.tensorboard import write_events


class Settings(TypedDict):
    """See ``Report.settings``."""

    view_weights: NotRequired[dict[str, Any]]
    baselines: dict[str, Any]


def estimators(
    config: Mapping[str, Any], model: StochasticEstimator
) -> dict[str, Callable[[Observations], PoseEstimate]]:
    """The model's view weights, where there are settings for them, and the classical estimators."""
    settings = config.get("view_weights")
    learned = {"view_weights": build(settings, "view_weights")(model)} if settings else {}
    return learned | build(config["baselines"], "baselines")


POSES = Report(
    Settings,
    estimators,
    CollectPoses,
    open_predictions,
    evaluate,
    print_table,
    write_report,
    write_events,
    "mpjpe_relative",
)
