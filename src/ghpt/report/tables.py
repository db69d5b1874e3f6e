"""Tables of a test run: report.md and the one in the terminal."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ghpt.files import atomic_write
from ghpt.metrics.pose_prior import PARTS
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.paper.published import QUANTITATIVE, QUANTITATIVE_MEAN, paper_value
from ghpt.report.escape import code, escaped, plain

NAMES = {
    "h36m": "Human3.6M",
    "panoptic": "Panoptic",
    **{f"cmu{i}": f"Panoptic CMU{i}" for i in range(1, 5)},
    "view_weights": "view weights",
    "weighted_linear": "weighted linear",
    "ransac": "RANSAC",
    "adaptive_ransac": "adaptive RANSAC",
    "m_estimator": "M-estimator",
    "lo_ransac": "LO-RANSAC",
}
"""What people call a data set or a row, where it is not its name in metrics.json."""

NONE = "–"
COLUMNS = (
    "selection",
    "absolute",
    "relative",
    "aligned",
    "6 joints",
    "coverage",
    "paper",
    "difference",
)
_TERMINAL = dict(
    zip(COLUMNS, ("selection", "abs", "rel", "PA", "6 j", "cov %", "paper", "diff %"), strict=True)
)
_CAPTION = """abs: in the world; rel: relative to the pelvis; PA: Procrustes-aligned
6 j: rel, elbows wrists knees; cov: joints estimated; diff: rel to paper"""
_MEANS = ("mpjpe_absolute", "mpjpe_relative", "mpjpe_aligned", "mpjpe_6_joints")
_PER_ACTION = ("weight", "average", "best", "view_weights", "linear", "ransac")

Rows = list[list[str]]


def display_name(data: str | None, source: str | None) -> str:
    """The data of a run in words that tell synthetic from real: every heading goes through here."""
    name = NAMES.get(str(data), str(data))
    return f"synthetic {name}" if source == "synthetic" else f"{name} from {source}"


def trained_on(metrics: Mapping[str, Any]) -> tuple[str | None, str | None]:
    """Name and source of the training data, from the checkpoint's provenance."""
    training = (metrics.get("provenance") or {}).get("training") or {}
    return training.get("data"), training.get("source")


def title(metrics: Mapping[str, Any]) -> str:
    trained, source = trained_on(metrics)
    training = f", trained on {display_name(trained, source)}" if trained else ""
    return f"{display_name(metrics['data'], metrics['source'])}, {metrics['split']} split{training}"


def main_rows(metrics: Mapping[str, Any]) -> Rows:
    """A row of ``COLUMNS`` for each selection and baseline; the paper's number where it has one for
    this test.
    """
    rows = []
    (trained, _) = trained_on(metrics)
    for name, numbers in metrics["selections"].items():
        paper = paper_value(metrics["data"], name, trained) if metrics["split"] == "test" else None
        ours = numbers["mpjpe_relative"]
        rows.append(
            [
                NAMES.get(name, name),
                *(_mm(numbers[mean]) for mean in _MEANS),
                _percent(numbers["coverage"]),
                _mm(paper),
                NONE if None in (paper, ours) else f"{100 * (ours / paper - 1):+.1f} %",
            ]
        )
    return rows


def print_table(metrics: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the main table to the terminal (or to ``console``), in 80 columns."""
    table = Table(
        title=plain(f"MPJPE in mm on {title(metrics)}", "table.title"),
        caption=_CAPTION,
        title_justify="left",
        caption_justify="left",
    )
    for column, short in _TERMINAL.items():
        table.add_column(short, justify="left" if column == COLUMNS[0] else "right", no_wrap=True)
    for name, row in zip(metrics["selections"], main_rows(metrics), strict=True):
        cells = [cell.removesuffix(" %") for cell in row]
        style = "bold" if name in ("weight", "view_weights") else None
        table.add_row(*map(plain, cells), end_section=name == AGGREGATIONS[-1], style=style)
    (console or Console()).print(table)


def report(metrics: Mapping[str, Any]) -> str:
    """The Markdown report of a test run."""
    selections = metrics["selections"]
    provenance = metrics.get("provenance") or {}
    parts = [
        f"# Test on {escaped(title(metrics))}",
        f"{metrics['frames']} frames, seed {metrics['seed']}, "
        f"checkpoint {code(provenance.get('checkpoint', NONE))}, "
        f"ghpt {provenance.get('ghpt', NONE)}, commit `{provenance.get('commit') or NONE}`.",
        "MPJPE in mm: in the world, relative to the pelvis, after Procrustes alignment, and (relative) on elbows, "
        "wrists and knees. Coverage: joints that were estimated, of all that have a truth. Best and worst look at "
        "the truth.",
        markdown(COLUMNS, main_rows(metrics)),
        _about_the_paper(metrics),
    ]
    if any("without_damaged" in numbers for numbers in selections.values()):
        parts += [
            "## Without S9's takes with damaged ground truth",
            markdown(
                COLUMNS[:5],
                (
                    [NAMES.get(name, name), *(_mm(numbers["without_damaged"][m]) for m in _MEANS)]
                    for name, numbers in selections.items()
                ),
            ),
        ]
    parts += ["## Actions", "Relative MPJPE, mm.", markdown(*action_table(metrics))]
    parts += [
        "## Pose prior",
        "Variance over frames of the ratio of left to right part, times 1000.",
    ]
    for subject in next(iter(selections.values()))["pose_prior"]:
        parts += [f"### {escaped(subject)}", markdown(*prior_table(metrics, subject))]
    return "\n\n".join(part for part in parts if part) + "\n"


def write_report(path: str | Path, metrics: Mapping[str, Any]) -> None:
    """Write ``report``'s text."""
    with atomic_write(path, "w") as handle:
        handle.write(report(metrics))


def action_table(metrics: Mapping[str, Any]) -> tuple[list[str], Rows]:
    """Header and rows: relative MPJPE of an action under the main selections, and the paper's for
    ``weight``.
    """
    selections = metrics["selections"]
    names = [name for name in _PER_ACTION if name in selections]
    trained, _ = trained_on(metrics)
    paper = (
        QUANTITATIVE
        if (trained, metrics["data"], metrics["split"]) == ("h36m", "h36m", "test")
        else {}
    )
    rows = [
        [
            action,
            *(_mm(selections[name]["per_action"][action]) for name in names),
            _mm(paper.get(action)),
        ]
        for action in next(iter(selections.values()))["per_action"]
    ]
    mean = _mm(QUANTITATIVE_MEAN if paper else None)
    rows.append(["all", *(_mm(selections[name]["mpjpe_relative"]) for name in names), mean])
    return ["action", *(NAMES.get(name, name) for name in names), "paper (weight)"], rows


def prior_table(metrics: Mapping[str, Any], subject: str) -> tuple[list[str], Rows]:
    """Header and rows: 1000 S^2 of a subject's six parts under each selection."""
    selections = {
        name: numbers for name, numbers in metrics["selections"].items() if name in AGGREGATIONS
    }
    rows = []
    for part in PARTS:
        values = [numbers["pose_prior"][subject][part] for numbers in selections.values()]
        rows.append(
            [
                part.replace("_", " "),
                *(NONE if v is None else _three_digits(1000 * v) for v in values),
            ]
        )
    return ["part", *selections], rows


def _three_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def max_difference(values: Iterable[float]) -> float:
    """(largest - smallest) / smallest, percent: the definition that gives the paper's last column."""
    values = list(values)
    return 100 * (max(values) / min(values) - 1)


def markdown(
    header: Sequence[str], rows: Iterable[Sequence[str]], text: Collection[int] = (0,)
) -> str:
    """A Markdown table, also aligned as plain text; the columns ``text`` to the left, numbers to
    the right.

    Cells are escaped, unless they are ``Markdown`` already.
    """
    table = [list(map(escaped, row)) for row in (header, *rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    lines = [
        " | ".join(
            cell.ljust(w) if i in text else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in table
    ]
    rule = "|".join(
        ("-" * (w + 2)) if i in text else "-" * (w + 1) + ":" for i, w in enumerate(widths)
    )
    return "\n".join([f"| {lines[0]} |", f"|{rule}|", *(f"| {line} |" for line in lines[1:])])


def _about_the_paper(metrics: Mapping[str, Any]) -> str:
    if all(row[-2] == NONE for row in main_rows(metrics)):
        return ""
    note = (
        "Paper: relative MPJPE on the real data set, tab:quantitative-hypotheses and tab:generalization-evaluation. "
        "Its RANSAC is quoted from Iskakov et al., on their own detections."
    )
    if metrics["source"] == "synthetic":
        fitted = "random, average, best, worst" + (
            " and RANSAC" if metrics["data"] == "h36m" else ""
        )
        note += (
            f" These data are synthetic: their detector model was fitted to the paper's {fitted} here,"
            " and to no row of a trained scorer."
        )
    return note


def _mm(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return NONE if value is None else f"{100 * value:.2f} %"
