"""Findings as paragraphs of a document."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ghpt.calibration.findings import Finding, Severity
from ghpt.report.document import (
    Block,
    Bullets,
    CodeBlock,
    Notice,
    Paragraph,
    Strong,
    Text,
    Tone,
)

_VERDICTS = {Tone.LOOK: "look at this", Tone.BAD: "do not use"}
_MENDED = "wrong as the files have it, right in the mended files"
_COLOURS = {Severity.ERROR: "red", Severity.WARNING: "yellow"}


def finding_bullets(findings: Sequence[Finding], otherwise: str) -> Block:
    """Return a list of the findings; a paragraph that says ``otherwise`` where there is none."""
    if not findings:
        return Paragraph(otherwise)
    return Bullets([_bullet(finding) for finding in findings])


def verdict_blocks(findings: Sequence[Finding], good: str, command: str) -> list[Block]:
    """Return the verdict (``good`` where nothing was found), the findings, and what to type next.

    The worst finding decides, unless all were mended.
    """
    tone = Tone.GOOD
    text = good
    if findings:
        errors = any(finding.severity == Severity.ERROR for finding in findings)
        mended = all(finding.mended for finding in findings)
        tone = Tone.BAD if errors and not mended else Tone.LOOK
        text = _MENDED if mended else _VERDICTS[tone]
    blocks: list[Block] = [Notice(("Verdict: ", Strong(text), "."), tone)]
    if findings:
        blocks.append(finding_bullets(findings, ""))
    return [*blocks, Paragraph("What to type next:"), CodeBlock(command, "bash")]


def finding_paragraphs(findings: Sequence[Finding]) -> Iterator[Block]:
    """Yield a coloured line for each finding."""
    for finding in findings:
        label = Strong(finding.severity, _COLOURS[finding.severity])
        yield Paragraph((label, f" ({finding.code}): {describe_finding(finding)}"))


def describe_finding(finding: Finding) -> str:
    """Return the finding as a sentence, with the errors before and after where they are known."""
    if not finding.before_px:
        return f"{finding.text}."
    before = f"{finding.before_px:.1f} px"
    after = f", then {finding.after_px:.1f} px" if finding.mended else ""
    return f"{finding.text} ({before}{after})."


def _bullet(finding: Finding) -> Text:
    return (Strong(finding.severity), f" ({finding.code}): {describe_finding(finding)}")
