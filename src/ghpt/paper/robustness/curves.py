"""The robustness curves, which the paper lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, figure_block
from ghpt.paper.robustness.curve import Curve, CurveResult, curve_tasks, read_curve
from ghpt.paper.robustness.figure import LABELS, Line, Panel, draw_curves
from ghpt.paper.robustness.text import TIE, error_table, margin, verdict
from ghpt.report.document import Block, Paragraph

Claims = Callable[[CurveResult], list[Claim]]
_TABLE_ALONE = ("most", "best")
"""Estimators that are not in the figures."""


def _section(
    results: Results, curves: Sequence[Curve], about: str, absolute: bool, claims: Claims
) -> Section:
    """Return the section of some curves; ``absolute`` adds a table of absolute errors."""
    measured = {curve: read_curve(results, curve) for curve in curves}
    first = curves[0]
    data = results.display_name(first.data)
    training = results.display_name(results.setup.sizes.robustness.trained_on)
    panels = [_panel(curve, result) for curve, result in measured.items()]
    heading = f"{data}, test split\nlearned estimators trained on {training}"
    figure = draw_curves(panels, heading, "pelvis-relative MPJPE, mm")
    name = f"robustness_{first.name}"
    caption = f"Pelvis-relative MPJPE of every estimator; {data}, trained on {training}"
    blocks: list[Block] = [Paragraph(about), figure_block(name, caption)]
    for curve, result in measured.items():
        blocks += _curve_blocks(curve, result, absolute)
    return Section(data, blocks, {name: figure}, claims=claims(measured[first]))


def _panel(curve: Curve, result: CurveResult) -> Panel:
    lines = {
        name: Line(result.places, errors)
        for name, errors in result.errors["relative"].items()
        if name not in _TABLE_ALONE
    }
    return Panel(curve.x, lines, curve.logarithmic)


def _curve_blocks(curve: Curve, result: CurveResult, absolute: bool) -> list[Block]:
    frames = f"MPJPE, mm, on {result.frames} frames:"
    blocks: list[Block] = [
        Paragraph(f"Pelvis-relative {frames}"),
        error_table(curve, result, "relative"),
    ]
    if absolute:
        blocks += [Paragraph(f"Absolute {frames}"), error_table(curve, result, "absolute")]
    return [*blocks, Paragraph(verdict(curve, result))]


def _no_claims(result: CurveResult) -> list[Claim]:
    return []


def _outlier_claims(result: CurveResult) -> list[Claim]:
    return [_growth_claim(result), _view_weights_claim(result)]


def _growth_claim(result: CurveResult) -> Claim:
    """Return what section 2 says of erroneous detections."""
    last = result.last
    best = result.best_classical(last)
    ours = (result.mean("weight", 0), result.mean("weight", last))
    linear = (result.mean("linear", 0), result.mean("linear", last))
    classical = (result.mean(best, 0), result.mean(best, last))
    return Claim(
        "robust to erroneous detections (held if its error grows less than that of any classical "
        "estimator)",
        "2",
        ours[1] - ours[0] < classical[1] - classical[0],
        f"from {result.levels[0]} to {result.levels[-1]} % outliers {_from_to(*ours)} mm, "
        f"linear {_from_to(*linear)}; {LABELS.get(best, best)} {_from_to(*classical)}",
    )


def _from_to(first: float, last: float) -> str:
    return f"{first:.1f} to {last:.1f}"


def _view_weights_claim(result: CurveResult) -> Claim:
    leads = [result.lead("view_weights", level) for level in range(len(result.levels))]
    worst = leads.index(min(leads))
    best = leads.index(max(leads))
    return Claim(
        "view weights are at least as good as every classical estimator, adaptive RANSAC too, at "
        "every level",
        "not in the paper",
        min(leads) >= -TIE,
        f"worst margin {margin(result, worst)} at {result.levels[worst]} %; "
        f"best margin {margin(result, best)} at {result.levels[best]} %",
    )


def _artefact(
    label: str,
    title: str,
    about: str,
    *curves: Curve,
    absolute: bool = False,
    claims: Claims = _no_claims,
) -> Artefact:
    section = partial(_section, curves=curves, about=about, absolute=absolute, claims=claims)
    return Artefact(label, "robustness", title, partial(curve_tasks, curves=curves), section)


_SAME = (
    "All estimators get the same key points; none is trained or tuned again, and confidences stay "
    "as they were. "
)

OUTLIERS = Curve(
    "outliers",
    "Outliers",
    "rate",
    lambda sizes: sizes.outliers,
    "outliers, % of the detections",
    " %",
    100.0,
    constants_of=lambda sizes: {
        "shortest": sizes.outliers_shortest,
        "longest": sizes.outliers_longest,
    },
)
NOISE = Curve(
    "noise",
    "Noise",
    "deviation",
    lambda sizes: sizes.noise,
    "added noise, % of the person's size in the image",
    " %",
    100.0,
)
VIEWS = Curve(
    "views",
    "FewerCameras",
    "count",
    lambda sizes: sizes.views,
    "cameras",
    " cameras",
    data="panoptic",
    logarithmic=True,
)
DETECTIONS = Curve(
    "missing_detections",
    "MissingDetections",
    "rate",
    lambda sizes: sizes.missing_detections,
    "missing detections, %",
    " %",
    100.0,
)
MISSING_VIEWS = Curve(
    "missing_views",
    "MissingViews",
    "count",
    lambda sizes: sizes.missing_views,
    "missing views of four",
    " missing view(s)",
)
ROTATION = Curve(
    "rotation",
    "RotatedCameras",
    "degrees",
    lambda sizes: sizes.rotation,
    "rotation of each camera, degrees",
    "°",
)
SHIFT = Curve(
    "shift",
    "ShiftedCameras",
    "millimetres",
    lambda sizes: sizes.shift,
    "shift of each camera, mm",
    " mm",
)

ARTEFACTS = (
    _artefact(
        "robustness-outliers",
        "More outliers",
        f"{_SAME}A random share of the detections is moved in a random direction, by a random "
        "length within a range of fractions of the person's size in the image (the diagonal of the "
        "box around the joints), on top of the detector's own errors. The weights of the paper's "
        "selection are soft, so hypotheses with an outlier keep a share of its average; the "
        "best-scored hypothesis alone stands beside it. The view weights' pool is drawn from the "
        "views on which adaptive RANSAC finds agreement.",
        OUTLIERS,
        claims=_outlier_claims,
    ),
    _artefact(
        "robustness-noise",
        "More noise",
        f"{_SAME}Gaussian noise on every detection, in each coordinate, on top of the detector's "
        "own errors.",
        NOISE,
    ),
    _artefact(
        "robustness-views",
        "Two to 31 cameras",
        "Of the 31 HD cameras each frame has its own random choice; a larger choice contains the "
        "smaller ones. The people are those of the training, later in the same sequences. Where "
        "not all joints are seen in two views, the errors of different rows are of different "
        "joints.",
        VIEWS,
    ),
    _artefact(
        "robustness-missing",
        "Missing detections and missing views",
        f"{_SAME}On the left a random share of the detections is taken away, on the right whole "
        "random views of each frame. A joint with fewer than two views left is estimated by nobody "
        "and not counted, nor is any joint of a frame without a pelvis: errors of different rows "
        "are of different joints.",
        DETECTIONS,
        MISSING_VIEWS,
    ),
    _artefact(
        "robustness-calibration",
        "Wrong cameras",
        f"{_SAME}Each camera of each frame is turned about a random axis through its centre, or "
        "shifted in a random direction, in what the estimators are given; the truth stays in the "
        "true world.",
        ROTATION,
        SHIFT,
        absolute=True,
    ),
)
