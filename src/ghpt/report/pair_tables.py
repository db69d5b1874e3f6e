"""What a test run of the camera problem reports: in the terminal, and in report.md."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from typing import Any

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.measured import Number
from ghpt.models.relative_pose.evaluation import ALONE, ERRORS, PairNumbers, PairsMeasured
from ghpt.paper.published import FUNDAMENTAL, FUNDAMENTAL_DISSECTION, FUNDAMENTAL_FRAMES
from ghpt.report.document import Block, Document, Heading, Paragraph, Strong, Table, Text, prose
from ghpt.report.tables import NONE, origin_text, title

NAMES = {
    "eight_point": "8-point",
    "ransac": "RANSAC",
    "usac_magsac": "USAC_MAGSAC",
    "usac_accurate": "USAC_ACCURATE",
    "poselib": "PoseLib",
    "five_point": "5-point, refined",
    "weight_refined": "weight, refined",
    "rig": "rig (all views)",
}
"""What people call a row, where it is not its name in metrics.json."""

UNITS = {
    "E_R": "10⁻³",
    "E_t": "mm",
    "E_2D": "px",
    "E_3D": "mm",
    "rotation_deg": "degrees",
    "translation_deg": "degrees",
}
COLUMNS = 6
"""The most pairs that have a column each in the terminal."""
MANY = 10
"""The most that have one in report.md, and a row in the terminal: of more it shows the worst."""
_DESCRIPTIONS = {
    "E_R": "rotation, as quaternions",
    "E_t": "translation",
    "E_2D": "points in the target's image",
    "E_3D": "points in space",
    "rotation_deg": "angle between the rotations",
    "translation_deg": "angle between the translations",
}
_TERMINAL = ("pair", "E_R", "E_t", "E_2D", "E_3D", "rot", "dir")
"""The columns of the errors in the terminal."""
_CAPTION = "medians over draws; E_R in 1e-3, E_t and E_3D in mm, E_2D in pixels"
_ANGLES = "rot, dir: degrees between the rotations, the directions of t"
_PAPER = "; in brackets: the paper, real data"
_ABOUT = (
    "Errors of section 4.5 of the paper: E_R of the rotation (difference of quaternions, in 10⁻³), "
    "E_t of the translation (mm), E_2D (pixels) and E_3D (mm) of random points of the capture "
    "volume; and angles between the rotations and between the directions of the translations. Each "
    "is the median over all draws, in which a draw without an estimate counts as infinitely bad. "
    "Best and worst look at the truth."
)
_ABOUT_THE_PAPER = (
    "In brackets: the paper, tab:fundamental-evaluation, on the real data set. It calls (1, 3) and "
    "(2, 4) diagonal; in the data set's order of cameras, in which we read it, these stand side by "
    "side, and 1-4 and 2-3 face each other."
)


def pair_order(measured: PairsMeasured) -> list[str]:
    """Return the pairs' names, those of four cameras in the order of tab:fundamental-evaluation."""
    pairs = list(next(iter(measured.selections.values())).pairs)
    paper = [f"{a}-{b}" for a, b in FUNDAMENTAL]
    return paper if set(pairs) == set(paper) else pairs


def paper_numbers(measured: PairsMeasured, table: Mapping[tuple[int, int], Any]) -> dict[str, Any]:
    """Return a table of the paper by pair name.

    It is empty unless the run is one on Human3.6M's test split, trained there, with as many frames.
    """
    run = measured.run
    data = (run.training[0], run.data, run.split)
    size = (len(measured.cameras), run.frames)
    if data != ("h36m", "h36m", "test") or size != (4, FUNDAMENTAL_FRAMES):
        return {}
    return {f"{a}-{b}": errors for (a, b), errors in table.items()}


def pair_rows(measured: PairsMeasured, name: str) -> list[list[str]]:
    """Return a row for each pair: its name and the six errors of a selection.

    Those of ``weight`` have the paper's in brackets.
    """
    paper = paper_numbers(measured, FUNDAMENTAL) if name == "weight" else {}
    rows = []
    for pair in _worst_first(measured, name):
        median = measured.selections[name].pairs[pair].median
        printed = paper.get(pair, {})
        errors = [_beside_paper(error, median[error], printed.get(error)) for error in ERRORS]
        rows.append([pair, *errors])
    return rows


def pair_summary_document(measured: PairsMeasured) -> Document:
    """Return the errors of ``weight`` on each pair, then E_3D of every name, for 80 columns."""
    rows = pair_rows(measured, "weight")
    worst = f", the {MANY} worst of {len(rows)} pairs" if len(rows) > MANY else ""
    paper = _PAPER if paper_numbers(measured, FUNDAMENTAL) else ""
    errors = Table(
        _TERMINAL,
        rows[:MANY],
        title=f"weight{worst} on {title(measured.run)}",
        caption=(_CAPTION, _ANGLES + paper),
    )
    return Document("", [errors, _comparison_summary(measured)])


def _comparison_summary(measured: PairsMeasured) -> Table:
    comparison = comparison_table(measured)
    names = list(measured.selections)
    rows: list[list[Text]] = []
    for name, row in zip(names, comparison.rows, strict=True):
        rows.append([Strong(str(cell)) for cell in row] if name == "weight" else list(row))
    last = AGGREGATIONS[-1]
    return Table(
        comparison.header,
        rows,
        title="E_3D in mm",
        caption=("cov: pairs estimated, %",),
        last_rows=[names.index(last)] if last in names else [],
    )


def comparison_table(measured: PairsMeasured) -> Table:
    """Return E_3D of every name on each pair; where there are many, of the median and the worst."""
    order = pair_order(measured)
    many = len(order) > COLUMNS
    columns = ["median", "worst", "its pair"] if many else order
    rows = []
    for name, numbers in measured.selections.items():
        errors = {pair: numbers.pairs[pair].median["E_3D"] for pair in order}
        cells = _middle_and_worst(errors) if many else [_short(errors[pair]) for pair in order]
        coverage = NONE if numbers.coverage is None else f"{100 * numbers.coverage:.3g}"
        rows.append([NAMES.get(name, name), *cells, _short(numbers.headline), coverage])
    return Table(["selection", *columns, "mean", "cov"], rows)


def _middle_and_worst(errors: Mapping[str, Number]) -> list[str]:
    finite = {pair: _none_to_inf(error) for pair, error in errors.items()}
    worst = max(finite, key=finite.__getitem__)
    middle = statistics.median(finite.values())
    return [_short(middle), _short(errors[worst]), worst]


def pair_report_document(measured: PairsMeasured) -> Document:
    """Return the report of a test run of the camera problem."""
    paper = bool(paper_numbers(measured, FUNDAMENTAL))
    header = ["pair", *(f"{error}, {UNITS[error]}" for error in ERRORS)]
    in_brackets = " In brackets: the paper, tab:fundamental-dissection." if paper else ""
    blocks: list[Block] = [
        Paragraph(_origin(measured)),
        Paragraph(_ABOUT),
        Heading(prose("Selection `weight`")),
        Table(header, pair_rows(measured, "weight")),
        *([Paragraph(_ABOUT_THE_PAPER)] if paper else []),
        Heading("E_3D of all"),
        comparison_table(measured),
        Heading("One part estimated, the other true"),
        Paragraph(prose("Median errors of `weight`.{}", in_brackets)),
        dissection_table(measured),
    ]
    for error in ERRORS:
        blocks += [
            Heading(f"{error}: {_DESCRIPTIONS[error]}, {UNITS[error]}"),
            Paragraph("Medians."),
            _median_table(measured, error),
            Paragraph("Means ± deviations over the draws that could be measured."),
            _mean_table(measured, error),
        ]
    return Document(f"Relative camera poses on {title(measured.run)}", blocks)


def _origin(measured: PairsMeasured) -> Text:
    run = measured.run
    cameras = ", ".join(measured.cameras)
    size = f"{measured.draws} draws of {run.frames} frames"
    return (f"{size}, cameras {cameras}, seed {run.seed}, ", *origin_text(run))


def dissection_table(measured: PairsMeasured) -> Table:
    """Return tab:fundamental-dissection for ``weight``."""
    paper = paper_numbers(measured, FUNDAMENTAL_DISSECTION)
    rows = []
    for pair in pair_order(measured):
        alone = measured.selections["weight"].pairs[pair].alone
        printed = paper.get(pair, {})
        cells = [
            _beside_paper(error, alone[part][error], printed.get(part, {}).get(error))
            for part in ALONE
            for error in ("E_2D", "E_3D")
        ]
        rows.append([pair, *cells])
    return Table(["pair", "R: E_2D, px", "R: E_3D, mm", "t: E_2D, px", "t: E_3D, mm"], rows)


def _median_table(measured: PairsMeasured, error: str) -> Table:
    """Return the medians of an error of every name on every pair, and their means."""

    def cell(numbers: PairNumbers) -> str:
        return _short(_in_unit(error, numbers.median[error]))

    selections = measured.selections
    table = _error_table(measured, {name: _cells(measured, name, cell) for name in selections})
    if len(pair_order(measured)) > MANY:
        return table
    means = [_short(_in_unit(error, numbers.mean[error])) for numbers in selections.values()]
    rows = [[*row, mean] for row, mean in zip(table.rows, means, strict=True)]
    return Table([*table.header, "mean"], rows)


def _mean_table(measured: PairsMeasured, error: str) -> Table:
    """Return means and deviations of an error of every name on every pair."""

    def cell(numbers: PairNumbers) -> str:
        mean = _short(_in_unit(error, numbers.mean[error]))
        deviation = _short(_in_unit(error, numbers.deviation[error]))
        return f"{mean} ± {deviation}"

    cells = {name: _cells(measured, name, cell) for name in measured.selections}
    return _error_table(measured, cells)


def _cells(measured: PairsMeasured, name: str, cell: Callable[[PairNumbers], str]) -> list[str]:
    """Return a selection's cells in the order of the pairs."""
    pairs = measured.selections[name].pairs
    return [cell(pairs[pair]) for pair in pair_order(measured)]


def _error_table(measured: PairsMeasured, cells: Mapping[str, list[str]]) -> Table:
    """Return a table of cells by name; a row is a name, or where there are many pairs, a pair."""
    order = pair_order(measured)
    if len(order) <= MANY:
        rows = [[NAMES.get(name, name), *of_name] for name, of_name in cells.items()]
        return Table(["selection", *order], rows)
    columns = zip(*cells.values(), strict=True)
    return Table(["pair", *cells], [[pair, *row] for pair, row in zip(order, columns, strict=True)])


def _worst_first(measured: PairsMeasured, name: str) -> list[str]:
    """Return the pairs in the paper's order; where there are many, the largest E_3D first."""
    order = pair_order(measured)
    if len(order) <= MANY:
        return order
    pairs = measured.selections[name].pairs
    return sorted(order, key=lambda pair: -_none_to_inf(pairs[pair].median["E_3D"]))


def _beside_paper(error: str, value: Number, paper: Number) -> str:
    ours = _short(_in_unit(error, value))
    if paper is None:
        return ours
    return f"{ours} ({_as_printed(1000 * paper if error == 'E_R' else paper)})"


def _in_unit(error: str, value: Number) -> Number:
    """Return an error in its unit of ``UNITS``."""
    if value is None:
        return None
    return 1000 * value if error == "E_R" else value


def _as_printed(value: float) -> str:
    """Return the number as the paper prints it: 0.72, 4.9, 10.8, 23."""
    if value < 1:
        return f"{value:.2g}"
    return f"{value:.1f}" if value % 1 or value < 10 else f"{value:.0f}"


def _none_to_inf(value: Number) -> float:
    return math.inf if value is None else value


def _short(value: Number) -> str:
    """Return at most five characters: 0.12, 1.23, 12.3, 123, 1e+05."""
    if value is None or value == math.inf:
        return NONE
    if value >= 99999.5:
        return f"{value:.0e}"
    digits = 2 if value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f}"
