"""A prediction's numbers in the terminal and in report.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from ghpt.commands.prediction.verdict import verdict_lines
from ghpt.models.relative_pose.scale import SEGMENTS
from ghpt.report.document import (
    Block,
    Bullets,
    Code,
    Document,
    Heading,
    Paragraph,
    Strong,
    Table,
    Text,
    prose,
)
from ghpt.report.tables import NAMES, NONE
from ghpt.report.terminal import print_document

Numbers = Mapping[str, Any]
"""The content of prediction.json, or a part of it."""


def summary_lines(numbers: Numbers) -> list[str]:
    """Return the sentences that hold for the recording as a whole."""
    lines = [f"Estimator: {numbers['estimator_text']}.", _coverage_line(numbers)]
    flipped = [f"{count} frames of {view}" for view, count in numbers["swapped"].items() if count]
    if flipped:
        lines.append(f"Left and right exchanged in {', '.join(flipped)}.")
    if numbers["stature_mm"]:
        lines.append(f"The person measures {numbers['stature_mm'] / 1000:.2f} m.")
    if numbers["smooth_hz"]:
        lines.append(f"Smoothed: zero-phase Butterworth, {numbers['smooth_hz']:g} Hz.")
    return lines


def _coverage_line(numbers: Numbers) -> str:
    """Return which shares of the joints are observed, filled and missing."""
    share = numbers["share"]
    line = (
        f"{numbers['frames']} frames, {len(numbers['cameras'])} views: "
        f"{100 * share['observed']:.1f} % of the joints observed"
    )
    if share["filled"]:
        line += f", {100 * share['filled']:.1f} % filled"
    missing = [
        f"{100 * part:.1f} % {state.replace('_', ' ')}"
        for state, part in share.items()
        if part and state not in ("observed", "filled")
    ]
    return f"{line}; missing: {', '.join(missing)}." if missing else f"{line}."


def error_table(numbers: Numbers, title: str = "") -> Table:
    """Return the reprojection and held-out errors of the estimator for each view."""
    own = next(iter(_estimators(numbers).values()))
    reprojection = own["reprojection"]
    held_out = own["held_out"]
    rows = []
    for view in numbers["cameras"]:
        errors = [*_quantiles(reprojection["views"][view]), *_quantiles(held_out["views"][view])]
        rows.append([view, *errors])
    rows.append(["all", *_quantiles(reprojection), *_quantiles(held_out)])
    return Table(["view", "reprojected px", "90 %", "held out px", "90 %"], rows, title)


def comparison_table(numbers: Numbers, title: str = "") -> Table:
    """Return the errors of each estimator."""
    header = ["estimator", "reproj. px", "90 %", "held out px", "90 %", "segm. %", "joints %"]
    rows = []
    for name, errors in _estimators(numbers).items():
        rows.append(
            [
                _display_name(name),
                *_quantiles(errors["reprojection"]),
                *_quantiles(errors["held_out"]),
                format_number(errors["segments"]["median"], 1, 100),
                format_number(errors["placed"], 1, 100),
            ]
        )
    return Table(header, rows, title)


def _estimators(numbers: Numbers) -> Mapping[str, Numbers]:
    return numbers["evaluation"]["estimators"]


def _display_name(estimator: str) -> str:
    return NAMES.get(estimator, estimator.replace("_", " "))


def summary_document(numbers: Numbers) -> Document:
    """Return the table of the views, that of several estimators, and what holds for all."""
    blocks: list[Block] = [error_table(numbers, f"Prediction of {numbers['data']}")]
    if len(_estimators(numbers)) > 1:
        blocks.append(comparison_table(numbers, "Estimators on the same key points"))
    blocks += [Paragraph(line) for line in summary_lines(numbers)]
    return Document("", blocks)


def print_prediction(numbers: Numbers, console: Console | None = None) -> None:
    """Print the summary."""
    print_document(summary_document(numbers), console)


def print_verdict(verdict: dict[str, Any], console: Console | None = None) -> None:
    """Print the last words in the terminal."""
    lines = [Paragraph(line) for line in verdict_lines(verdict)]
    print_document(Document("", lines), console)


def report_document(numbers: Numbers) -> Document:
    """Return the report of a prediction."""
    frames = numbers["evaluation"]["frames"]
    return Document(
        f"Prediction of {numbers['data']}",
        [
            Paragraph(_origin(numbers["provenance"])),
            Bullets(summary_lines(numbers)),
            Heading("Verdict"),
            *_verdict_blocks(numbers["verdict"]),
            Heading("Errors by view"),
            Paragraph(
                prose(
                    "On {} frames, evenly spread; median and 90 %, pixels. *Reprojection* is the "
                    "distance of every key point from its joint, set aside or not; *held out*, "
                    "from the joint that the other views alone give.",
                    str(frames),
                )
            ),
            error_table(numbers),
            Heading("Estimators"),
            Paragraph(
                prose(
                    "On the same key points; held-out views on the joints that all of them "
                    "estimate without the view. *Segm.*: the median over the body's parts of how "
                    "much their lengths vary over the frames; *joints*: those with a position."
                )
            ),
            comparison_table(numbers),
            Heading("Joints"),
            Paragraph("Frames in which each joint is observed, %."),
            _joint_table(numbers),
            Heading("Segments"),
            Paragraph(
                "Variation of their lengths over the frames, % (1.4826 x median deviation over "
                "median)."
            ),
            _segment_table(numbers),
        ],
    )


def _origin(provenance: Numbers) -> Text:
    commit = Code(provenance["commit"] or NONE)
    command = Code(provenance["command"])
    version = f"ghpt {provenance['ghpt']}, commit "
    return (version, commit, f", seed {provenance['seed']}: ", command, ".")


def _joint_table(numbers: Numbers) -> Table:
    rows = []
    for name, share in numbers["observed"].items():
        rows.append([name.replace("_", " "), format_number(share, 1, 100)])
    return Table(["joint", "observed"], rows)


def _segment_table(numbers: Numbers) -> Table:
    estimators = _estimators(numbers)
    rows = []
    for name in SEGMENTS:
        variations = [errors["segments"]["each"][name] for errors in estimators.values()]
        cells = [format_number(variation, 1, 100) for variation in variations]
        rows.append([name.replace("_", " "), *cells])
    return Table(["segment", *map(_display_name, estimators)], rows)


def _verdict_blocks(verdict: Numbers) -> list[Block]:
    blocks: list[Block] = [Paragraph(Strong(verdict["level"]))]
    findings = [_finding_text(finding) for finding in verdict["findings"]]
    if findings:
        blocks.append(Bullets(findings))
    if verdict["undecidable"]:
        blocks.append(Paragraph(f"Not decidable: {'; '.join(verdict['undecidable'])}."))
    return blocks


def _finding_text(finding: Numbers) -> Text:
    limit = ""
    if finding["limit"]:
        limit = f" ({finding['value']:.3g}, limit {finding['limit']:g})"
    code = Code(finding["code"])
    command = Code(finding["command"])
    return (f"{finding['level']}, ", code, f": {finding['text']}{limit}. Next: ", command)


def format_number(value: float | None, digits: int, factor: int = 1) -> str:
    """Return ``factor`` times the value, a dash for None."""
    return NONE if value is None else f"{factor * value:.{digits}f}"


def _quantiles(errors: Numbers) -> list[str]:
    return [format_number(errors["median"], 1), format_number(errors["p90"], 1)]
