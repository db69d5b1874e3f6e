"""Robustness curves, which the paper lacks: errors under more outliers, noise, missing views, wrong
cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section
from ghpt.paper.robustness.curve import Curve, Found, found, tasks_of
from ghpt.paper.robustness.figure import LABELS, Panel, curves
from ghpt.paper.robustness.text import TIE, standing, table, verdict

_TABLE_ALONE = ("most", "best")
"""Not in the figures."""


def _section(
    results: Results, of: Sequence[Curve], about: str, absolute: bool, claims: Claims
) -> Section:
    sizes = results.setup.sizes["robustness"]
    all_found = [found(results, curve) for curve in of]
    data = results.display_name(of[0].data)
    trained = f"trained on {results.display_name(sizes['trained_on'])}"
    kinds = ("relative", "absolute") if absolute else ("relative",)
    figures = {}
    body = [about]
    panels = [
        Panel(
            c.x,
            {n: (f.places, s) for n, s in f.errors["relative"].items() if n not in _TABLE_ALONE},
            c.logarithmic,
        )
        for c, f in zip(of, all_found, strict=True)
    ]
    name = f"robustness_{of[0].name}"
    figures[name] = curves(
        panels, f"{data}, test split\nlearned estimators {trained}", "pelvis-relative MPJPE, mm"
    )
    body.append(f"![Pelvis-relative MPJPE of every estimator; {data}, {trained}]({name}.svg)")
    for curve, one in zip(of, all_found, strict=True):
        for kind in kinds:
            said = "Pelvis-relative" if kind == "relative" else "Absolute"
            frames = results.read(curve.name)[0]["frames"]
            body.append(f"{said} MPJPE, mm, on {frames} frames:\n\n{table(curve, one, kind)}")
        body.append(verdict(curve, one))
    return Section(data, "\n\n".join(body), figures, claims=claims(all_found[0]))


Claims = Callable[[Found], list[Claim]]


def _no_claims(of: Found) -> list[Claim]:
    return []


def _outlier_claims(of: Found) -> list[Claim]:
    """What section 2 says of erroneous detections."""
    last = len(of.levels) - 1
    best = of.best_classical(last)
    ours, linear = ([of.mean(name, i) for i in (0, last)] for name in ("weight", "linear"))
    by = (
        f"from {of.levels[0]} to {of.levels[-1]} % outliers {ours[0]:.1f} to {ours[1]:.1f} mm, linear {linear[0]:.1f} "
        f"to {linear[1]:.1f}; {LABELS.get(best, best)} {of.mean(best, 0):.1f} to {of.mean(best, last):.1f}"
    )
    holds = ours[1] - ours[0] < of.mean(best, last) - of.mean(best, 0)
    statement = "robust to erroneous detections (held if its error grows less than that of any classical estimator)"
    return [Claim(statement, "2", holds, by), _view_weights_claim(of)]


def _view_weights_claim(of: Found) -> Claim:
    leads = [of.lead("view_weights", i) for i in range(len(of.levels))]
    ends = {"worst": leads.index(min(leads)), "best": leads.index(max(leads))}
    by = "; ".join(
        f"{which} margin {standing(of, i)} at {of.levels[i]} %" for which, i in ends.items()
    )
    statement = "view weights are at least as good as every classical estimator, adaptive RANSAC too, at every level"
    return Claim(statement, "not in the paper", min(leads) >= -TIE, by)


def _item(
    label: str,
    title: str,
    about: str,
    *of: Curve,
    absolute: bool = False,
    claims: Claims = _no_claims,
) -> Artefact:
    section = partial(_section, of=of, about=about, absolute=absolute, claims=claims)
    return Artefact(label, "robustness", title, partial(tasks_of, of=of), section)


_SAME = "All estimators get the same key points; none is trained or tuned again, and confidences stay as they were. "

OUTLIERS = Curve(
    "outliers",
    "Outliers",
    "rate",
    "outliers, % of the detections",
    " %",
    100.0,
    more=("shortest", "longest"),
)
NOISE = Curve(
    "noise", "Noise", "deviation", "added noise, % of the person's size in the image", " %", 100.0
)
VIEWS = Curve(
    "views", "FewerCameras", "count", "cameras", " cameras", data="panoptic", logarithmic=True
)
DETECTIONS = Curve(
    "missing_detections", "MissingDetections", "rate", "missing detections, %", " %", 100.0
)
MISSING_VIEWS = Curve(
    "missing_views", "MissingViews", "count", "missing views of four", " missing view(s)"
)
ROTATION = Curve("rotation", "RotatedCameras", "degrees", "rotation of each camera, degrees", "°")
SHIFT = Curve("shift", "ShiftedCameras", "millimetres", "shift of each camera, mm", " mm")

ARTEFACTS = (
    _item(
        "robustness-outliers",
        "More outliers",
        _SAME
        + "A random share of the detections is moved in a random direction, by a random length within a range of "
        "fractions of the person's size in the image (the diagonal of the box around the joints), on top of the "
        "detector's own errors. The weights of the paper's selection are soft, so hypotheses with an outlier keep a "
        "share of its average; the best-scored hypothesis alone stands beside it. The view weights' pool is drawn from "
        "the views on which adaptive RANSAC finds agreement.",
        OUTLIERS,
        claims=_outlier_claims,
    ),
    _item(
        "robustness-noise",
        "More noise",
        _SAME
        + "Gaussian noise on every detection, in each coordinate, on top of the detector's own errors.",
        NOISE,
    ),
    _item(
        "robustness-views",
        "Two to 31 cameras",
        "Of the 31 HD cameras each frame has its own random choice; a larger choice contains the smaller ones. The "
        "people are those of the training, later in the same sequences. Where not all joints are "
        "seen in two views, the errors of different rows are of different joints.",
        VIEWS,
    ),
    _item(
        "robustness-missing",
        "Missing detections and missing views",
        _SAME
        + "On the left a random share of the detections is taken away, on the right whole random views of each "
        "frame. A joint with fewer than two views left is estimated by nobody and not counted, nor is any joint of a "
        "frame without a pelvis: errors of different rows are of different joints.",
        DETECTIONS,
        MISSING_VIEWS,
    ),
    _item(
        "robustness-calibration",
        "Wrong cameras",
        _SAME
        + "Each camera of each frame is turned about a random axis through its centre, or shifted in a random "
        "direction, in what the estimators are given; the truth stays in the true world.",
        ROTATION,
        SHIFT,
        absolute=True,
    ),
)
