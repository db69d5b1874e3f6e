"""A test run in TensorBoard. It shows what metrics.json holds; it can fail without costing the run
anything.
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
from torch.utils.tensorboard.summary import hparams

from ghpt.metrics.pose_error import joint_errors
from ghpt.models.aggregation import WeightSummary
from ghpt.models.pose.schema import PoseChunk, PosePredictions
from ghpt.observations import PoseEstimate
from ghpt.report.figures import image, pose_prior_bars, skeletons, up_axis
from ghpt.report.report import Report
from ghpt.report.tables import print_table, title, training_data, write_report

SHOWN = ("weight", "most", "least", "random")
"""The poses beside the truth in the figure of a frame."""
_SCALARS = ("mpjpe_absolute", "mpjpe_relative", "mpjpe_aligned", "mpjpe_6_joints", "coverage")
_SAMPLE = 50
"""Blocks of `_BLOCK` frames, evenly over the run, that histograms and the figure are made of."""
_BLOCK = 1000
_log = logging.getLogger(__name__)


def write_events(
    folder: str | Path, predictions: PosePredictions, metrics: Mapping[str, Any]
) -> int:
    """Write a test run's scalars, histograms, figures and hyper-parameters, as ``write_parts``
    does.
    """
    return write_parts(
        folder,
        {
            "scalars": lambda writer: _scalars(writer, metrics),
            "the weights": lambda writer: _weights(writer, predictions),
            "the skeletons": lambda writer: _skeletons(writer, predictions, metrics),
            "the pose prior": lambda writer: _pose_prior(writer, metrics),
            "the hyper-parameters": lambda writer: write_hyperparameters(
                writer, predictions.meta, metrics, "mpjpe_relative"
            ),
        },
    )


def write_parts(folder: str | Path, parts: Mapping[str, Callable[[SummaryWriter], None]]) -> int:
    """Write each part (what it is called -> what writes it) as events in ``folder``.

    Never raises: the number of parts that failed is returned, and the first is said as a logged
    warning.
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


def _scalars(writer: SummaryWriter, metrics: Mapping[str, Any]) -> None:
    for name, numbers in metrics["selections"].items():
        for scalar in _SCALARS:
            if numbers[scalar] is not None:
                writer.add_scalar(f"{scalar}/{name}", numbers[scalar], 0)


def _weights(writer: SummaryWriter, predictions: PosePredictions) -> None:
    write_weights(writer, [chunk.weights for _, chunk in _sample(predictions)])


def write_weights(writer: SummaryWriter, weights: Sequence[WeightSummary]) -> None:
    """Write mean and histogram of each summary of the weights, over all chunks."""
    for summary in fields(WeightSummary):
        values = torch.cat([getattr(chunk, summary.name) for chunk in weights])
        writer.add_scalar(f"weights/{summary.name}", values.mean().item(), 0)
        writer.add_histogram(f"weights/{summary.name}", values.numpy(), 0)


def _skeletons(
    writer: SummaryWriter, predictions: PosePredictions, metrics: Mapping[str, Any]
) -> None:
    """The whole frame whose error under ``weight`` is the median: neither a good nor a bad one."""
    rows = []
    errors = []
    truth = []
    for start, chunk in _sample(predictions):
        error, whole = _relative_error(chunk)
        rows.append(start + whole.nonzero()[:, 0])
        errors.append(error[whole])
        truth.append(chunk.sample.as_truth().points[whole][::10])
    if not len(torch.cat(rows)):
        return
    row = int(torch.cat(rows)[torch.cat(errors).median(dim=0).indices])
    chunk = predictions.read(row, row + 1)
    poses = {name: _with_nan(chunk.estimates[name]) for name in SHOWN if name in predictions.names}
    truth_of_row = chunk.sample.as_truth()
    take = predictions.tables.recording_name[int(chunk.sample.recording)]
    heading = f"{title(metrics)}\n{take}, frame {int(chunk.sample.frame)}: the median of the errors under {SHOWN[0]}"
    up = up_axis(torch.cat(truth).double().numpy())
    figure = skeletons(truth_of_row.points[0].double().numpy(), poses, up, heading)
    writer.add_image("skeletons", image(figure), 0, dataformats="HWC")


def _pose_prior(writer: SummaryWriter, metrics: Mapping[str, Any]) -> None:
    for subject in next(iter(metrics["selections"].values()))["pose_prior"]:
        writer.add_image(
            f"pose_prior/{subject}", image(pose_prior_bars(metrics, subject)), 0, dataformats="HWC"
        )


def write_hyperparameters(
    writer: SummaryWriter, meta: Mapping[str, Any], metrics: Mapping[str, Any], error: str
) -> None:
    """The settings of a test run beside each selection's ``error``."""
    trained, source = training_data(metrics)
    values = {key: metrics[key] for key in ("data", "source", "split", "seed", "frames")}
    values |= {
        "trained_on": trained,
        "trained_on_source": source,
        "hypotheses": meta.get("hypotheses"),
    }
    numbers = {
        f"final/{name}": numbers[error]
        for name, numbers in metrics["selections"].items()
        if numbers[error] is not None
    }
    # writer.add_hparams would write them to a second event file.
    for summary in hparams({k: v for k, v in values.items() if v is not None}, numbers):
        writer._get_file_writer().add_summary(summary)
    for name, number in numbers.items():
        writer.add_scalar(name, number, 0)


def _sample(predictions: PosePredictions) -> Iterator[tuple[int, PoseChunk]]:
    """At most ``_SAMPLE`` blocks with their first row, so that memory does not grow with the
    frames.
    """
    starts = range(0, len(predictions), _BLOCK)
    chosen = sorted({round(i) for i in np.linspace(0, len(starts) - 1, min(len(starts), _SAMPLE))})
    return (
        (starts[i], predictions.read(starts[i], min(starts[i] + _BLOCK, len(predictions))))
        for i in chosen
    )


def _relative_error(chunk: PoseChunk) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"]]:
    """Each frame's error under the first shown selection, mm, and which frames are whole."""
    errors, counted = joint_errors(chunk.estimates[SHOWN[0]], chunk.sample.as_truth(), "relative")
    return errors.mean(-1), counted.all(-1)


def _with_nan(estimate: PoseEstimate) -> Float[np.ndarray, "J 3"]:
    return (
        estimate.points[0].double().masked_fill(~estimate.estimated[0, :, None], torch.nan).numpy()
    )


REPORT = Report(print_table, write_report, write_events)
"""Of the pose problem."""
