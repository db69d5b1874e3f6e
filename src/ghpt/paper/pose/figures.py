"""The figures of the pose problem (paper, sections 4.2 and 4.3)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from ghpt.metrics.pose_error import joint_errors
from ghpt.metrics.pose_prior import PARTS
from ghpt.models.pose.predictions import PredictionChunk, Predictions, open_predictions
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.pose.base_dataset import SELF, on_itself
from ghpt.report.figures import pose_prior_bars, skeletons, up_axis
from ghpt.report.tables import markdown, prior_table

SHOWN = ("weight", "most", "random", "least")
"""The four of fig:qualitative."""
QUANTILES = {"typical": 0.5, "hard": 0.9}
"""Of the errors under ``weight``: the frames that are shown, so that nobody picks them."""
SUBJECT = "S9"
"""Of fig:pose-prior."""
TEST = SELF["h36m"]


def _qualitative(results: Results) -> Section:
    predictions = open_predictions(results.paths(TEST)[0] / "predictions.npz")
    chunk = predictions.read(0, len(predictions))
    errors = {name: _relative_errors(chunk, name) for name in SHOWN}
    whole = np.flatnonzero(np.isfinite(sum(errors.values())))
    up = up_axis(chunk.truth.points[::10].double().numpy())
    figures = {}
    for kind, quantile in QUANTILES.items():
        row = whole[np.argsort(errors["weight"][whole])[int(quantile * (len(whole) - 1))]]
        figures[f"qualitative-{kind}"] = skeletons(
            chunk.truth.points[row].double().numpy(),
            {name: chunk.estimates[name].points[row].double().numpy() for name in SHOWN},
            up,
            _heading(
                results,
                predictions,
                chunk,
                int(row),
                f"the {quantile:.0%} quantile of the errors under weight",
            ),
        )
    order = [float(np.mean(errors[name][whole])) for name in SHOWN]
    claim = Claim(
        "weight is closest to the truth, then most, random, least",
        "4.2, figure",
        order == sorted(order),
        ", ".join(f"{name} {error:.1f}" for name, error in zip(SHOWN, order, strict=True))
        + " mm on the mean",
    )
    text = "Two frames, chosen by a rule: the median and the 90 % quantile of the errors (mm) under *weight*."
    pictures = "\n\n".join(
        f"![{kind} frame]({name}.svg)" for kind, name in zip(QUANTILES, figures, strict=True)
    )
    return Section(results.display_name("h36m"), f"{text}\n\n{pictures}", figures, (), [claim])


def _relative_errors(chunk: PredictionChunk, name: str) -> Float[np.ndarray, " N"]:
    """Pelvis-relative MPJPE (mm) of each frame; NaN where a joint is missing."""
    errors, counted = joint_errors(chunk.estimates[name], chunk.truth, "relative")
    return torch.where(counted.all(-1), errors.mean(-1), torch.nan).numpy()


def _heading(
    results: Results, predictions: Predictions, chunk: PredictionChunk, row: int, which: str
) -> str:
    take = predictions.recording_name[int(chunk.recording[row])]
    return f"{results.display_name('h36m')}, test split: {take}, frame {int(chunk.frame[row])}, {which}"


def _pose_prior(results: Results) -> Section:
    metrics = results.read(TEST, "metrics.json")
    figure = pose_prior_bars(metrics[0], SUBJECT)
    prior = {
        name: np.mean(
            [
                [m["selections"][name]["pose_prior"][SUBJECT][part] for part in PARTS]
                for m in metrics
            ],
            axis=0,
        )
        for name in ("weight", "average", "most", "least", "stochastic", "random", "best", "worst")
    }
    others = [name for name in prior if name not in ("weight", "best")]
    lowest = int(sum(prior["weight"] <= np.min([prior[name] for name in others], axis=0)))
    second = int(
        sum(prior["average"] <= np.min([prior[n] for n in others if n != "average"], axis=0))
    )
    ratio = _ratio(prior["weight"], prior["best"])
    claims = [
        Claim(
            "the pose prior is generally lowest for weight",
            "4.3",
            lowest > len(PARTS) / 2,
            f"in {lowest} of {len(PARTS)} parts, best left aside",
        ),
        Claim(
            "followed by the average",
            "4.3",
            second > len(PARTS) / 2,
            f"second in {second} of {len(PARTS)} parts",
        ),
        Claim(
            "most < least: the scorer has learned symmetry",
            "4.3",
            bool((prior["most"] < prior["least"]).all()),
            f"in {sum(prior['most'] < prior['least'])} of {len(PARTS)} parts, "
            f"{_ratio(prior['least'], prior['most']):.1f} times on the mean",
        ),
        Claim(
            "best is comparable to weight",
            "4.3",
            0.5 < ratio < 2,
            f"weight / best = {ratio:.2f} on the mean",
        ),
    ]
    text = (
        f"Variance over the frames of {SUBJECT} of the ratio of left to right length, six pairs of parts, eight "
        "hypotheses. The paper prints no numbers here, so there is nothing to set beside them but its sentences."
    )
    table = markdown(*prior_table(metrics[0], SUBJECT))
    body = (
        f"{text}\n\n![pose prior](pose-prior.svg)\n\n1000 S², seed {results.setup.seed}:\n\n{table}"
    )
    return Section(results.display_name("h36m"), body, {"pose-prior": figure}, (), claims)


def _ratio(a: Float[np.ndarray, " L"], b: Float[np.ndarray, " L"]) -> float:
    """Geometric mean over the parts."""
    return float(np.exp(np.mean(np.log(a / b))))


def _tasks(setup: Setup) -> dict[str, Task]:
    return on_itself(setup, "h36m")


ARTEFACTS = (
    Artefact("qualitative", "figure", "Hypotheses beside the truth", _tasks, _qualitative),
    Artefact("pose-prior", "figure", "The human pose prior", _tasks, _pose_prior),
)
