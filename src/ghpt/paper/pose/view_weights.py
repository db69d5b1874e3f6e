"""The learned view weights across camera arrangements, which the paper lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, format_signed
from ghpt.paper.pose.generalization import PANOPTIC, grid, panoptic_name
from ghpt.paper.published import ARRANGEMENTS
from ghpt.report.document import Paragraph, Table, prose
from ghpt.report.tables import NAMES

ROWS = {"view weights": "view_weights", "the paper's selection": "weight"}
"""Name of a row -> selection of metrics.json."""
DIGITS = 2
"""With fewer, the rows on Panoptic can hardly be told apart."""


@dataclass(frozen=True)
class Classical:
    """A classical estimator and its error on a test set; it knows no training set."""

    name: str
    error: float
    """mm."""

    @property
    def text(self) -> str:
        return f"{NAMES.get(self.name, self.name)} {self.error:.{DIGITS}f}"


def best_classical(results: Results, test: str) -> Classical:
    """Return the classical estimator with the smallest error on a test set."""
    task = f"{test} on {test}"
    learned = (*AGGREGATIONS, "view_weights", "frame_learned")
    names = [name for name in results.selections(task) if name not in learned]
    errors = {name: results.relative(task, name).mean for name in names}
    best = min(errors, key=errors.__getitem__)
    return Classical(best, errors[best])


def _section(results: Results) -> Section:
    classical = {test: best_classical(results, test) for test in ARRANGEMENTS}
    rows = []
    for test, best in classical.items():
        for label, selection in ROWS.items():
            errors = [results.relative(f"{train} on {test}", selection) for train in ARRANGEMENTS]
            cells = [error.text(DIGITS) for error in errors]
            rows.append([f"{test.upper()}, {label}", *cells, best.text])
    header = ["test, mm \\ train", *(name.upper() for name in ARRANGEMENTS), "best classical"]
    text = prose(
        "Not in the paper: the scorer's weights say how much each view is worth, and one "
        "triangulation from all views uses that (`conf/view_weights`). The same models as in "
        "generalization-evaluation; nothing is trained again. The last column is the best "
        "classical estimator on the same detections."
    )
    return Section(
        f"{panoptic_name(results)} and {results.display_name('h36m')}",
        [Paragraph(text), Table(header, rows)],
        claims=_claims(results, classical),
    )


def _claims(results: Results, classical: Mapping[str, Classical]) -> list[Claim]:
    errors = {}
    gains = []
    for train, test in product(ARRANGEMENTS, ARRANGEMENTS):
        error = results.relative(f"{train} on {test}", "view_weights").mean
        errors[train, test] = error
        gains.append(1 - error / results.relative(f"{train} on {test}").mean)
    better = sum(gain > 0 for gain in gains)
    smallest = format_signed(100 * min(gains))
    largest = format_signed(100 * max(gains))
    of_panoptic = {test: classical[test] for test in PANOPTIC}
    return [
        Claim(
            "view weights beat the paper's selection, whatever the training and the test set",
            "not in the paper",
            min(gains) > 0,
            f"in {better} of {len(gains)}, by {smallest} % to {largest} %",
        ),
        _classical_claim("Human3.6M", errors, {"h36m": classical["h36m"]}),
        _classical_claim("Panoptic", errors, of_panoptic),
    ]


def _classical_claim(
    where: str, errors: Mapping[tuple[str, str], float], classical: Mapping[str, Classical]
) -> Claim:
    leads = {}
    for (train, test), error in errors.items():
        if test in classical:
            leads[train, test] = 1 - error / classical[test].error
    train, test = min(leads, key=leads.__getitem__)
    better = sum(lead > 0 for lead in leads.values())
    least = format_signed(100 * leads[train, test])
    return Claim(
        f"trained on any arrangement, view weights beat every classical estimator on {where}",
        "not in the paper",
        min(leads.values()) > 0,
        f"in {better} of {len(leads)}; least, {least} %, {train.upper()} to {test.upper()}: "
        f"{errors[train, test]:.{DIGITS}f} mm, {classical[test].text}",
    )


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
