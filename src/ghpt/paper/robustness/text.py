"""What a robustness curve shows: a table, and where the learned estimators stand, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ghpt.paper.engine.artefact import Spread, format_signed
from ghpt.paper.robustness.curve import Curve, CurveResult, nan_to_inf
from ghpt.paper.robustness.figure import LABELS
from ghpt.report.document import Strong, Table, Text
from ghpt.report.tables import NONE

TIE = 5e-4
"""Errors that differ by a smaller share are equal in print."""
_WHOLE = 0.99995
"""A coverage above it is printed as 100.0 %."""


def error_table(curve: Curve, result: CurveResult, kind: str) -> Table:
    """Return a table levels x estimators; the least error of a level is bold.

    The coverage has a column where it is not whole.
    """
    estimators = result.errors[kind]
    header = [curve.x, *(LABELS.get(name, name) for name in estimators)]
    whole = all(low >= _WHOLE for low, _ in result.coverage)
    rows: list[list[Text]] = []
    for level, label in enumerate(result.levels):
        rivals = [errors[level].mean for name, errors in estimators.items() if name != "best"]
        least = min(map(nan_to_inf, rivals))
        cells = [_error_cell(errors[level], least) for errors in estimators.values()]
        coverage = [] if whole else [_coverage_text(*result.coverage[level])]
        rows.append([label, *cells, *coverage])
    return Table(header if whole else [*header, "joints counted"], rows)


def _error_cell(error: Spread, least: float) -> Text:
    if math.isnan(error.mean):
        return NONE
    return Strong(error.text()) if error.mean == least else error.text()


def _coverage_text(low: float, high: float) -> str:
    smallest = f"{100 * low:.1f}"
    largest = f"{100 * high:.1f}"
    return f"{smallest} %" if smallest == largest else f"{smallest} to {largest} %"


def verdict(curve: Curve, result: CurveResult) -> str:
    """Return where our estimators and the paper's selection stand at the levels of a curve.

    Ours are set against the best classical estimator of each level; the paper's selection against
    that, LO-RANSAC and its own pool.
    """
    ahead = [f"of all classical estimators at {_winning_levels(curve, result, result.classical)}"]
    if "lo_ransac" in result.classical:
        ahead.append(f"of LO-RANSAC at {_winning_levels(curve, result, ['lo_ransac'])}")
    most = _means_at_ends(result, "most")
    best = _means_at_ends(result, "best")
    sentences = [
        *(_lead_text(curve, result, name) for name in result.ours),
        _selection_text(curve, result, 0),
        _selection_text(curve, result, result.last),
        f"It is ahead {', '.join(ahead)}.",
        f"At these two ends the best-scored hypothesis of its pool has {most} mm, the best of its "
        f"pool {best}.",
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _means_at_ends(result: CurveResult, name: str) -> str:
    return f"{result.mean(name, 0):.1f} and {result.mean(name, result.last):.1f}"


def _lead_text(curve: Curve, result: CurveResult, name: str) -> str:
    """Return an estimator's wins, ties and losses over the measured levels, and the two ends."""
    leads = result.leads(name)
    if not leads:
        return ""
    won = sum(lead > TIE for lead in leads.values())
    lost = sum(lead < -TIE for lead in leads.values())
    tied = len(leads) - won - lost
    worst = min(leads, key=leads.__getitem__)
    best = max(leads, key=leads.__getitem__)
    label = LABELS[name]
    return (
        f"Against the best classical estimator of each of {len(leads)} levels the {label} win "
        f"{won}, tie {tied} and lose {lost}: "
        f"from {margin(result, worst, name)} at {result.levels[worst]}{curve.unit} "
        f"to {margin(result, best, name)} at {result.levels[best]}{curve.unit}."
    )


def margin(result: CurveResult, level: int, name: str) -> str:
    """Return by what share an estimator leads the best classical one.

    For example ``+2.8 % (24.0 mm, adaptive RANSAC 24.7)``.
    """
    other = result.best_classical(level)
    ours = result.mean(name, level)
    theirs = result.mean(other, level)
    lead = format_signed(100 * result.lead(name, level))
    return f"{lead} % ({ours:.1f} mm, {LABELS.get(other, other)} {theirs:.1f})"


def _winning_levels(curve: Curve, result: CurveResult, others: Sequence[str]) -> str:
    """Return the levels at which the paper's selection is ahead of all these."""
    wins = []
    for level, label in enumerate(result.levels):
        rival = min(nan_to_inf(result.mean(name, level)) for name in others)
        if result.mean("weight", level) < (1 - TIE) * rival:
            wins.append(label)
    if not wins:
        return "no level"
    return "every level" if len(wins) == len(result.levels) else ", ".join(wins) + curve.unit


def _selection_text(curve: Curve, result: CurveResult, level: int) -> str:
    """Return where the paper's selection stands at a level."""
    name = result.best_classical(level)
    ours = result.mean("weight", level)
    lead = result.lead("weight", level)
    if abs(lead) <= TIE:
        order = "is level with"
        distance = ""
    else:
        order = "beats" if lead > 0 else "loses to"
        distance = f" by {100 * abs(lead):.1f} %"
    return (
        f"At {result.levels[level]}{curve.unit} the paper's selection ({ours:.1f} mm) {order} the "
        f"best classical estimator, {LABELS.get(name, name)} ({result.mean(name, level):.1f} mm)"
        f"{distance}, and {_pool_text(result, level)} the average of its pool."
    )


def _pool_text(result: CurveResult, level: int) -> str:
    gain = 1 - result.mean("weight", level) / result.mean("average", level)
    if abs(gain) <= TIE:
        return "equals"
    return f"is {100 * abs(gain):.1f} % {'below' if gain > 0 else 'above'}"
