"""The learned view weights across camera arrangements, which the paper lacks."""

from __future__ import annotations

from itertools import product

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, signed
from ghpt.paper.pose.generalization import PANOPTIC, four, grid
from ghpt.paper.published import ARRANGEMENTS
from ghpt.report.tables import NAMES, markdown

ROWS = {"view weights": "view_weights", "the paper's selection": "weight"}
"""In the table -> in metrics.json."""
DIGITS = 2
"""One hardly tells the rows on Panoptic apart."""


def best_classical(results: Results, test: str) -> tuple[str, float]:
    """Name and error (mm) of the best classical estimator on a test set; it knows no training set."""
    task = f"{test} on {test}"
    learned = (*AGGREGATIONS, "view_weights")
    names = [
        name for name in results.read(task, "metrics.json")[0]["selections"] if name not in learned
    ]
    means = {name: results.relative(task, name).mean for name in names}
    best = min(means, key=means.__getitem__)
    return best, means[best]


def _section(results: Results) -> Section:
    classical = {test: best_classical(results, test) for test in ARRANGEMENTS}
    rows = []
    for test, (name, error) in classical.items():
        for row, selection in ROWS.items():
            cells = [
                results.relative(f"{train} on {test}", selection).text(DIGITS)
                for train in ARRANGEMENTS
            ]
            rows.append(
                [f"{test.upper()}, {row}", *cells, f"{NAMES.get(name, name)} {error:.{DIGITS}f}"]
            )
    header = ["test, mm \\ train", *(name.upper() for name in ARRANGEMENTS), "best classical"]
    text = (
        "Not in the paper: the scorer's weights say how much each view is worth, and one triangulation from all views "
        "uses that (`conf/view_weights`). The same models as in generalization-evaluation; nothing is trained again. "
        "The last column is the best classical estimator on the same detections."
    )
    pairs = list(product(ARRANGEMENTS, ARRANGEMENTS))
    ours = {(a, b): results.relative(f"{a} on {b}", "view_weights").mean for a, b in pairs}
    gains = {(a, b): 1 - ours[a, b] / results.relative(f"{a} on {b}").mean for a, b in pairs}
    won = sum(gain > 0 for gain in gains.values())
    worst, best = (f"{signed(100 * pick(gains.values()))} %" for pick in (min, max))
    claims = [
        Claim(
            "view weights beat the paper's selection, whatever the training and the test set",
            "not in the paper",
            min(gains.values()) > 0,
            f"in {won} of {len(gains)}, by {worst} to {best}",
        ),
        _beats_classical("Human3.6M", ours, {"h36m": classical["h36m"]}),
        _beats_classical("Panoptic", ours, {test: classical[test] for test in PANOPTIC}),
    ]
    data = f"{four(results)} and {results.display_name('h36m')}"
    return Section(data, f"{text}\n\n{markdown(header, rows)}", {}, (), claims)


def _beats_classical(
    where: str, ours: dict[tuple[str, str], float], classical: dict[str, tuple[str, float]]
) -> Claim:
    leads = {
        (a, b): 1 - error / classical[b][1] for (a, b), error in ours.items() if b in classical
    }
    train, test = min(leads, key=leads.__getitem__)
    name, error = classical[test]
    won = sum(lead > 0 for lead in leads.values())
    least = f"{signed(100 * leads[train, test])} %"
    by = (
        f"in {won} of {len(leads)}; least, {least}, {train.upper()} to {test.upper()}: "
        f"{ours[train, test]:.{DIGITS}f} mm, {NAMES.get(name, name)} {error:.{DIGITS}f}"
    )
    statement = (
        f"trained on any arrangement, view weights beat every classical estimator on {where}"
    )
    return Claim(statement, "not in the paper", min(leads.values()) > 0, by)


ARTEFACTS = (
    Artefact(
        "view-weights",
        "table",
        "Learned view weights, which the paper lacks",
        grid,
        _section,
        of_paper=False,
    ),
)
