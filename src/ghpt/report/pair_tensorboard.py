"""A test run of the camera problem in TensorBoard."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch.utils.tensorboard import SummaryWriter

from ghpt.models.relative_pose.evaluation import PairsMeasured, pair_errors
from ghpt.models.relative_pose.schema import PairPredictions
from ghpt.observations import RelativePoseEstimate
from ghpt.report.figures import image
from ghpt.report.pair_figures import rig_figure
from ghpt.report.pair_tables import pair_report_document, pair_summary_document
from ghpt.report.report import Report
from ghpt.report.tables import title
from ghpt.report.tensorboard import (
    FIGURES,
    log_document,
    write_hyperparameters,
    write_parts,
    write_weights,
)

SHOWN = ("weight", "rig")
"""The estimates in the figure of the rig, where they are; the draw is chosen by the first."""
_CHUNK = 2048


def write_pair_events(
    folder: str | Path, predictions: PairPredictions, measured: PairsMeasured
) -> int:
    """Write the tables, histograms, the figure and hyper-parameters, as ``write_parts`` does."""

    def hyperparameters(writer: SummaryWriter) -> None:
        write_hyperparameters(writer, predictions.meta, measured)

    parts = {
        "the tables": lambda writer: log_document(writer, pair_report_document(measured)),
        "the weights": lambda writer: _write_weights(writer, predictions),
        "the rig": lambda writer: _write_rig(writer, predictions, measured),
        "the hyper-parameters": hyperparameters,
    }
    return write_parts(folder, parts)


def _write_weights(writer: SummaryWriter, predictions: PairPredictions) -> None:
    write_weights(writer, [chunk.weights for chunk in predictions.chunks(_CHUNK)])


def _write_rig(
    writer: SummaryWriter, predictions: PairPredictions, measured: PairsMeasured
) -> None:
    """Write the draw whose mean E_3D over its pairs is the median, neither good nor bad."""
    rows = _typical_draw(predictions)
    chunks = [predictions.read(row, row + 1) for row in rows]
    rig = int(chunks[0].sample.rig[0])
    tables = predictions.tables
    estimates = {}
    for name in SHOWN:
        if name in predictions.names:
            estimates[name] = _concatenate([chunk.estimates[name] for chunk in chunks])
    rig_name = f"rig of {tables.rig_name[rig]}"
    heading = f"{title(measured.run)}\n{rig_name}, the draw of median E_3D under {SHOWN[0]}"
    figure = rig_figure(
        tables.cameras.index(rig),
        tables.camera_name[rig].tolist(),
        tables.points[rig],
        torch.cat([chunk.sample.pair for chunk in chunks]),
        estimates,
        heading,
    )
    writer.add_image(f"{FIGURES}/rig", image(figure), 0, dataformats="HWC")


def _concatenate(estimates: Sequence[RelativePoseEstimate]) -> RelativePoseEstimate:
    return RelativePoseEstimate(
        torch.cat([estimate.R for estimate in estimates]),
        torch.cat([estimate.t for estimate in estimates]),
        torch.cat([estimate.estimated for estimate in estimates]),
    )


def _typical_draw(predictions: PairPredictions) -> list[int]:
    """Return the rows of a draw that is median in E_3D under the first shown selection."""
    errors = []
    draws = []
    for chunk in predictions.chunks(_CHUNK):
        errors.append(pair_errors(predictions, chunk, SHOWN[0])["E_3D"].double())
        draws.append(chunk.sample.draw)
    numbers, which = torch.cat(draws).unique(return_inverse=True)
    zero = torch.zeros(len(numbers), dtype=torch.float64)
    total = zero.index_add(0, which, torch.cat(errors))
    middle = int(total.argsort()[(len(numbers) - 1) // 2])
    return (which == middle).nonzero()[:, 0].tolist()


REPORT = Report(pair_summary_document, pair_report_document, write_pair_events)
"""The report of the camera problem."""
