"""A test run of the camera problem in TensorBoard."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from ghpt.models.relative_pose.evaluation import ERRORS, pair_errors
from ghpt.models.relative_pose.predictions import PairPredictions
from ghpt.models.rows import WEIGHTS
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import image
from ghpt.report.pair_figures import rig_figure
from ghpt.report.pair_tables import MANY
from ghpt.report.tables import title
from ghpt.report.tensorboard import write_hyperparameters, write_parts, write_weights

SHOWN = ("weight", "rig")
"""The estimates in the figure of the rig, where they are; the draw is chosen by the first."""
_CHUNK = 2048


def write_pair_events(
    folder: str | Path, predictions: PairPredictions, metrics: Mapping[str, Any]
) -> int:
    """Write a test run's scalars, histograms, figure and hyper-parameters, as ``write_parts`` does."""
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
    chunks = [chunk.weights for chunk in predictions.chunks(_CHUNK)]
    write_weights(
        writer,
        {summary: torch.cat([weights[summary] for weights in chunks]) for summary in WEIGHTS},
    )


def _rig(writer: SummaryWriter, predictions: PairPredictions, metrics: Mapping[str, Any]) -> None:
    """The draw whose mean E_3D over its pairs is the median: neither a good nor a bad one."""
    rows = _typical_draw(predictions)
    chunks = [predictions.read(row, row + 1) for row in rows]
    rig = int(chunks[0].rig[0])
    estimates = {
        name: RelativePoseEstimate(
            *(
                torch.cat([getattr(c.estimates[name], field.name) for c in chunks])
                for field in fields(RelativePoseEstimate)
            )
        )
        for name in SHOWN
        if name in predictions.names
    }
    heading = f"{title(metrics)}\nrig of {predictions.rig_name[rig]}, the draw of median E_3D under {SHOWN[0]}"
    figure = rig_figure(
        predictions.cameras.index(rig),
        predictions.camera_name[rig],
        predictions.points[rig],
        torch.cat([chunk.pair for chunk in chunks]),
        estimates,
        heading,
    )
    writer.add_image("rig", image(figure), 0, dataformats="HWC")


def _typical_draw(predictions: PairPredictions) -> list[int]:
    """The rows of a draw that is median in E_3D under the first shown selection."""
    errors = []
    draws = []
    for chunk in predictions.chunks(_CHUNK):
        errors.append(pair_errors(predictions, chunk, SHOWN[0])["E_3D"].double())
        draws.append(chunk.draw)
    numbers, which = torch.cat(draws).unique(return_inverse=True)
    total = torch.zeros(len(numbers), dtype=torch.float64).index_add(0, which, torch.cat(errors))
    middle = int(total.argsort()[(len(numbers) - 1) // 2])
    return (which == middle).nonzero()[:, 0].tolist()
