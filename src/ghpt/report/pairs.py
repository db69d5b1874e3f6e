"""The report of the camera problem."""

from collections.abc import Callable, Mapping
from typing import Any, TypedDict

from ghpt.config import build
from ghpt.models.collect import CollectPairs
from ghpt.models.module import StochasticEstimator
from ghpt.models.relative_pose.evaluation import evaluate_pairs
from ghpt.models.relative_pose.predictions import open_pairs
from ghpt.observations import PairObservations, RelativePoseEstimate
from ghpt.report.pair_tables import print_pair_tables, write_pair_report
from ghpt.report.pair_tensorboard import write_pair_events
from ghpt.report.report import Report


class Settings(TypedDict):
    """See ``Report.settings``."""

    camera_baselines: dict[str, Any]


def estimators(
    config: Mapping[str, Any], model: StochasticEstimator
) -> dict[str, Callable[[PairObservations], RelativePoseEstimate]]:
    """The classical estimators."""
    return build(config["camera_baselines"], "camera_baselines")


PAIRS = Report(
    Settings,
    estimators,
    CollectPairs,
    open_pairs,
    evaluate_pairs,
    print_pair_tables,
    write_pair_report,
    write_pair_events,
    "E_3D",
)
