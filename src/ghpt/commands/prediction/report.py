"""A prediction's numbers in the terminal and in report.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ghpt.calibration.comparison import Quantiles
from ghpt.commands.prediction.result import PredictionResult
from ghpt.commands.prediction.statistics import EstimatorErrors
from ghpt.commands.prediction.verdict import Level, verdict_lines
from ghpt.report.document import (
    Block,
    Bullets,
    Code,
    Document,
    Heading,
    Notice,
    Paragraph,
    Strong,
    Table,
    Text,
    Tone,
    prose,
)
from ghpt.report.tables import NAMES, NONE


def summary_lines(result: PredictionResult) -> list[str]:
    """Return the sentences that hold for the recording as a whole."""
    coverage = result.coverage
    lines = [f"Estimator: {result.estimator_text}.", _coverage_line(result)]
    flipped = [f"{count} frames of {view}" for view, count in coverage.swapped.items() if count]
    if flipped:
        lines.append(f"Left and right exchanged in {', '.join(flipped)}.")
    if coverage.stature_mm:
        lines.append(f"The person measures {coverage.stature_mm / 1000:.2f} m.")
    shares = result.evaluation.ellipsoids
    if shares:
        held = ", ".join(f"{100 * share:.0f}" for share in shares)
        lines.append(
            "Two halves of the views, each on its own, differ as the covariances say: the "
            f"ellipsoids of 50, 90 and 95 % hold {held} % of the differences."
        )
    if result.smooth_hz:
        lines.append(f"Smoothed: zero-phase Butterworth, {result.smooth_hz:g} Hz.")
    return lines


def _coverage_line(result: PredictionResult) -> str:
    """Return which shares of the joints are observed, supported, filled and missing."""
    missing = dict(result.coverage.share)
    observed = missing.pop("observed")
    filled = missing.pop("filled")
    supported = missing.pop("supported")
    line = (
        f"{result.coverage.frames} frames, {len(result.cameras)} views: "
        f"{100 * observed:.1f} % of the joints observed"
    )
    if supported >= 0.0005:
        line += f", {100 * supported:.1f} % supported by one view"
    if filled:
        line += f", {100 * filled:.1f} % filled"
    shares = [
        f"{100 * share:.1f} % {state.replace('_', ' ')}"
        for state, share in missing.items()
        if share
    ]
    return f"{line}; missing: {', '.join(shares)}." if shares else f"{line}."


def error_table(result: PredictionResult, title: str = "") -> Table:
    """Return the reprojection and held-out errors of the estimator for each view."""
    own = next(iter(_estimators(result).values()))
    rows = []
    for view in result.cameras:
        reprojection = _quantiles(own.reprojection.views[view])
        rows.append([view, *reprojection, *_quantiles(own.held_out.views[view])])
    rows.append(["all", *_quantiles(own.reprojection), *_quantiles(own.held_out)])
    return Table(["view", "reprojected px", "90 %", "held out px", "90 %"], rows, title)


def comparison_table(result: PredictionResult, title: str = "") -> Table:
    """Return the errors of each estimator."""
    header = ["estimator", "reproj. px", "90 %", "held out px", "90 %", "segm. %", "joints %"]
    rows = []
    for name, errors in _estimators(result).items():
        rows.append(
            [
                _display_name(name),
                *_quantiles(errors.reprojection),
                *_quantiles(errors.held_out),
                format_number(errors.segments.median, 1, 100),
                format_number(errors.placed, 1, 100),
            ]
        )
    return Table(header, rows, title)


def _estimators(result: PredictionResult) -> Mapping[str, EstimatorErrors]:
    return result.evaluation.estimators


def _display_name(estimator: str) -> str:
    return NAMES.get(estimator, estimator.replace("_", " "))


def summary_document(result: PredictionResult) -> Document:
    """Return the table of the views, that of several estimators, and what holds for all."""
    blocks: list[Block] = [error_table(result, f"Prediction of {result.data}")]
    if len(_estimators(result)) > 1:
        blocks.append(comparison_table(result, "Estimators on the same key points"))
    blocks += [Paragraph(line) for line in summary_lines(result)]
    return Document("", blocks)


def verdict_document(result: PredictionResult, page: str) -> Document:
    """Return the last words in the terminal. ``page``: the path of report.html."""
    if result.verdict is None:
        return Document("", [])
    lines = [*verdict_lines(result.verdict.numbers()), f"Look at {page} in a browser."]
    return Document("", [Paragraph(line) for line in lines])


def report_document(result: PredictionResult, pictures: Sequence[Block] = ()) -> Document:
    """Return the report of a prediction, with the pictures below the verdict."""
    frames = result.evaluation.frames
    return Document(
        f"Prediction of {result.data}",
        [
            *_verdict_blocks(result),
            Bullets(summary_lines(result)),
            *_people_blocks(result),
            *pictures,
            Heading("View by view"),
            Paragraph(
                prose(
                    "On {} frames, evenly spread; median and 90 %, pixels. *Reprojection* is the "
                    "distance of every key point from its joint, set aside or not; *held out*, "
                    "from the joint that the other views alone give.",
                    str(frames),
                )
            ),
            _view_table(result),
            Heading("Estimators"),
            Paragraph(
                prose(
                    "On the same key points; held-out views on the joints that all of them "
                    "estimate without the view. *Segm.*: the median over the body's parts of how "
                    "much their lengths vary over the frames; *joints*: those with a position."
                )
            ),
            comparison_table(result),
            Heading("Joints"),
            Paragraph("Frames in which each joint is observed, %."),
            _joint_table(result),
            Heading("Segments"),
            Paragraph(
                "Variation of their lengths over the frames, % (1.4826 x median deviation over "
                "median)."
            ),
            _segment_table(result),
            Heading("How this was made"),
            Paragraph(_origin(result.provenance)),
        ],
    )


def _view_table(result: PredictionResult) -> Table:
    """Return the errors of each view, and what is off in it."""
    table = error_table(result)
    rows = [[*row, _remark(result, str(row[0]))] for row in table.rows]
    return replace(table, header=[*table.header, "what is off"], rows=rows, left_columns=(0, 5))


def _remark(result: PredictionResult, view: str) -> Text:
    """Return what is off in a view."""
    found = result.verdict.findings if result.verdict else ()
    remarks = [finding.text for finding in found if view in finding.cameras]
    flipped = result.coverage.swapped.get(view, 0)
    if flipped:
        remarks.append(f"left and right exchanged in {flipped} frames, undone")
    return "; ".join(remarks)


def _people_blocks(result: PredictionResult) -> list[Block]:
    """Return the table of several people, of whom this report is the first one's."""
    if not result.people:
        return []
    rows: list[list[Text]] = []
    for number, person in enumerate(result.people):
        stature = None if person.stature_mm is None else person.stature_mm / 1000
        folder = Code(f"person_{number}") if number else "this one"
        observed = format_number(person.observed, 1, 100)
        rows.append([str(number), folder, observed, format_number(stature, 2), person.verdict])
    header = ["person", "folder", "joints %", "height m", "verdict"]
    return [Heading("People"), Table(header, rows)]


def _origin(provenance: Mapping[str, Any]) -> Text:
    commit = Code(provenance["commit"] or NONE)
    command = Code(provenance["command"])
    version = f"ghpt {provenance['ghpt']}, commit "
    return (version, commit, f", seed {provenance['seed']}: ", command, ".")


def _joint_table(result: PredictionResult) -> Table:
    rows = []
    for name, share in result.coverage.observed.items():
        rows.append([name.replace("_", " "), format_number(share, 1, 100)])
    return Table(["joint", "observed"], rows)


def _segment_table(result: PredictionResult) -> Table:
    estimators = _estimators(result)
    rows = []
    for name in next(iter(estimators.values())).segments.each:
        variations = [errors.segments.each[name] for errors in estimators.values()]
        cells = [format_number(variation, 1, 100) for variation in variations]
        rows.append([name.replace("_", " "), *cells])
    return Table(["segment", *map(_display_name, estimators)], rows)


_TONES = {Level.GOOD: Tone.GOOD, Level.LOOK: Tone.LOOK, Level.DO_NOT_USE: Tone.BAD}


def _verdict_blocks(result: PredictionResult) -> list[Block]:
    if result.verdict is None:
        return []
    verdict = result.verdict.numbers()
    level = Strong(verdict["level"])
    blocks: list[Block] = [Notice(("Verdict: ", level, "."), _TONES[result.verdict.level])]
    findings = [_finding_text(finding) for finding in verdict["findings"]]
    if findings:
        blocks.append(Bullets(findings))
    if verdict["undecidable"]:
        blocks.append(Paragraph(f"Not decidable: {'; '.join(verdict['undecidable'])}."))
    return blocks


def _finding_text(finding: Mapping[str, Any]) -> Text:
    limit = ""
    if finding["limit"]:
        limit = f" ({finding['value']:.3g}, limit {finding['limit']:g})"
    code = Code(finding["code"])
    command = Code(finding["command"])
    return (f"{finding['level']}, ", code, f": {finding['text']}{limit}. Next: ", command)


def format_number(value: float | None, digits: int, factor: int = 1) -> str:
    """Return ``factor`` times the value, a dash for None."""
    return NONE if value is None else f"{factor * value:.{digits}f}"


def _quantiles(errors: Quantiles) -> list[str]:
    return [format_number(errors.median, 1), format_number(errors.p90, 1)]
