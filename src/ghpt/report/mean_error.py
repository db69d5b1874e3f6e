"""The report of a problem that has none of its own: the mean error of each estimator."""

from pathlib import Path
from typing import Any

from ghpt.models.mean_error import MeanError
from ghpt.models.measured import Measured
from ghpt.models.predictions import Predictions
from ghpt.report.document import Document, Table
from ghpt.report.report import Report
from ghpt.report.tables import NONE, title
from ghpt.report.tensorboard import log_document, write_hyperparameters, write_parts, write_weights

_CHUNK = 2048


def error_document(measured: Measured[MeanError]) -> Document:
    """Return the table of mean errors."""
    header = ("selection", "error, mm", "compared, %")
    rows = []
    for name, numbers in measured.selections.items():
        text = NONE if numbers.error is None else f"{numbers.error:.1f}"
        rows.append((name, text, f"{100 * numbers.coverage:.1f}"))
    return Document(f"{measured.run.problem}: {title(measured.run)}", [Table(header, rows)])


def write_error_events(
    folder: Path, predictions: Predictions[Any, Any, Any], measured: Measured[MeanError]
) -> int:
    """Write histograms of the weights and the errors beside the settings, as ``write_parts``."""
    summaries = [chunk.weights for chunk in predictions.chunks(_CHUNK)]
    return write_parts(
        folder,
        {
            "the table": lambda writer: log_document(writer, error_document(measured)),
            "the weights": lambda writer: write_weights(writer, summaries),
            "the hyper-parameters": lambda writer: write_hyperparameters(
                writer, predictions.meta, measured
            ),
        },
    )


REPORT = Report(error_document, error_document, write_error_events)
