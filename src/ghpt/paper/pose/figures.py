"""The figures of the pose problem (paper, sections 4.2 and 4.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure

from ghpt.metrics.pose_error import joint_errors
from ghpt.metrics.pose_prior import PARTS
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.measured import TestRun
from ghpt.models.pose.schema import POSES, PoseChunk
from ghpt.models.predictions import open_predictions
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, figure_block
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.pose.base_dataset import SELF, on_itself
from ghpt.report.document import Paragraph, prose
from ghpt.report.figures import pose_prior_bars, skeletons, up_axis
from ghpt.report.tables import prior_table, title

SHOWN = ("weight", "most", "random", "least")
"""The four selections of fig:qualitative."""
QUANTILES = {"typical": 0.5, "hard": 0.9}
"""The frames that are shown, as quantiles of the errors under ``weight``: nobody picks them."""
SUBJECT = "S9"
"""The subject of fig:pose-prior."""
TEST = SELF["h36m"]


def _qualitative(results: Results) -> Section:
    predictions = open_predictions(results.paths(TEST)[0] / "predictions.npz", POSES)
    chunk = predictions.read(0, len(predictions))
    errors = {name: _relative_errors(chunk, name) for name in SHOWN}
    whole = np.flatnonzero(np.isfinite(np.sum(list(errors.values()), axis=0)))
    ordered = whole[np.argsort(errors["weight"][whole])]
    data = results.display_name("h36m")
    figures = {}
    captions = {}
    for kind, quantile in QUANTILES.items():
        row = int(ordered[int(quantile * (len(whole) - 1))])
        take = predictions.tables.recording_name[int(chunk.sample.recording[row])]
        frame = int(chunk.sample.frame[row])
        heading = (
            f"{data}, test split: {take}, frame {frame}, "
            f"the {quantile:.0%} quantile of the errors under weight"
        )
        name = f"qualitative-{kind}"
        figures[name] = _draw_frame(chunk, row, heading)
        captions[name] = f"{kind} frame"
    text = prose(
        "Two frames, chosen by a rule: the median and the 90 % quantile of the errors (mm) under "
        "*weight*."
    )
    means = {name: float(np.mean(errors[name][whole])) for name in SHOWN}
    return Section(
        data,
        [Paragraph(text), *(figure_block(name, caption) for name, caption in captions.items())],
        figures,
        claims=[_order_claim(means)],
    )


def _draw_frame(chunk: PoseChunk, row: int, heading: str) -> Figure:
    truth = chunk.sample.as_truth().points.double().numpy()
    poses = {name: chunk.estimates[name].points[row].double().numpy() for name in SHOWN}
    return skeletons(truth[row], poses, up_axis(truth[::10]), heading)


def _order_claim(errors: Mapping[str, float]) -> Claim:
    order = list(errors.values())
    evidence = ", ".join(f"{name} {error:.1f}" for name, error in errors.items())
    return Claim(
        "weight is closest to the truth, then most, random, least",
        "4.2, figure",
        order == sorted(order),
        f"{evidence} mm on the mean",
    )


def _relative_errors(chunk: PoseChunk, name: str) -> Float[np.ndarray, " N"]:
    """Return the pelvis-relative MPJPE (mm) of each frame, NaN where a joint is missing."""
    estimate = chunk.estimates[name]
    errors, measured = joint_errors(estimate, chunk.sample.as_truth(), "relative")
    return torch.where(measured.all(-1), errors.mean(-1), torch.nan).numpy()


def _pose_prior(results: Results) -> Section:
    metrics = results.read(TEST, "metrics.json")[0]
    run = TestRun.from_meta(metrics, metrics["frames"])
    priors = {
        name: numbers["pose_prior"][SUBJECT]
        for name, numbers in metrics["selections"].items()
        if name in AGGREGATIONS
    }
    text = (
        f"Variance over the frames of {SUBJECT} of the ratio of left to right length, six pairs of "
        "parts, eight hypotheses. The paper prints no numbers here, so there is nothing to set "
        "beside them but its sentences."
    )
    return Section(
        results.display_name("h36m"),
        [
            Paragraph(text),
            figure_block("pose-prior", "pose prior"),
            Paragraph(f"1000 S², seed {results.setup.seed}:"),
            prior_table(priors),
        ],
        {"pose-prior": pose_prior_bars(priors, SUBJECT, title(run))},
        claims=_pose_prior_claims(_mean_prior(results)),
    )


def _mean_prior(results: Results) -> dict[str, Float[np.ndarray, " P"]]:
    """Return the mean over the seeds of S² of each part, by selection."""
    prior = {}
    for name in AGGREGATIONS:
        parts = [
            results.spread(TEST, "selections", name, "pose_prior", SUBJECT, part).mean
            for part in PARTS
        ]
        prior[name] = np.array(parts)
    return prior


def _pose_prior_claims(prior: Mapping[str, Float[np.ndarray, " P"]]) -> list[Claim]:
    weight = prior["weight"]
    average = prior["average"]
    most = prior["most"]
    least = prior["least"]
    rivals = [prior[name] for name in prior if name not in ("weight", "average", "best")]
    rival = np.min(rivals, axis=0)
    count = len(PARTS)
    lowest = int(np.sum(weight <= np.minimum(rival, average)))
    second = int(np.sum(average <= rival))
    symmetric = int(np.sum(most < least))
    ratio = _mean_ratio(weight, prior["best"])
    return [
        Claim(
            "the pose prior is generally lowest for weight",
            "4.3",
            lowest > count / 2,
            f"in {lowest} of {count} parts, best left aside",
        ),
        Claim(
            "followed by the average",
            "4.3",
            second > count / 2,
            f"second in {second} of {count} parts",
        ),
        Claim(
            "most < least: the scorer has learned symmetry",
            "4.3",
            symmetric == count,
            f"in {symmetric} of {count} parts, {_mean_ratio(least, most):.1f} times on the mean",
        ),
        Claim(
            "best is comparable to weight",
            "4.3",
            0.5 < ratio < 2,
            f"weight / best = {ratio:.2f} on the mean",
        ),
    ]


def _mean_ratio(a: Float[np.ndarray, " P"], b: Float[np.ndarray, " P"]) -> float:
    """Return the geometric mean over the parts of a / b."""
    return float(np.exp(np.mean(np.log(a / b))))


def _tasks(setup: Setup) -> dict[str, Task]:
    return on_itself(setup, "h36m")


ARTEFACTS = (
    Artefact("qualitative", "figure", "Hypotheses beside the truth", _tasks, _qualitative),
    Artefact("pose-prior", "figure", "The human pose prior", _tasks, _pose_prior),
)
