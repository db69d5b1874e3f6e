"""Robustness curves, which the paper lacks: errors under more outliers, noise, missing views, wrong cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ghpt.report.tables import NONE, markdown
from ghpt.reproduction.cells import Cell
from ghpt.reproduction.code import code_digest
from ghpt.reproduction.item import Claim, Item, Results, Section, Spread
from ghpt.reproduction.robustness_figure import LABELS, Panel, curves
from ghpt.reproduction.robustness_work import LEARNED
from ghpt.reproduction.setup import Setup

PERTURBATIONS = "ghpt.reproduction.perturbation"
TIE = 5e-4
"""Errors that differ by a smaller share are equal in print."""
CLEAN = "clean"
"""The cell of a data set as it is, shared by the curves."""


@dataclass(frozen=True)
class Curve:
    """One quantity that gets worse."""

    name: str
    """Of its cell, and of its levels in ``sizes.robustness``; 0 means the data as they are."""
    perturbation: str
    setting: str
    """The perturbation's argument that the levels are of."""
    x: str
    """The axis and the head of the table, with the unit."""
    unit: str = ""
    """In a sentence."""
    times: float = 1.0
    """From the setting to what is shown."""
    data: str = "h36m"
    logarithmic: bool = False
    more: tuple[str, ...] = field(default=())
    """Further arguments, also in ``sizes.robustness``."""

    def levels(self, setup: Setup) -> list[float | int]:
        return setup.sizes["robustness"][self.name]

    def cell(self, setup: Setup) -> Cell:
        sizes = setup.sizes["robustness"]
        more = {name: sizes[f"{self.name}_{name}"] for name in self.more}
        target = f"{PERTURBATIONS}.{self.perturbation}"
        perturbations = [{"_target_": target, self.setting: level, **more} for level in self.levels(setup) if level]
        return measured(setup, self.name, self.data, perturbations)


def measured(setup: Setup, name: str, data: str, perturbations: Sequence[dict[str, Any] | None]) -> Cell:
    """Everybody under each of the perturbations."""
    sizes = setup.sizes["robustness"]
    whole = setup.composed("test", data, *setup.overrides["test"], f"data.stride={sizes['stride'][data]}")
    config = {key: whole[key] for key in ("data", "baselines", "seed", "files") if key in whole}
    config |= {"perturbations": list(perturbations), "code of perturbations": code_digest(PERTURBATIONS)}
    needs = {"model": setup.trained(sizes["trained_on"]), "data": setup.prepared(data, "test")}
    seconds = 2 + (4.0 if data == "h36m" else 6.0) * len(perturbations)
    name = f"robustness-{name}-seed{setup.seed}"
    return Cell(name, "ghpt.reproduction.robustness_work.curve", config, needs, seconds=seconds)


def _cells(setup: Setup, of: Sequence[Curve]) -> dict[str, Cell]:
    cells = {curve.name: curve.cell(setup) for curve in of}
    if any(0 in curve.levels(setup) for curve in of):
        cells[CLEAN] = measured(setup, CLEAN, "h36m", [None])
    return cells


@dataclass(frozen=True)
class Found:
    """The results of a curve."""

    levels: list[str]
    places: list[float]
    errors: dict[str, dict[str, list[Spread]]]
    """Kind -> estimator -> MPJPE at each level, mm; NaN where nothing was counted."""
    coverage: list[tuple[float, float]]
    """Least and largest share of the joints that an estimator has, at each level."""

    @property
    def classical(self) -> list[str]:
        return [name for name in self.errors["relative"] if name not in LEARNED]

    def mean(self, name: str, level: int, kind: str = "relative") -> float:
        return self.errors[kind][name][level].mean

    def best_classical(self, level: int) -> str:
        return min(self.classical, key=lambda name: nan_to_last(self.mean(name, level)))


def nan_to_last(error: float) -> float:
    """For an order in which what has no number comes last."""
    return math.inf if math.isnan(error) else error


def found(results: Results, curve: Curve) -> Found:
    levels = curve.levels(results.setup)
    seeds = [list(each["levels"]) for each in results.read(curve.name)]
    for i, level in enumerate(levels):
        if level == 0:
            for own, clean in zip(seeds, results.read(CLEAN), strict=True):
                own.insert(i, clean["levels"][0])
    names = list(seeds[0][0])

    def spread(kind: str, name: str, i: int) -> Spread:
        values = (own[i][name][kind] for own in seeds)
        return Spread(tuple(float("nan") if value is None else value for value in values))

    errors = {kind: {name: [spread(kind, name, i) for i in range(len(levels))] for name in names}
              for kind in ("relative", "absolute")}  # fmt: skip
    shares = [[own[i][name]["coverage"]["relative"] for own in seeds for name in names] for i in range(len(levels))]
    return Found(
        [f"{curve.times * level:g}" for level in levels], [curve.times * level for level in levels], errors,
        [(min(s), max(s)) for s in shares],
    )  # fmt: skip


def table(curve: Curve, of: Found, kind: str) -> str:
    """Levels x estimators; the coverage where it is not whole. The least error of a level is bold."""
    head = [curve.x, *(LABELS.get(name, name) for name in of.errors[kind])]
    partial_coverage = min(low for low, _ in of.coverage) < 0.99995
    rows = []
    for i, level in enumerate(of.levels):
        least = min(nan_to_last(spreads[i].mean) for name, spreads in of.errors[kind].items() if name != "best")
        texts = [NONE if math.isnan(s[i].mean) else s[i].text() for s in of.errors[kind].values()]
        bold = [f"**{t}**" if s[i].mean == least else t for t, s in zip(texts, of.errors[kind].values(), strict=True)]
        rows.append([level, *bold, *([_share(*of.coverage[i])] if partial_coverage else [])])
    return markdown([*head, *(["joints counted"] if partial_coverage else [])], rows)


def _share(low: float, high: float) -> str:
    same = f"{100 * low:.1f}" == f"{100 * high:.1f}"
    return f"{100 * low:.1f} %" if same else f"{100 * low:.1f} to {100 * high:.1f} %"


def verdict(curve: Curve, of: Found) -> str:
    """Where the learned selection stands against the best classical estimator, LO-RANSAC and its own pool."""
    last = len(of.levels) - 1
    parts = [_against(curve, of, 0), _against(curve, of, last)]
    ahead = [f"of all classical estimators at {_where(curve, of, of.classical)}"]
    if "lo_ransac" in of.classical:
        ahead.append(f"of LO-RANSAC at {_where(curve, of, ['lo_ransac'])}")
    parts.append(f"It is ahead {', '.join(ahead)}.")
    best = " and ".join(f"{of.mean('best', i):.1f}" for i in (0, last))
    parts.append(f"The best hypothesis of its pool, which looks at the truth, has {best} mm there.")
    return " ".join(parts)


def _where(curve: Curve, of: Found, others: Sequence[str]) -> str:
    """The levels at which the learned selection is ahead of all these."""
    wins = [
        level for i, level in enumerate(of.levels)
        if of.mean("weight", i) < (1 - TIE) * min(nan_to_last(of.mean(name, i)) for name in others)
    ]  # fmt: skip
    return "no level" if not wins else "every level" if len(wins) == len(of.levels) else ", ".join(wins) + curve.unit


def _lead(of: Found, level: int) -> float:
    """By what share the learned selection's error is below that of the best classical estimator."""
    return 1 - of.mean("weight", level) / of.mean(of.best_classical(level), level)


def _against(curve: Curve, of: Found, level: int) -> str:
    ours, average, name = of.mean("weight", level), of.mean("average", level), of.best_classical(level)
    lead, gain = _lead(of, level), 1 - ours / average
    does = "is level with" if abs(lead) <= TIE else "beats" if lead > 0 else "loses to"
    by = "" if abs(lead) <= TIE else f" by {100 * abs(lead):.1f} %"
    pool = "equals" if abs(gain) <= TIE else f"is {100 * abs(gain):.1f} % {'below' if gain > 0 else 'above'}"
    return (
        f"At {of.levels[level]}{curve.unit} the learned selection ({ours:.1f} mm) {does} the best classical estimator, "
        f"{LABELS.get(name, name)} ({of.mean(name, level):.1f} mm){by}, and {pool} the average of its pool."
    )


def _section(results: Results, of: Sequence[Curve], about: str, absolute: bool, claims: Claims) -> Section:
    sizes = results.setup.sizes["robustness"]
    all_found = [found(results, curve) for curve in of]
    data = results.words(of[0].data)
    trained = f"trained on {results.words(sizes['trained_on'])}"
    kinds = ("relative", "absolute") if absolute else ("relative",)
    figures, body = {}, [about]
    panels = [
        Panel(c.x, {n: (f.places, s) for n, s in f.errors["relative"].items() if n != "best"}, c.logarithmic)
        for c, f in zip(of, all_found, strict=True)
    ]
    name = f"robustness_{of[0].name}"
    figures[name] = curves(panels, f"{data}, test split\nlearned selection {trained}", "pelvis-relative MPJPE, mm")
    body.append(f"![Pelvis-relative MPJPE of every estimator; {data}, {trained}]({name}.svg)")
    for curve, one in zip(of, all_found, strict=True):
        for kind in kinds:
            said = "Pelvis-relative" if kind == "relative" else "Absolute"
            body.append(f"{said} MPJPE, mm; the learned selection {trained}:\n\n{table(curve, one, kind)}")
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
    return [Claim("the model is robust to erroneous detections: its error grows less than any classical one's", "2",
                  holds, by)]  # fmt: skip


def _item(label: str, title: str, about: str, *of: Curve, absolute: bool = False, claims: Claims = _no_claims) -> Item:
    section = partial(_section, of=of, about=about, absolute=absolute, claims=claims)
    return Item(label, "robustness", title, partial(_cells, of=of), section)


_SAME = "All estimators get the same key points; none is trained or tuned again, and confidences stay as they were. "

OUTLIERS = Curve("outliers", "Outliers", "rate", "outliers, % of the detections", " %", 100.0,
                 more=("shortest", "longest"))  # fmt: skip
NOISE = Curve("noise", "Noise", "deviation", "added noise, % of the person's size in the image", " %", 100.0)
VIEWS = Curve("views", "FewerCameras", "count", "cameras", " cameras", data="panoptic", logarithmic=True)
DETECTIONS = Curve("missing_detections", "MissingDetections", "rate", "missing detections, %", " %", 100.0)
MISSING_VIEWS = Curve("missing_views", "MissingViews", "count", "missing views of four", " missing view(s)")
ROTATION = Curve("rotation", "RotatedCameras", "degrees", "rotation of each camera, degrees", "°")
SHIFT = Curve("shift", "ShiftedCameras", "millimetres", "shift of each camera, mm", " mm")

ITEMS = (
    _item(
        "robustness-outliers",
        "More outliers",
        _SAME + "A random share of the detections is moved in a random direction, by a random length within a range of "
        "fractions of the person's size in the image (the diagonal of the box around the joints), on top of the "
        "detector's own errors. Hypotheses are whole poses: the more outliers, the fewer that are free of them in "
        "every joint, while the robust estimators decide joint by joint.",
        OUTLIERS,
        claims=_outlier_claims,
    ),
    _item(
        "robustness-noise",
        "More noise",
        _SAME + "Gaussian noise on every detection, in each coordinate, on top of the detector's own errors.",
        NOISE,
    ),
    _item(
        "robustness-views",
        "Two to 31 cameras",
        "Of the 31 HD cameras each frame has its own random choice; a larger choice contains the smaller ones. Where "
        "not all joints are seen in two views, the errors of different rows are of different joints.",
        VIEWS,
    ),
    _item(
        "robustness-missing",
        "Missing detections and missing views",
        _SAME + "On the left a random share of the detections is taken away, on the right whole random views of each "
        "frame. A joint with fewer than two views left is estimated by nobody and not counted, nor is any joint of a "
        "frame without a pelvis: errors of different rows are of different joints.",
        DETECTIONS,
        MISSING_VIEWS,
    ),
    _item(
        "robustness-calibration",
        "Wrong cameras",
        _SAME + "Each camera of each frame is turned about a random axis through its centre, or shifted in a random "
        "direction, in what the estimators are given; the truth stays in the true world.",
        ROTATION,
        SHIFT,
        absolute=True,
    ),
)
