"""A prediction's numbers in the terminal and in report.md."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from ghpt.commands.prediction.verdict import verdict_lines
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.report.escape import code, escaped, plain
from ghpt.report.tables import NAMES, NONE, markdown

Numbers = dict[str, Any]
Rows = list[list[str]]


def summary_lines(numbers: Numbers) -> list[str]:
    """What one sentence each says of the recording as a whole."""
    share = numbers["share"]
    missing = ", ".join(
        f"{100 * part:.1f} % {state.replace('_', ' ')}"
        for state, part in share.items()
        if part and state not in ("observed", "filled")
    )
    lines = [
        f"Estimator: {numbers['estimator_text']}.",
        f"{numbers['frames']} frames, {len(numbers['cameras'])} views: {100 * share['observed']:.1f} % of the joints "
        f"observed"
        + (f", {100 * share['filled']:.1f} % filled" if share["filled"] else "")
        + (f"; missing: {missing}." if missing else "."),
    ]
    flipped = {view: n for view, n in numbers["swapped"].items() if n}
    if flipped:
        lines.append(
            "Left and right exchanged in "
            + ", ".join(f"{n} frames of {v}" for v, n in flipped.items())
            + "."
        )
    if numbers["stature_mm"]:
        lines.append(f"The person measures {numbers['stature_mm'] / 1000:.2f} m.")
    if numbers["smooth_hz"]:
        lines.append(f"Smoothed: zero-phase Butterworth, {numbers['smooth_hz']:g} Hz.")
    return lines


def error_rows(numbers: Numbers) -> tuple[list[str], Rows]:
    """For each view the reprojection and held-out errors of the estimator."""
    own = next(iter(numbers["evaluation"]["estimators"].values()))
    header = ["view", "reprojected px", "90 %", "left out px", "90 %"]
    rows = [
        [view, *_pair(own["reprojection"]["views"][view]), *_pair(own["held_out"]["views"][view])]
        for view in numbers["cameras"]
    ]
    return header, [*rows, ["all", *_pair(own["reprojection"]), *_pair(own["held_out"])]]


def comparison_rows(numbers: Numbers) -> tuple[list[str], Rows]:
    """A row for each estimator."""
    header = ["estimator", "reproj. px", "90 %", "left out px", "90 %", "segm. %", "joints %"]
    rows = []
    for name, found in numbers["evaluation"]["estimators"].items():
        rows.append(
            [
                NAMES.get(name, name.replace("_", " ")),
                *_pair(found["reprojection"]),
                *_pair(found["held_out"]),
                number(found["segments"]["median"], 1, 100),
                number(found["placed"], 1, 100),
            ]
        )
    return header, rows


def print_prediction(numbers: Numbers, console: Console | None = None) -> None:
    """The table of the views, that of the estimators if there are several, and what holds for all."""
    console = console or Console()
    tables = [(f"Prediction of {numbers['data']}", *error_rows(numbers))]
    if len(numbers["evaluation"]["estimators"]) > 1:
        tables.append(("Estimators on the same key points", *comparison_rows(numbers)))
    for title, header, rows in tables:
        table = Table(title=plain(title, "table.title"), title_justify="left")
        for i, column in enumerate(header):
            table.add_column(column, justify="right" if i else "left")
        for row in rows:
            table.add_row(*map(plain, row))
        console.print(table)
    for line in summary_lines(numbers):
        console.print(plain(line), soft_wrap=True)


def print_verdict(verdict: Numbers, console: Console | None = None) -> None:
    """The last words in the terminal."""
    console = console or Console()
    for line in verdict_lines(verdict):
        console.print(plain(line), soft_wrap=True)


def prediction_report(numbers: Numbers) -> str:
    """The Markdown report."""
    evaluation = numbers["evaluation"]
    origin = numbers["provenance"]
    observed = [
        [name.replace("_", " "), number(share, 1, 100)]
        for name, share in numbers["observed"].items()
    ]
    estimators = evaluation["estimators"]
    segments = [
        [
            name.replace("_", " "),
            *(number(found["segments"]["each"][name], 1, 100) for found in estimators.values()),
        ]
        for name in BONE_NAMES
    ]
    parts = [
        f"# Prediction of {escaped(numbers['data'])}",
        f"ghpt {origin['ghpt']}, commit `{origin['commit'] or NONE}`, seed {origin['seed']}: "
        f"{code(origin['command'])}.",
        "\n".join(f"- {escaped(line)}" for line in summary_lines(numbers)),
        "## Verdict",
        *_verdict(numbers["verdict"]),
        "## Errors by view",
        f"On {evaluation['frames']} frames, evenly spread; median and 90 %, pixels. *Reprojection* is the distance of "
        "every key point from its joint, set aside or not; *left out*, from the joint that "
        "the other views alone give.",
        markdown(*error_rows(numbers)),
        "## Estimators",
        "On the same key points; left-out views on the joints that all of them estimate without the view. *Segm.*: the "
        "median over the body's parts of how much their lengths vary over the frames; *joints*: those with a position.",
        markdown(*comparison_rows(numbers)),
        "## Joints",
        "Frames in which each joint is observed, %.",
        markdown(["joint", "observed"], observed),
        "## Segments",
        "Variation of their lengths over the frames, % (1.4826 x median deviation over median).",
        markdown(["segment", *(NAMES.get(n, n.replace("_", " ")) for n in estimators)], segments),
    ]
    return "\n\n".join(parts) + "\n"


def _verdict(verdict: Numbers) -> list[str]:
    """Paragraphs of the report."""
    parts = [f"**{verdict['level']}**"]
    for finding in verdict["findings"]:
        against = (
            f" ({finding['value']:.3g}, limit {finding['limit']:g})" if finding["limit"] else ""
        )
        parts.append(
            f"- {finding['level']}, `{finding['code']}`: {escaped(finding['text'])}{against}.\n"
            f"  Next: {code(finding['command'])}"
        )
    if verdict["undecidable"]:
        parts.append(f"Not decidable: {escaped('; '.join(verdict['undecidable']))}.")
    return parts


def number(value: float | None, digits: int, factor: int = 1) -> str:
    return NONE if value is None else f"{factor * value:.{digits}f}"


def _pair(found: Numbers) -> list[str]:
    return [number(found["median"], 1), number(found["p90"], 1)]
