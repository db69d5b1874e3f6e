"""A test run in TensorBoard.

It shows what metrics.json holds, and can fail without costing the run anything.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from ghpt.metrics.pose_error import joint_errors
from ghpt.models.aggregation import WeightSummary
from ghpt.models.measured import Measured
from ghpt.models.pose.schema import PoseChunk, PosePredictions
from ghpt.observations import PoseEstimate
from ghpt.report.document import Document
from ghpt.report.figures import image, pose_prior_bars, skeletons, up_axis
from ghpt.report.hyperparameters import flatten, write_row
from ghpt.report.markdown import render_markdown
from ghpt.report.report import Report
from ghpt.report.tables import (
    PosesMeasured,
    pose_priors,
    report_document,
    summary_document,
    title,
)

SHOWN = ("weight", "most", "least", "random")
"""The poses beside the truth in the figure of a frame."""
_FINAL = ("weight", "average", "frame_learned", "trajectory", "rig")
"""The estimates whose errors stand beside the hyper-parameters, where there are such."""
FIGURES = "visual"
"""The group of the figures' tags: TensorBoard sorts groups, and curves are to come first."""
_SAMPLE = 50
"""Blocks of `_BLOCK` frames, evenly over the run, that histograms and the figure are made of."""
_BLOCK = 1000
_log = logging.getLogger(__name__)


def write_events(folder: str | Path, predictions: PosePredictions, measured: PosesMeasured) -> int:
    """Write the tables, histograms, figures and hyper-parameters, as ``write_parts`` does."""

    def hyperparameters(writer: SummaryWriter) -> None:
        write_hyperparameters(writer, predictions.meta, measured)

    parts = {
        "the tables": lambda writer: log_document(writer, report_document(measured)),
        "the weights": lambda writer: _write_weights(writer, predictions),
        "the skeletons": lambda writer: _write_skeletons(writer, predictions, measured),
        "the pose prior": lambda writer: _write_pose_prior(writer, measured),
        "the hyper-parameters": hyperparameters,
    }
    return write_parts(folder, parts)


def write_parts(folder: str | Path, parts: Mapping[str, Callable[[SummaryWriter], None]]) -> int:
    """Write each part, by its name in a message, as events in ``folder``.

    Never raises. Returns the number of parts that failed; the first failure is a logged warning.
    """
    failures: list[Exception] = []

    def attempt(part: str, write: Callable[[], Any]) -> Any:
        try:
            return write()
        except Exception as error:
            if not failures:
                _log.warning(
                    "TensorBoard: %s cannot be written (%s); the test's files are complete",
                    part,
                    error,
                )
            failures.append(error)

    writer = attempt("the event file", lambda: SummaryWriter(str(folder)))
    if writer is not None:
        for part, write in parts.items():
            attempt(part, partial(write, writer))
        attempt("the event file", writer.close)
    return len(failures)


def _write_weights(writer: SummaryWriter, predictions: PosePredictions) -> None:
    write_weights(writer, [chunk.weights for _, chunk in _sample_blocks(predictions)])


def write_weights(writer: SummaryWriter, weights: Sequence[WeightSummary]) -> None:
    """Write the histogram of each summary of the weights, over all chunks."""
    for summary in fields(WeightSummary):
        values = torch.cat([getattr(chunk, summary.name) for chunk in weights])
        writer.add_histogram(f"weights/{summary.name}", values.numpy(), 0)


def _write_skeletons(
    writer: SummaryWriter, predictions: PosePredictions, measured: PosesMeasured
) -> None:
    """Write the whole frame whose error under ``weight`` is the median, neither good nor bad."""
    rows = []
    errors = []
    truth = []
    for start, block in _sample_blocks(predictions):
        error, whole = _relative_error(block)
        rows.append(start + whole.nonzero()[:, 0])
        errors.append(error[whole])
        truth.append(block.sample.as_truth().points[whole][::10])
    if not len(torch.cat(rows)):
        return
    median = torch.cat(errors).median(dim=0).indices
    row = int(torch.cat(rows)[median])
    chunk = predictions.read(row, row + 1)
    names = [name for name in SHOWN if name in predictions.names]
    poses = {name: _with_nan(chunk.estimates[name]) for name in names}
    take = predictions.tables.recording_name[int(chunk.sample.recording)]
    frame = f"{take}, frame {int(chunk.sample.frame)}"
    heading = f"{title(measured.run)}\n{frame}: the median of the errors under {SHOWN[0]}"
    up = up_axis(torch.cat(truth).double().numpy())
    true_pose = chunk.sample.as_truth().points[0].double().numpy()
    figure = skeletons(true_pose, poses, up, heading)
    writer.add_image(f"{FIGURES}/skeletons", image(figure), 0, dataformats="HWC")


def _write_pose_prior(writer: SummaryWriter, measured: PosesMeasured) -> None:
    first = next(iter(measured.selections.values()))
    for subject in first.pose_prior:
        figure = pose_prior_bars(pose_priors(measured, subject), subject, title(measured.run))
        tag = f"{FIGURES}/pose_prior_{subject}"
        writer.add_image(tag, image(figure), 0, dataformats="HWC")


def log_document(writer: SummaryWriter, document: Document) -> None:
    """Write a report as text, which TensorBoard renders."""
    writer.add_text("report", render_markdown(document), 0)


def write_hyperparameters(
    writer: SummaryWriter, meta: Mapping[str, Any], measured: Measured[Any]
) -> None:
    """Write the settings of the test and of its model beside the main estimates' errors."""
    run = measured.run
    trained, source = run.training
    values = {name: getattr(run, name) for name in ("data", "source", "split", "seed", "frames")}
    values |= {"trained_on": trained, "trained_on_source": source}
    values |= dict(flatten(meta.get("model") or {}, "model"))
    values |= {"model.hypotheses": meta.get("hypotheses")}
    errors = {}
    for name in _FINAL:
        numbers = measured.selections.get(name)
        if numbers is not None and numbers.headline is not None:
            errors[f"test/{name}"] = numbers.headline
    write_row(writer, values, errors)
    for name, number in errors.items():
        writer.add_scalar(name, number, 0)


def _sample_blocks(predictions: PosePredictions) -> Iterator[tuple[int, PoseChunk]]:
    """Yield at most ``_SAMPLE`` blocks with their first row.

    Memory therefore does not grow with the number of frames.
    """
    count = len(predictions)
    starts = range(0, count, _BLOCK)
    places = np.linspace(0, len(starts) - 1, min(len(starts), _SAMPLE))
    for index in sorted({round(place) for place in places}):
        start = starts[index]
        yield start, predictions.read(start, min(start + _BLOCK, count))


def _relative_error(chunk: PoseChunk) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"]]:
    """Return each frame's error under the first shown selection, mm, and which are whole."""
    estimate = chunk.estimates[SHOWN[0]]
    errors, measured = joint_errors(estimate, chunk.sample.as_truth(), "relative")
    return errors.mean(-1), measured.all(-1)


def _with_nan(estimate: PoseEstimate) -> Float[np.ndarray, "J 3"]:
    """Return the pose of a single frame, NaN where a joint is missing."""
    missing = ~estimate.estimated[0, :, None]
    return estimate.points[0].double().masked_fill(missing, torch.nan).numpy()


REPORT = Report(summary_document, report_document, write_events)
"""The report of the pose problem."""
