"""Tables of a test run of the camera problem: report.md, and those in the terminal."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ghpt.files import atomic_write
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.relative_pose.evaluation import ALONE, ERRORS
from ghpt.paper.published import FUNDAMENTAL, FUNDAMENTAL_DISSECTION, FUNDAMENTAL_FRAMES
from ghpt.report.escape import code, escaped, plain
from ghpt.report.tables import NONE, Rows, markdown, title, trained_on

NAMES = {
    "eight_point": "8-point",
    "ransac": "RANSAC",
    "usac_magsac": "USAC_MAGSAC",
    "usac_accurate": "USAC_ACCURATE",
    "poselib": "PoseLib",
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
_WORDS = {
    "E_R": "rotation, as quaternions",
    "E_t": "translation",
    "E_2D": "points in the target's image",
    "E_3D": "points in space",
    "rotation_deg": "angle between the rotations",
    "translation_deg": "angle between the translations",
}
_CAPTION = """medians over draws; E_R in 1e-3, E_t and E_3D in mm, E_2D in pixels
rot, dir: degrees between the rotations, the directions of t"""
_PAPER = "; in brackets: the paper, real data"
_ABOUT_THE_PAPER = (
    "In brackets: the paper, tab:fundamental-evaluation, on the real data set. It calls (1, 3) and (2, 4) diagonal; in "
    "the data set's order of cameras, in which we read it, these stand side by side, and 1-4 and 2-3 face each other."
)


def pair_order(metrics: Mapping[str, Any]) -> list[str]:
    """The pairs' names, those of four cameras in the order of tab:fundamental-evaluation."""
    pairs = list(next(iter(metrics["selections"].values()))["pairs"])
    paper = [f"{a}-{b}" for a, b in FUNDAMENTAL]
    return paper if set(pairs) == set(paper) else pairs


def of_paper(metrics: Mapping[str, Any], table: Mapping[tuple[int, int], Any]) -> dict[str, Any]:
    """A table of the paper by pair name; empty unless the run is one on Human3.6M's test split,
    trained there, with as many frames.
    """
    here = (trained_on(metrics)[0], metrics["data"], metrics["split"]) == ("h36m", "h36m", "test")
    alike = (len(metrics["cameras"]), metrics["frames"]) == (4, FUNDAMENTAL_FRAMES)
    return {f"{a}-{b}": errors for (a, b), errors in table.items()} if here and alike else {}


def pair_rows(metrics: Mapping[str, Any], name: str) -> Rows:
    """A row for each pair: its name and the six errors of a selection, for ``weight`` with the
    paper's in brackets.
    """
    paper = of_paper(metrics, FUNDAMENTAL) if name == "weight" else {}
    rows = []
    for pair in _worst_first(metrics, name):
        numbers = metrics["selections"][name]["pairs"][pair]
        printed = paper.get(pair, {})
        rows.append(
            [pair, *(_with_paper(error, numbers[error], printed.get(error)) for error in ERRORS)]
        )
    return rows


def print_pair_tables(metrics: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the errors of ``weight`` on each pair, then E_3D of every name, in 80 columns."""
    console = console or Console()
    rows = pair_rows(metrics, "weight")
    worst = f", the {MANY} worst of {len(rows)} pairs" if len(rows) > MANY else ""
    table = Table(
        title=plain(f"weight{worst} on {title(metrics)}", "table.title"),
        caption=_CAPTION + (_PAPER if of_paper(metrics, FUNDAMENTAL) else ""),
        title_justify="left",
        caption_justify="left",
    )
    for column in ("pair", "E_R", "E_t", "E_2D", "E_3D", "rot", "dir"):
        table.add_column(column, justify="left" if column == "pair" else "right", no_wrap=True)
    for row in rows[:MANY]:
        table.add_row(*map(plain, row))
    console.print(table)
    header, rows = comparison(metrics)
    table = Table(
        title="E_3D in mm",
        title_justify="left",
        caption="cov: pairs estimated, %",
        caption_justify="left",
    )
    for column in header:
        table.add_column(column, justify="left" if column == "selection" else "right", no_wrap=True)
    for name, row in zip(metrics["selections"], rows, strict=True):
        table.add_row(
            *map(plain, row),
            end_section=name == AGGREGATIONS[-1],
            style="bold" if name == "weight" else None,
        )
    console.print(table)


def comparison(metrics: Mapping[str, Any]) -> tuple[list[str], Rows]:
    """Header and rows: E_3D of every name on each pair, or, where there are many, the median pair
    and the worst.
    """
    order = pair_order(metrics)
    many = len(order) > COLUMNS
    rows = []
    for name, numbers in metrics["selections"].items():
        by_pair = {pair: numbers["pairs"][pair]["E_3D"] for pair in order}
        cells = [_short(by_pair[pair]) for pair in order]
        if many:
            worst = max(order, key=lambda pair: _or_infinite(by_pair[pair]))
            middle = statistics.median(map(_or_infinite, by_pair.values()))
            cells = [_short(middle), _short(by_pair[worst]), worst]
        coverage = 100 * numbers["coverage"]
        rows.append([NAMES.get(name, name), *cells, _short(numbers["E_3D"]), f"{coverage:.3g}"])
    columns = ["median", "worst", "its pair"] if many else order
    return ["selection", *columns, "mean", "cov"], rows


def pair_report(metrics: Mapping[str, Any]) -> str:
    """The Markdown report of a test run of the camera problem."""
    provenance = metrics.get("provenance") or {}
    paper = of_paper(metrics, FUNDAMENTAL)
    parts = [
        f"# Relative camera poses on {escaped(title(metrics))}",
        f"{metrics['draws']} draws of {metrics['frames']} frames, "
        f"cameras {', '.join(map(escaped, metrics['cameras']))}, "
        f"seed {metrics['seed']}, checkpoint {code(provenance.get('checkpoint', NONE))}, "
        f"ghpt {provenance.get('ghpt', NONE)}, commit `{provenance.get('commit') or NONE}`.",
        "Errors of section 4.5 of the paper: E_R of the rotation (difference of quaternions, in 10⁻³), E_t of the "
        "translation (mm), E_2D (pixels) and E_3D (mm) of random points of the capture volume; and angles between the "
        "rotations and between the directions of the translations. Each is the median over all draws, in which a draw "
        "without an estimate counts as infinitely bad. Best and worst look at the truth.",
        "## Selection `weight`",
        markdown(
            ["pair", *(f"{error}, {UNITS[error]}" for error in ERRORS)],
            pair_rows(metrics, "weight"),
        ),
        _ABOUT_THE_PAPER if paper else "",
        "## E_3D of all",
        markdown(*comparison(metrics)),
        "## One part estimated, the other true",
        "Median errors of `weight`."
        + (" In brackets: the paper, tab:fundamental-dissection." if paper else ""),
        markdown(*dissection(metrics)),
    ]
    for error in ERRORS:
        parts += [
            f"## {error}: {_WORDS[error]}, {UNITS[error]}",
            "Medians.",
            markdown(*_error_table(metrics, error)),
        ]
        parts += [
            "Means ± deviations over the draws that could be measured.",
            markdown(*_error_table(metrics, error, spread=True)),
        ]
    return "\n\n".join(part for part in parts if part) + "\n"


def write_pair_report(path: str | Path, metrics: Mapping[str, Any]) -> None:
    """Write ``pair_report``'s text."""
    with atomic_write(path, "w") as handle:
        handle.write(pair_report(metrics))


def dissection(metrics: Mapping[str, Any]) -> tuple[list[str], Rows]:
    """Header and rows of tab:fundamental-dissection for ``weight``."""
    printed = of_paper(metrics, FUNDAMENTAL_DISSECTION)
    rows = []
    for pair in pair_order(metrics):
        numbers = metrics["selections"]["weight"]["pairs"][pair]
        cells = [
            _with_paper(error, numbers[part][error], printed.get(pair, {}).get(part, {}).get(error))
            for part in ALONE
            for error in ("E_2D", "E_3D")
        ]
        rows.append([pair, *cells])
    return ["pair", "R: E_2D, px", "R: E_3D, mm", "t: E_2D, px", "t: E_3D, mm"], rows


def _error_table(
    metrics: Mapping[str, Any], error: str, spread: bool = False
) -> tuple[list[str], Rows]:
    """Header and rows: an error of every name on every pair; a row is a name, or where there are
    many pairs, a pair.
    """
    order = pair_order(metrics)
    selections = metrics["selections"]

    def cell(name: str, pair: str) -> str:
        numbers = selections[name]["pairs"][pair]
        if not spread:
            return _short(_scaled(error, numbers[error]))
        mean, deviation = (
            _short(_scaled(error, numbers[key][error])) for key in ("mean", "deviation")
        )
        return f"{mean} ± {deviation}"

    if len(order) > MANY:
        return ["pair", *selections], [
            [pair, *(cell(name, pair) for name in selections)] for pair in order
        ]
    header = ["selection", *order] + ([] if spread else ["mean"])
    rows = [[NAMES.get(name, name), *(cell(name, pair) for pair in order)] for name in selections]
    if not spread:
        for row, name in zip(rows, selections, strict=True):
            row.append(_short(_scaled(error, selections[name][error])))
    return header, rows


def _worst_first(metrics: Mapping[str, Any], name: str) -> list[str]:
    """The paper's order; where there are many pairs, those with the largest E_3D first."""
    order = pair_order(metrics)
    pairs = metrics["selections"][name]["pairs"]
    return (
        order
        if len(order) <= MANY
        else sorted(order, key=lambda pair: -_or_infinite(pairs[pair]["E_3D"]))
    )


def _with_paper(error: str, value: float | None, paper: float | None) -> str:
    ours = _short(_scaled(error, value))
    return (
        ours if paper is None else f"{ours} ({_printed(1000 * paper if error == 'E_R' else paper)})"
    )


def _scaled(error: str, value: float | None) -> float | None:
    return None if value is None else 1000 * value if error == "E_R" else value


def _printed(value: float) -> str:
    """As the paper prints it: 0.72, 4.9, 10.8, 23."""
    return (
        f"{value:.2g}"
        if value < 1
        else f"{value:.1f}"
        if value % 1 or value < 10
        else f"{value:.0f}"
    )


def _or_infinite(value: float | None) -> float:
    return float("inf") if value is None else value


def _short(value: float | None) -> str:
    """At most five characters: 0.12, 1.23, 12.3, 123, 1e+05."""
    if value is None or value == float("inf"):
        return NONE
    digits = 2 if value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f}" if value < 99999.5 else f"{value:.0e}"
