"""A camera check: what cameras.json holds, and the document that shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from ghpt.calibration.check.units import UNITS_MM
from ghpt.calibration.findings import Finding
from ghpt.report.document import Block, Document, Heading, Paragraph, Table
from ghpt.report.findings import finding_paragraphs, verdict_blocks

_NOTHING = "Nothing is wrong."


@dataclass(frozen=True)
class CheckedCamera:
    """A camera's held-out errors: medians, pixels."""

    name: str
    error_px: float
    """As the files have it."""
    mended_px: float
    """With everything mended that can be."""


@dataclass(frozen=True)
class CameraReport:
    """What cameras.json holds."""

    title: str
    source: str
    frames: int
    stature_mm: float | None
    """Of the person; None where it was not measured."""
    unit_mm: float | None
    """The unit of the file, where the file does not say it and the person tells."""
    findings: tuple[Finding, ...]
    cameras: tuple[CheckedCamera, ...]
    provenance: dict[str, Any]
    command: str
    """What to type next."""

    def plain(self) -> dict[str, Any]:
        """Return the report as plain data."""
        return asdict(self)


def camera_check_summary(report: CameraReport) -> Document:
    """Return what the terminal shows."""
    caption = ("median error against the other views",)
    table = _table(report, f"Camera check of {report.title}", caption)
    blocks: list[Block] = [table, Paragraph(_stature(report))]
    blocks += finding_paragraphs(report.findings)
    if not report.findings:
        blocks.append(Paragraph(_NOTHING))
        blocks.append(Paragraph(f"Next: {report.command}"))
    return Document("", blocks)


def camera_check_document(report: CameraReport, pictures: Sequence[Block] = ()) -> Document:
    """Return the report, with the pictures below the verdict."""
    about = f"{report.frames} frames, {len(report.cameras)} views. {_stature(report)}"
    blocks: list[Block] = [
        *verdict_blocks(report.findings, "nothing is wrong", report.command),
        Paragraph(about),
        *pictures,
        Heading("Cameras"),
        _view_table(report),
        Paragraph(
            "Each view's key points against the joints that the other views triangulate: median "
            "distance, pixels, as the files have it and with everything mended that can be."
        ),
    ]
    return Document(f"Camera check of {report.title}", blocks)


def _view_table(report: CameraReport) -> Table:
    """Return the errors of each view, and what is off in it."""
    table = _table(report)
    rows = []
    for camera, row in zip(report.cameras, table.rows, strict=True):
        found = [each.text for each in report.findings if camera.name in each.cameras]
        rows.append([*row, "; ".join(found)])
    return replace(table, header=[*table.header, "what is off"], rows=rows, left_columns=(0, 3))


def _table(report: CameraReport, title: str = "", caption: tuple[str, ...] = ()) -> Table:
    header = ["camera", "error px", "mended px"]
    rows = [
        [camera.name, f"{camera.error_px:.1f}", f"{camera.mended_px:.1f}"]
        for camera in report.cameras
    ]
    return Table(header, rows, title=title, caption=caption)


def _stature(report: CameraReport) -> str:
    if not report.stature_mm:
        return "The person's size cannot be told."
    height = f"The person measures {report.stature_mm / 1000:.2f} m"
    if report.unit_mm is None:
        return f"{height}."
    unit = UNITS_MM[report.unit_mm]
    return f"{height}, which tells the file's unit: {unit} (unit_mm={report.unit_mm:g})."
