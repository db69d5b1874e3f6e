"""The robustness curves, which the paper lacks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, figure_block
from ghpt.paper.robustness.curve import Curve, CurveResult, curve_tasks, read_curve
from ghpt.paper.robustness.figure import LABELS, Line, Panel, draw_curves
from ghpt.paper.robustness.text import TIE, error_table, margin, verdict
from ghpt.report.document import Block, Paragraph

_TABLE_ALONE = ("most", "best")
"""Estimators that are not in the figures."""
_CLAIMED = ("trajectory", "frame_learned")
"""Those of ours that are to be ahead at every level."""


def _section(results: Results, curves: Sequence[Curve], about: str, absolute: bool) -> Section:
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
    claims = [claim for curve, result in measured.items() for claim in _claims(curve, result)]
    return Section(data, blocks, {name: figure}, claims=claims)


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


def _claims(curve: Curve, result: CurveResult) -> list[Claim]:
    ours = [name for name in _CLAIMED if name in result.ours]
    leads = [_lead_claim(curve, result, name) for name in ours]
    return [_growth_claim(result), *leads] if curve is OUTLIERS else leads


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


def _lead_claim(curve: Curve, result: CurveResult, name: str) -> Claim:
    leads = result.leads(name)
    worst = min(leads, key=leads.__getitem__, default=0)
    best = max(leads, key=leads.__getitem__, default=0)
    return Claim(
        f"{LABELS[name]} are at least as good as every classical estimator of single frames, "
        f"whatever the level: {curve.x}",
        "not in the paper",
        bool(leads) and min(leads.values()) >= -TIE,
        f"worst margin {margin(result, worst, name)} at {result.levels[worst]}{curve.unit}; "
        f"best margin {margin(result, best, name)} at {result.levels[best]}{curve.unit}",
    )


def _artefact(
    label: str,
    title: str,
    about: str,
    *curves: Curve,
    absolute: bool = False,
) -> Artefact:
    section = partial(_section, curves=curves, about=about, absolute=absolute)
    return Artefact(label, "robustness", title, partial(curve_tasks, curves=curves), section)


_SAME = (
    "All estimators get the same key points of the same frames, the trajectory their neighbours in "
    "time too; none is trained or tuned again, and confidences stay as they were. "
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
LASTING_OUTLIERS = Curve(
    "lasting_outliers",
    "Outliers",
    "rate",
    lambda sizes: sizes.lasting_outliers,
    "outliers that last 0.3 s, % of the detections",
    " %",
    100.0,
    constants_of=lambda sizes: {
        "shortest": sizes.outliers_shortest,
        "longest": sizes.outliers_longest,
        "frames": sizes.lasting,
    },
)
FLIPS = Curve(
    "flips",
    "FlippedViews",
    "rate",
    lambda sizes: sizes.flips,
    "views with left and right exchanged, %",
    " %",
    100.0,
    constants_of=lambda sizes: {"frames": sizes.lasting},
)
OTHER_PEOPLE = Curve(
    "other_people",
    "OtherPeople",
    "rate",
    lambda sizes: sizes.other_people,
    "views that show somebody else, %",
    " %",
    100.0,
    constants_of=lambda sizes: {
        "frames": sizes.lasting,
        "nearest": sizes.nearest,
        "farthest": sizes.farthest,
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

ALL_CURVES = (
    OUTLIERS,
    LASTING_OUTLIERS,
    FLIPS,
    OTHER_PEOPLE,
    NOISE,
    VIEWS,
    DETECTIONS,
    MISSING_VIEWS,
    ROTATION,
    SHIFT,
)

ARTEFACTS = (
    _artefact(
        "robustness-outliers",
        "More outliers",
        f"{_SAME}A random share of the detections is moved in a random direction, by a random "
        "length within a range of fractions of the person's size in the image (the diagonal of the "
        "box around the joints), on top of the detector's own errors: on the left new in every "
        "frame, on the right for 0.3 s at a time. The weights of the paper's "
        "selection are soft, so hypotheses with an outlier keep a share of its average; the "
        "best-scored hypothesis alone stands beside it.",
        OUTLIERS,
        LASTING_OUTLIERS,
    ),
    _artefact(
        "robustness-noise",
        "More noise",
        f"{_SAME}Gaussian noise on every detection, in each coordinate, on top of the detector's "
        "own errors.",
        NOISE,
    ),
    _artefact(
        "robustness-people",
        "Left and right exchanged, and other people",
        f"{_SAME}On the left the left and right joints of random views are exchanged, on the right "
        "random views show somebody else in another place, both for 0.3 s at a time. All views "
        "that show somebody else at one time show the same person.",
        FLIPS,
        OTHER_PEOPLE,
    ),
    _artefact(
        "robustness-views",
        "Two to 31 cameras",
        "Of the 31 HD cameras each recording has its own random choice; a larger one "
        "contains the smaller. The people are those of the training, later in the same "
        "sequences. Where not all joints are seen in two views, the errors of different rows are "
        "of different joints.",
        VIEWS,
    ),
    _artefact(
        "robustness-missing",
        "Missing detections and missing views",
        f"{_SAME}On the left a random share of the detections is taken away, on the right whole "
        "random views of each recording. A joint with fewer than two views left is estimated by "
        "nobody but the trajectory, where one view still sees it, and not counted, nor is any "
        "joint of a frame without a pelvis: errors of different rows and columns are of different "
        "joints.",
        DETECTIONS,
        MISSING_VIEWS,
    ),
    _artefact(
        "robustness-calibration",
        "Wrong cameras",
        f"{_SAME}Each camera of a recording is turned about a random axis through its centre, or "
        "shifted in a random direction, in what the estimators are given; the truth stays in the "
        "true world.",
        ROTATION,
        SHIFT,
        absolute=True,
    ),
)
