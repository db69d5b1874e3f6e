"""What a robustness curve shows: a table, and where the learned estimators stand, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ghpt.paper.engine.artefact import signed
from ghpt.paper.robustness.curve import Curve, Found, nan_to_last
from ghpt.paper.robustness.figure import LABELS
from ghpt.report.escape import Markdown
from ghpt.report.tables import NONE, markdown

TIE = 5e-4
"""Errors that differ by a smaller share are equal in print."""


def table(curve: Curve, of: Found, kind: str) -> str:
    """Levels x estimators; the coverage where it is not whole. The least error of a level is bold."""
    head = [curve.x, *(LABELS.get(name, name) for name in of.errors[kind])]
    partial_coverage = min(low for low, _ in of.coverage) < 0.99995
    rows = []
    for i, level in enumerate(of.levels):
        least = min(
            nan_to_last(spreads[i].mean)
            for name, spreads in of.errors[kind].items()
            if name != "best"
        )
        texts = [NONE if math.isnan(s[i].mean) else s[i].text() for s in of.errors[kind].values()]
        means = [spreads[i].mean for spreads in of.errors[kind].values()]
        bold = [
            Markdown(f"**{text}**") if mean == least else text
            for text, mean in zip(texts, means, strict=True)
        ]
        rows.append([level, *bold, *([_share(*of.coverage[i])] if partial_coverage else [])])
    return markdown([*head, *(["joints counted"] if partial_coverage else [])], rows)


def _share(low: float, high: float) -> str:
    same = f"{100 * low:.1f}" == f"{100 * high:.1f}"
    return f"{100 * low:.1f} %" if same else f"{100 * low:.1f} to {100 * high:.1f} %"


def verdict(curve: Curve, of: Found) -> str:
    """Where the view weights stand against the best classical estimator of each level, and where
    the paper's selection stands against that, LO-RANSAC and its own pool.
    """
    last = len(of.levels) - 1
    parts = [_view_weights(curve, of), _against(curve, of, 0), _against(curve, of, last)]
    ahead = [f"of all classical estimators at {_where(curve, of, of.classical)}"]
    if "lo_ransac" in of.classical:
        ahead.append(f"of LO-RANSAC at {_where(curve, of, ['lo_ransac'])}")
    parts.append(f"It is ahead {', '.join(ahead)}.")
    most, best = (
        " and ".join(f"{of.mean(name, i):.1f}" for i in (0, last)) for name in ("most", "best")
    )
    parts.append(
        f"At these two ends the best-scored hypothesis of its pool has {most} mm, the best of its pool {best}."
    )
    return " ".join(part for part in parts if part)


def _view_weights(curve: Curve, of: Found) -> str:
    """Wins, ties and losses over the levels at which something was counted, and the two ends."""
    leads = {i: of.lead("view_weights", i) for i in range(len(of.levels))}
    leads = {i: lead for i, lead in leads.items() if math.isfinite(lead)}
    if not leads:
        return ""
    won = sum(lead > TIE for lead in leads.values())
    lost = sum(lead < -TIE for lead in leads.values())
    worst, best = (
        f"{standing(of, i)} at {of.levels[i]}{curve.unit}"
        for i in (min(leads, key=leads.__getitem__), max(leads, key=leads.__getitem__))
    )
    return (
        f"Against the best classical estimator of each of {len(leads)} levels the view weights win {won}, tie "
        f"{len(leads) - won - lost} and lose {lost}: from {worst} to {best}."
    )


def standing(of: Found, level: int, name: str = "view_weights") -> str:
    """``+2.8 % (24.0 mm, adaptive RANSAC 24.7)``: by what share an estimator leads the best
    classical one.
    """
    other = of.best_classical(level)
    ours = of.mean(name, level)
    theirs = of.mean(other, level)
    return f"{signed(100 * of.lead(name, level))} % ({ours:.1f} mm, {LABELS.get(other, other)} {theirs:.1f})"


def _where(curve: Curve, of: Found, others: Sequence[str]) -> str:
    """The levels at which the paper's selection is ahead of all these."""
    wins = [
        level
        for i, level in enumerate(of.levels)
        if of.mean("weight", i) < (1 - TIE) * min(nan_to_last(of.mean(name, i)) for name in others)
    ]
    return (
        "no level"
        if not wins
        else "every level"
        if len(wins) == len(of.levels)
        else ", ".join(wins) + curve.unit
    )


def _against(curve: Curve, of: Found, level: int) -> str:
    ours = of.mean("weight", level)
    average = of.mean("average", level)
    name = of.best_classical(level)
    lead = of.lead("weight", level)
    gain = 1 - ours / average
    does = "is level with" if abs(lead) <= TIE else "beats" if lead > 0 else "loses to"
    by = "" if abs(lead) <= TIE else f" by {100 * abs(lead):.1f} %"
    pool = (
        "equals"
        if abs(gain) <= TIE
        else f"is {100 * abs(gain):.1f} % {'below' if gain > 0 else 'above'}"
    )
    return (
        f"At {of.levels[level]}{curve.unit} the paper's selection ({ours:.1f} mm) {does} the best classical estimator, "
        f"{LABELS.get(name, name)} ({of.mean(name, level):.1f} mm){by}, and {pool} the average of its pool."
    )
