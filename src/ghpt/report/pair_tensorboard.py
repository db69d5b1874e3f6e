"""A test run of the camera problem in TensorBoard."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from ghpt.models.relative_pose.evaluation import ERRORS, pair_errors
from ghpt.models.relative_pose.schema import PairPredictions
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import image
from ghpt.report.pair_figures import rig_figure
from ghpt.report.pair_tables import MANY, print_pair_tables, write_pair_report
from ghpt.report.report import Report
from ghpt.report.tables import title
from ghpt.report.tensorboard import write_hyperparameters, write_parts, write_weights

SHOWN = ("weight", "rig")
"""The estimates in the figure of the rig, where they are; the draw is chosen by the first."""
_CHUNK = 2048


def write_pair_events(
    folder: str | Path, predictions: PairPredictions, metrics: Mapping[str, Any]
) -> int:
    """Write a test run's scalars, histograms, figure and settings, as ``write_parts`` does."""
    return write_parts(
        folder,
        {
            "scalars": lambda writer: _scalars(writer, metrics),
            "the weights": lambda writer: _weights(writer, predictions),
            "the rig": lambda writer: _rig(writer, predictions, metrics),
            "the hyper-parameters": lambda writer: write_hyperparameters(
                writer, predictions.meta, metrics, "E_3D"
            ),
        },
    )


def _scalars(writer: SummaryWriter, metrics: Mapping[str, Any]) -> None:
    for name, numbers in metrics["selections"].items():
        _add(writer, "", name, numbers)
        if len(numbers["pairs"]) <= MANY:
            for pair, of_pair in numbers["pairs"].items():
                _add(writer, f" {pair}", name, of_pair)


def _add(writer: SummaryWriter, of: str, name: str, numbers: Mapping[str, Any]) -> None:
    for error in (*ERRORS, "coverage"):
        if numbers[error] is not None:
            writer.add_scalar(f"{error}{of}/{name}", numbers[error], 0)


def _weights(writer: SummaryWriter, predictions: PairPredictions) -> None:
    write_weights(writer, [chunk.weights for chunk in predictions.chunks(_CHUNK)])


def _rig(writer: SummaryWriter, predictions: PairPredictions, metrics: Mapping[str, Any]) -> None:
    """Draw the rig in the draw whose mean E_3D over its pairs is the median."""
    rows = _typical_draw(predictions)
    chunks = [predictions.read(row, row + 1) for row in rows]
    rig = int(chunks[0].sample.rig[0])
    estimates = {}
    for name in SHOWN:
        if name in predictions.names:
            each = [chunk.estimates[name] for chunk in chunks]
            R = torch.cat([estimate.R for estimate in each])
            t = torch.cat([estimate.t for estimate in each])
            estimated = torch.cat([estimate.estimated for estimate in each])
            estimates[name] = RelativePoseEstimate(R, t, estimated)
    which = f"rig of {predictions.tables.rig_name[rig]}"
    heading = f"{title(metrics)}\n{which}, the draw of median E_3D under {SHOWN[0]}"
    tables = predictions.tables
    figure = rig_figure(
        tables.cameras.index(rig),
        tables.camera_name[rig].tolist(),
        tables.points[rig],
        torch.cat([chunk.sample.pair for chunk in chunks]),
        estimates,
        heading,
    )
    writer.add_image("rig", image(figure), 0, dataformats="HWC")


def _typical_draw(predictions: PairPredictions) -> list[int]:
    """Return the rows of a draw that is median in E_3D under the first shown name."""
    errors = []
    draws = []
    for chunk in predictions.chunks(_CHUNK):
        errors.append(pair_errors(predictions, chunk, SHOWN[0])["E_3D"].double())
        draws.append(chunk.sample.draw)
    numbers, which = torch.cat(draws).unique(return_inverse=True)
    total = torch.zeros(len(numbers), dtype=torch.float64).index_add(0, which, torch.cat(errors))
    middle = int(total.argsort()[(len(numbers) - 1) // 2])
    return (which == middle).nonzero()[:, 0].tolist()


REPORT = Report(print_pair_tables, write_pair_report, write_pair_events)
"""Of the camera problem."""
