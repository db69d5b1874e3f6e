"""What a test run of the pose problem reports: in the terminal, and in report.md."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.measured import Measured, Number, TestRun
from ghpt.models.pose.numbers import PoseMeans, PoseNumbers
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
    "pose2sim": "Pose2Sim's exclusion",
    "aniposelib_robust": "aniposelib, robust",
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
_PER_ACTION = ("weight", "average", "best", "frame_learned", "linear", "ransac")
_BOLD = ("weight", "frame_learned")

PosesMeasured = Measured[PoseNumbers]


def display_name(data: str | None, source: str | None) -> str:
    """Return the name of a run's data in words that tell synthetic from real, for every heading."""
    name = NAMES.get(str(data), str(data))
    return f"synthetic {name}" if source == "synthetic" else f"{name} from {source}"


def title(run: TestRun) -> str:
    """Return what a run was tested and trained on, in words."""
    tested = f"{display_name(run.data, run.source)}, {run.split} split"
    trained, source = run.training
    return f"{tested}, trained on {display_name(trained, source)}" if trained else tested


def main_rows(measured: PosesMeasured) -> list[list[str]]:
    """Return a row of ``COLUMNS`` for each selection and baseline.

    It has the paper's number where the paper has one for this test.
    """
    return [_main_row(measured.run, name, numbers) for name, numbers in measured.selections.items()]


def _main_row(run: TestRun, name: str, numbers: PoseNumbers) -> list[str]:
    paper = None
    if run.data is not None and run.split == "test":
        trained, _ = run.training
        paper = paper_value(run.data, name, trained)
    return [
        NAMES.get(name, name),
        *_mean_cells(numbers.means),
        _percent(numbers.coverage),
        _mm(paper),
        _difference(numbers.means.relative, paper),
    ]


def _mean_cells(means: PoseMeans) -> list[str]:
    return [_mm(mean) for mean in (means.absolute, means.relative, means.aligned, means.six_joints)]


def _difference(ours: Number, paper: Number) -> str:
    if ours is None or paper is None:
        return NONE
    return f"{100 * (ours / paper - 1):+.1f} %"


def summary_document(measured: PosesMeasured) -> Document:
    """Return the main table, for the terminal, in 80 columns."""
    names = list(measured.selections)
    rows: list[list[Text]] = []
    for name, row in zip(names, main_rows(measured), strict=True):
        cells = [cell.removesuffix(" %") for cell in row]
        rows.append([Strong(cell) for cell in cells] if name in _BOLD else list(cells))
    selections = [name for name in names if name in AGGREGATIONS]
    table = Table(
        _TERMINAL,
        rows,
        title=f"MPJPE in mm on {title(measured.run)}",
        caption=_CAPTION,
        last_rows=[names.index(selections[-1])] if selections else [],
    )
    return Document("", [table])


def report_document(measured: PosesMeasured) -> Document:
    """Return the report of a test run."""
    about = (
        "MPJPE in mm: in the world, relative to the pelvis, after Procrustes alignment, and "
        "(relative) on elbows, wrists and knees. Coverage: joints that were estimated, of all that "
        "have a truth. Best and worst look at the truth."
    )
    blocks: list[Block] = [
        Paragraph(_origin(measured.run)),
        Paragraph(about),
        Table(COLUMNS, main_rows(measured)),
        *_paper_note(measured),
        *_without_damaged(measured),
        Heading("Actions"),
        Paragraph("Relative MPJPE, mm."),
        action_table(measured),
        Heading("Pose prior"),
        Paragraph("Variance over frames of the ratio of left to right part, times 1000."),
    ]
    for subject in _first_selection(measured).pose_prior:
        blocks += [Heading(subject, 3), prior_table(pose_priors(measured, subject))]
    return Document(f"Test on {title(measured.run)}", blocks)


def origin_text(run: TestRun) -> tuple[Span, ...]:
    """Return the checkpoint and the version that made a run's numbers."""
    provenance = run.provenance
    checkpoint = Code(provenance.get("checkpoint", NONE))
    commit = Code(provenance.get("commit") or NONE)
    version = provenance.get("ghpt", NONE)
    return ("checkpoint ", checkpoint, f", ghpt {version}, commit ", commit, ".")


def _origin(run: TestRun) -> Text:
    return (f"{run.frames} frames, seed {run.seed}, ", *origin_text(run))


def _first_selection(measured: PosesMeasured) -> PoseNumbers:
    return next(iter(measured.selections.values()))


def _without_damaged(measured: PosesMeasured) -> list[Block]:
    rows = []
    for name, numbers in measured.selections.items():
        if numbers.without_damaged is not None:
            rows.append([NAMES.get(name, name), *_mean_cells(numbers.without_damaged)])
    heading = Heading("Without S9's takes with damaged ground truth")
    return [heading, Table(COLUMNS[:5], rows)] if rows else []


def action_table(measured: PosesMeasured) -> Table:
    """Return the relative MPJPE of each action under the main selections.

    The last column is the paper's for ``weight``, where it has one.
    """
    shown = {name: measured.selections[name] for name in _PER_ACTION if name in measured.selections}
    run = measured.run
    trained, _ = run.training
    of_paper = (trained, run.data, run.split) == ("h36m", "h36m", "test")
    paper = QUANTITATIVE if of_paper else {}
    rows = []
    for action in _first_selection(measured).per_action:
        errors = [_mm(numbers.per_action[action]) for numbers in shown.values()]
        rows.append([action, *errors, _mm(paper.get(action))])
    means = [_mm(numbers.means.relative) for numbers in shown.values()]
    rows.append(["all", *means, _mm(QUANTITATIVE_MEAN if of_paper else None)])
    columns = [NAMES.get(name, name) for name in shown]
    return Table(["action", *columns, "paper (weight)"], rows)


PosePriors = Mapping[str, Mapping[str, Number]]
"""S² of a subject by selection and part."""


def pose_priors(measured: PosesMeasured, subject: str) -> PosePriors:
    """Return the pose priors of a subject under each selection."""
    return {
        name: numbers.pose_prior[subject]
        for name, numbers in measured.selections.items()
        if name in AGGREGATIONS
    }


def prior_table(priors: PosePriors) -> Table:
    """Return 1000 S² of the six parts under each selection."""
    rows = []
    for part in SYMMETRIC_BONES:
        cells = [_thousandfold(prior[part]) for prior in priors.values()]
        rows.append([part.replace("_", " "), *cells])
    return Table(["part", *priors], rows)


def _thousandfold(value: Number) -> str:
    """Return 1000 times the value with three digits."""
    if value is None:
        return NONE
    return f"{1000 * value:.0f}" if 1000 * value >= 100 else f"{1000 * value:.3g}"


def max_difference(values: Iterable[float]) -> float:
    """Return (largest - smallest) / smallest in percent, as the paper's last column is defined."""
    values = list(values)
    return 100 * (max(values) / min(values) - 1)


def _paper_note(measured: PosesMeasured) -> list[Block]:
    paper_column = COLUMNS.index("paper")
    if all(row[paper_column] == NONE for row in main_rows(measured)):
        return []
    note = (
        "Paper: relative MPJPE on the real data set, tab:quantitative-hypotheses and "
        "tab:generalization-evaluation. Its RANSAC is quoted from Iskakov et al., on their own "
        "detections."
    )
    if measured.run.source == "synthetic":
        ransac = " and RANSAC" if measured.run.data == "h36m" else ""
        note += (
            " These data are synthetic: their detector model was fitted to the paper's random, "
            f"average, best, worst{ransac} here, and to no row of a trained scorer."
        )
    return [Paragraph(note)]


def _mm(value: Number) -> str:
    return NONE if value is None else f"{value:.1f}"


def _percent(value: Number) -> str:
    return NONE if value is None else f"{100 * value:.2f} %"
