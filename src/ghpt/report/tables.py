"""What a test run of the pose problem reports: in the terminal, and in report.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.paper.published import QUANTITATIVE, QUANTITATIVE_MEAN, paper_value
from ghpt.report.document import (
    Block,
    Code,
    Document,
    Heading,
    Paragraph,
    Span,
    Strong,
    Table,
    Text,
)
from ghpt.skeleton import SYMMETRIC_BONES

NAMES = {
    "h36m": "Human3.6M",
    "panoptic": "Panoptic",
    **{f"cmu{i}": f"Panoptic CMU{i}" for i in range(1, 5)},
    "trajectory": "trajectory",
    "online": "trajectory, online",
    "frame_learned": "learned frames",
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
_TERMINAL = ("selection", "abs", "rel", "PA", "6 j", "cov %", "paper", "diff %")
"""The columns in the terminal."""
_CAPTION = (
    "abs: in the world; rel: relative to the pelvis; PA: Procrustes-aligned",
    "6 j: rel, elbows wrists knees; cov: joints estimated; diff: rel to paper",
)
_MEANS = ("mpjpe_absolute", "mpjpe_relative", "mpjpe_aligned", "mpjpe_6_joints")
_PER_ACTION = ("weight", "average", "best", "frame_learned", "linear", "ransac")
_BOLD = ("weight", "frame_learned")

Metrics = Mapping[str, Any]
"""The content of metrics.json."""


def display_name(data: str | None, source: str | None) -> str:
    """Return the name of a run's data in words that tell synthetic from real, for every heading."""
    name = NAMES.get(str(data), str(data))
    return f"synthetic {name}" if source == "synthetic" else f"{name} from {source}"


def training_data(metrics: Metrics) -> tuple[str | None, str | None]:
    """Return name and source of the training data, from the checkpoint's provenance."""
    provenance = metrics.get("provenance") or {}
    training = provenance.get("training") or {}
    return training.get("data"), training.get("source")


def title(metrics: Metrics) -> str:
    """Return what a run was tested and trained on, in words."""
    tested = f"{display_name(metrics['data'], metrics['source'])}, {metrics['split']} split"
    trained, source = training_data(metrics)
    return f"{tested}, trained on {display_name(trained, source)}" if trained else tested


def main_rows(metrics: Metrics) -> list[list[str]]:
    """Return a row of ``COLUMNS`` for each selection and baseline.

    It has the paper's number where the paper has one for this test.
    """
    return [_main_row(metrics, name) for name in metrics["selections"]]


def _main_row(metrics: Metrics, name: str) -> list[str]:
    numbers = metrics["selections"][name]
    paper = None
    if metrics["split"] == "test":
        trained, _ = training_data(metrics)
        paper = paper_value(metrics["data"], name, trained)
    return [
        NAMES.get(name, name),
        *(_mm(numbers[mean]) for mean in _MEANS),
        _percent(numbers["coverage"]),
        _mm(paper),
        _difference(numbers["mpjpe_relative"], paper),
    ]


def _difference(ours: float | None, paper: float | None) -> str:
    if ours is None or paper is None:
        return NONE
    return f"{100 * (ours / paper - 1):+.1f} %"


def summary_document(metrics: Metrics) -> Document:
    """Return the main table, for the terminal, in 80 columns."""
    names = list(metrics["selections"])
    rows: list[list[Text]] = []
    for name, row in zip(names, main_rows(metrics), strict=True):
        cells = [cell.removesuffix(" %") for cell in row]
        rows.append([Strong(cell) for cell in cells] if name in _BOLD else list(cells))
    selections = [name for name in names if name in AGGREGATIONS]
    table = Table(
        _TERMINAL,
        rows,
        title=f"MPJPE in mm on {title(metrics)}",
        caption=_CAPTION,
        last_rows=[names.index(selections[-1])] if selections else [],
    )
    return Document("", [table])


def report_document(metrics: Metrics) -> Document:
    """Return the report of a test run."""
    about = (
        "MPJPE in mm: in the world, relative to the pelvis, after Procrustes alignment, and "
        "(relative) on elbows, wrists and knees. Coverage: joints that were estimated, of all that "
        "have a truth. Best and worst look at the truth."
    )
    blocks: list[Block] = [
        Paragraph(_origin(metrics)),
        Paragraph(about),
        Table(COLUMNS, main_rows(metrics)),
        *_paper_note(metrics),
        *_without_damaged(metrics),
        Heading("Actions"),
        Paragraph("Relative MPJPE, mm."),
        action_table(metrics),
        Heading("Pose prior"),
        Paragraph("Variance over frames of the ratio of left to right part, times 1000."),
    ]
    for subject in _first_selection(metrics)["pose_prior"]:
        blocks += [Heading(subject, 3), prior_table(metrics, subject)]
    return Document(f"Test on {title(metrics)}", blocks)


def origin_text(metrics: Metrics) -> tuple[Span, ...]:
    """Return the checkpoint and the version that made a run's numbers."""
    provenance = metrics.get("provenance") or {}
    checkpoint = Code(provenance.get("checkpoint", NONE))
    commit = Code(provenance.get("commit") or NONE)
    version = provenance.get("ghpt", NONE)
    return ("checkpoint ", checkpoint, f", ghpt {version}, commit ", commit, ".")


def _origin(metrics: Metrics) -> Text:
    return (f"{metrics['frames']} frames, seed {metrics['seed']}, ", *origin_text(metrics))


def _first_selection(metrics: Metrics) -> Mapping[str, Any]:
    return next(iter(metrics["selections"].values()))


def _without_damaged(metrics: Metrics) -> list[Block]:
    rows = []
    for name, numbers in metrics["selections"].items():
        if "without_damaged" in numbers:
            means = [_mm(numbers["without_damaged"][mean]) for mean in _MEANS]
            rows.append([NAMES.get(name, name), *means])
    heading = Heading("Without S9's takes with damaged ground truth")
    return [heading, Table(COLUMNS[:5], rows)] if rows else []


def action_table(metrics: Metrics) -> Table:
    """Return the relative MPJPE of each action under the main selections.

    The last column is the paper's for ``weight``, where it has one.
    """
    selections = metrics["selections"]
    names = [name for name in _PER_ACTION if name in selections]
    trained, _ = training_data(metrics)
    of_paper = (trained, metrics["data"], metrics["split"]) == ("h36m", "h36m", "test")
    paper = QUANTITATIVE if of_paper else {}
    rows = []
    for action in _first_selection(metrics)["per_action"]:
        errors = [_mm(selections[name]["per_action"][action]) for name in names]
        rows.append([action, *errors, _mm(paper.get(action))])
    means = [_mm(selections[name]["mpjpe_relative"]) for name in names]
    rows.append(["all", *means, _mm(QUANTITATIVE_MEAN if of_paper else None)])
    columns = [NAMES.get(name, name) for name in names]
    return Table(["action", *columns, "paper (weight)"], rows)


def prior_table(metrics: Metrics, subject: str) -> Table:
    """Return 1000 S² of a subject's six parts under each selection."""
    selections = [name for name in metrics["selections"] if name in AGGREGATIONS]
    priors = [metrics["selections"][name]["pose_prior"][subject] for name in selections]
    rows = []
    for part in SYMMETRIC_BONES:
        rows.append([part.replace("_", " "), *(_thousandfold(prior[part]) for prior in priors)])
    return Table(["part", *selections], rows)


def _thousandfold(value: float | None) -> str:
    """Return 1000 times the value with three digits."""
    if value is None:
        return NONE
    return f"{1000 * value:.0f}" if 1000 * value >= 100 else f"{1000 * value:.3g}"


def max_difference(values: Iterable[float]) -> float:
    """Return (largest - smallest) / smallest in percent, as the paper's last column is defined."""
    values = list(values)
    return 100 * (max(values) / min(values) - 1)


def _paper_note(metrics: Metrics) -> list[Block]:
    paper_column = COLUMNS.index("paper")
    if all(row[paper_column] == NONE for row in main_rows(metrics)):
        return []
    note = (
        "Paper: relative MPJPE on the real data set, tab:quantitative-hypotheses and "
        "tab:generalization-evaluation. Its RANSAC is quoted from Iskakov et al., on their own "
        "detections."
    )
    if metrics["source"] == "synthetic":
        ransac = " and RANSAC" if metrics["data"] == "h36m" else ""
        note += (
            " These data are synthetic: their detector model was fitted to the paper's random, "
            f"average, best, worst{ransac} here, and to no row of a trained scorer."
        )
    return [Paragraph(note)]


def _mm(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return NONE if value is None else f"{100 * value:.2f} %"
