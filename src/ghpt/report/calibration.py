"""A calibration: what calibration.json holds, and the document that shows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from ghpt.calibration.comparison import Explanation, Quantiles
from ghpt.calibration.findings import Finding
from ghpt.calibration.independence import Evidence
from ghpt.calibration.millimetres import RigScale
from ghpt.calibration.mistakes import (
    FLAT,
    ILL_CONDITIONED,
    NOT_CONVERGED,
    PROPORTIONS,
    UNLINKED,
)
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.report.document import (
    Block,
    Bullets,
    Document,
    Heading,
    Paragraph,
    Table,
    Text,
    prose,
)
from ghpt.report.findings import finding_paragraphs, verdict_blocks
from ghpt.report.tables import NONE

_WANTED_DEG = 0.5
"""The standard deviation of a rotation that is asked for."""
_UNDERMINING = tuple(
    mistake.code for mistake in (UNLINKED, NOT_CONVERGED, ILL_CONDITIONED, FLAT, PROPORTIONS)
)
"""Findings with which a rig may be another than the ± allow for: they are of its neighbourhood."""
Matrix = list[list[float]]
_CAPTION = (
    "error: median reprojection; ±: standard deviation, for errors as the residuals show them"
)


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration; what is not calibrated has no numbers."""

    name: str
    calibrated: bool
    reprojection_px: float | None
    inliers: float | None
    """The share of its key points that agree with the rig."""
    rotation_sd_deg: float | None
    centre_sd_mm: float | None
    R: Matrix | None
    t_mm: list[float] | None
    centre_mm: list[float] | None
    covariance: Matrix | None
    """Of the rotation about the world's axes (radians) and of the centre (mm)."""
    K: Matrix
    distortion: list[float]
    size: list[int] | None


@dataclass(frozen=True)
class Differences:
    """Of each camera from the reference's calibration, after `align_robustly`."""

    rotation_deg: dict[str, float]
    centre_mm: dict[str, float]
    scale: float
    """Size of the reference over the estimate's."""


@dataclass(frozen=True)
class CalibrationResult:
    """What calibration.json holds."""

    data: str
    source: str
    cameras_file: str
    frames: int
    seed: int
    scale: RigScale
    world: str
    """In which the cameras are, in words."""
    reference: str | None
    """What the cameras are compared with, in words."""
    triangulation: str
    converged: bool
    usable: tuple[str, ...]
    """The cameras that are in the rig's files."""
    cameras: tuple[CalibratedCamera, ...]
    evidence: Evidence | None
    """What the recording is worth; None without a rig."""
    difference: Differences | None
    """None where there is no reference, and where the recording does not determine a rig."""
    explains: dict[str, Explanation]
    """How well each calibration explains the key points, by its name."""
    findings: tuple[Finding, ...]
    provenance: dict[str, Any]
    command: str
    """What to type next."""
    intrinsics: str | None = None
    """What was estimated of the intrinsics, in words; None where they were given."""

    def plain(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return asdict(self) | {"scale": self.scale.plain()}


def calibration_summary(result: CalibrationResult) -> Document:
    """Return what the terminal shows: the table of the cameras, and what was found."""
    lines: list[Block] = [Paragraph(line) for line in _rig_lines(result)]
    title = f"Calibration of {result.data}"
    table = _camera_table(result, title)
    following = Paragraph(f"Next: {result.command}")
    return Document("", [table, *lines, *finding_paragraphs(result.findings), following])


def calibration_document(result: CalibrationResult, pictures: Sequence[Block] = ()) -> Document:
    """Return the report, with the pictures below the verdict."""
    origin = result.provenance
    commit = origin["commit"] or NONE
    about = prose(
        f"{result.frames} frames, {len(result.cameras)} views, seed {result.seed}, "
        f"ghpt {origin['ghpt']}, commit `{commit}`."
    )
    blocks: list[Block] = [
        *verdict_blocks(result.findings, "the rig is consistent", result.command),
        Bullets(_rig_lines(result)),
        *pictures,
        Heading("Cameras"),
        _remarked_table(result),
    ]
    if result.explains:
        blocks += _explanation_blocks(result)
    blocks += [Heading("How this was made"), Paragraph(about)]
    return Document(f"Calibration of {result.data}", blocks)


def _camera_table(result: CalibrationResult, title: str = "") -> Table:
    """Return a row for each camera; what is not known is a dash."""
    header = ["camera", "error px", "inliers %", "rotation ± °", "centre ± mm"]
    if result.difference is not None:
        header += ["Δ rotation °", "Δ centre mm"]
    rows = []
    for camera in result.cameras:
        cells = [NONE] * (len(header) - 1)
        if camera.calibrated:
            cells = _camera_cells(camera, result.difference)
        rows.append([camera.name, *cells])
    caption: tuple[Text, ...] = (_CAPTION,)
    if result.difference is not None:
        caption += (
            f"Δ: from {result.reference}, after the similarity between the two worlds that most "
            "cameras agree on",
        )
    return Table(header, rows, title=title, caption=caption)


def _remarked_table(result: CalibrationResult) -> Table:
    """Return the table of the cameras with what is off in each."""
    table = _camera_table(result)
    rows = []
    for camera, row in zip(result.cameras, table.rows, strict=True):
        found = [each.text for each in result.findings if camera.name in each.cameras]
        rows.append([*row, "; ".join(found)])
    header = [*table.header, "what is off"]
    return replace(table, header=header, rows=rows, left_columns=(0, len(header) - 1))


def _camera_cells(camera: CalibratedCamera, difference: Differences | None) -> list[str]:
    cells = [
        _number(camera.reprojection_px, 1),
        _percent(camera.inliers, 0),
        _number(camera.rotation_sd_deg, 2),
        _number(camera.centre_sd_mm, 1),
    ]
    if difference is not None:
        cells.append(_number(difference.rotation_deg.get(camera.name), 2))
        cells.append(_number(difference.centre_mm.get(camera.name), 1))
    return cells


def _rig_lines(result: CalibrationResult) -> list[Text]:
    """Return sentences on the rig as a whole."""
    lines: list[Text] = [f"Scale: {result.scale.text}."]
    if result.evidence is not None:
        lines.append(_evidence_line(result.evidence, result.findings))
    if result.intrinsics is not None:
        lines.append(f"Intrinsics: {result.intrinsics}.")
    if result.difference is not None:
        scale = result.difference.scale
        lines.append(f"Size: {result.reference} is {scale:.4f} times as large.")
    for name, explanation in result.explains.items():
        errors = explanation.held_out
        if errors.median is not None:
            variation = _percent(explanation.segments.median, 1)
            lines.append(
                f"{name}: held-out view of the other half {errors.median:.1f} px median, "
                f"{errors.p90:.1f} px 90 %; "
                f"segments vary by {variation} %."
            )
    return lines


def _evidence_line(evidence: Evidence, findings: Sequence[Finding]) -> str:
    """Return a sentence on what the recording is worth."""
    needed = evidence.frames_for(_WANTED_DEG)
    enough = f"That is enough for rotations to ± {_WANTED_DEG}°."
    undermining = next((found for found in findings if found.code in _UNDERMINING), None)
    if undermining is not None:
        enough = (
            f"Whether that is enough for rotations to ± {_WANTED_DEG}° cannot be said "
            f"({undermining.code}, see below)."
        )
    elif needed is None:
        enough = (
            f"For rotations to ± {_WANTED_DEG}° people must turn more: no number of frames like "
            "these is enough."
        )
    elif needed > evidence.frames:
        enough = f"Rotations to ± {_WANTED_DEG}° take about {needed} frames like these."
    worth = f"{evidence.independent:.0f} independent one" + "s" * (evidence.independent >= 1.5)
    return (
        f"Evidence: {evidence.used} of {evidence.frames} frames, worth {worth}, in which people "
        f"turn by {evidence.turned_deg:.0f}°. {enough}"
    )


def _explanation_blocks(result: CalibrationResult) -> Iterator[Block]:
    names = list(result.explains)
    header = [f"{name}, {quantile}" for name in names for quantile in ("median", "90 %")]
    yield Heading("Held-out views")
    yield Paragraph(
        "Each joint is triangulated from the other views and projected into the one left out, on "
        f"the same joints for all; pixels. Triangulation: {result.triangulation}. The estimated "
        "rig is calibrated from one half of the recording and measured on the other, and the "
        "reverse. Small numbers are no proof of a rig: what a detector always gets wrong, both "
        "halves share."
    )
    yield Table(["view", *header], _held_out_rows(result))
    yield Heading("Segments")
    yield Paragraph(
        "Variation of their lengths over the frames, % (1.4826 x median deviation over median)."
    )
    yield Table(["segment", *names], _bone_rows(result))


def _held_out_rows(result: CalibrationResult) -> list[list[str]]:
    explanations = list(result.explains.values())
    rows = []
    for view in explanations[0].held_out.views:
        own = [explanation.held_out.views[view] for explanation in explanations]
        rows.append([view, *_quantile_cells(own)])
    every: list[Quantiles] = [explanation.held_out for explanation in explanations]
    return [*rows, ["all", *_quantile_cells(every)]]


def _quantile_cells(errors: list[Quantiles]) -> list[str]:
    return [_number(value, 1) for error in errors for value in (error.median, error.p90)]


def _bone_rows(result: CalibrationResult) -> list[list[str]]:
    rows = []
    for name in BONE_NAMES:
        each = [one.segments.each[name] for one in result.explains.values()]
        rows.append([name.replace("_", " "), *(_percent(value, 1) for value in each)])
    return rows


def _number(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def _percent(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{100 * value:.{digits}f}"
