"""report.md and report.html: the summary, the claims, the misses, then every table and figure."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ghpt.files import atomic_write, write_json
from ghpt.paper.engine.artefact import (
    TOLERANCE,
    Artefact,
    Claim,
    Comparison,
    Section,
    figure_path,
    format_signed,
)
from ghpt.report.document import (
    Block,
    Bullets,
    Code,
    CodeBlock,
    Document,
    Heading,
    Link,
    Paragraph,
    Strong,
    Table,
    Text,
    plain_text,
    prose,
    spans,
)
from ghpt.report.drawing import draw
from ghpt.report.html import render_html
from ghpt.report.markdown import write_markdown
from ghpt.report.tables import NONE

TITLE = "Generalizable Human Pose Triangulation: the paper's tables and figures again"
PREFIX = {"table": "tab:", "figure": "fig:"}
SYNTHETIC = "synthetic"
EVIDENCE = "by (the paper's in brackets)"
HOLDS: Mapping[bool | None, Text] = {True: "yes", False: Strong("no"), None: NONE}


@dataclass(frozen=True)
class Entry:
    """An artefact with what it shows."""

    artefact: Artefact
    section: Section
    commands: Sequence[str]
    """The commands that make its results by hand."""

    @property
    def label(self) -> str:
        return self.artefact.label

    @property
    def heading(self) -> str:
        """Label, title and data: a synthetic number can never be mistaken for a real one."""
        prefix = PREFIX.get(self.artefact.kind, "") if self.artefact.of_paper else ""
        return f"{prefix}{self.label}: {self.artefact.title} · {self.section.data}"

    @property
    def command(self) -> str:
        return f"python reproduce.py only=[{self.label}]"

    @property
    def misses(self) -> list[Comparison]:
        return [comparison for comparison in self.section.comparisons if comparison.miss]

    @property
    def failed_claims(self) -> list[Claim]:
        return [claim for claim in self.section.claims if claim.holds is False]

    @property
    def decidable_claims(self) -> list[Claim]:
        return [claim for claim in self.section.claims if claim.decidable]

    def blocks(self) -> list[Block]:
        """Return heading, body, claims, what explains the misses, and the commands."""
        blocks: list[Block] = [Heading(self.heading, anchor=self.label), *self.section.blocks]
        if self.section.claims:
            blocks.append(claims_table(self.section.claims))
        short = bool(self.misses or self.failed_claims)
        if short and self.section.explanation and SYNTHETIC in self.section.data:
            explanation = spans(self.section.explanation)
            blocks.append(Paragraph((Strong("What explains the misses."), " ", *explanation)))
        blocks.append(Paragraph(("Again: ", Code(self.command))))
        if self.commands:
            blocks.append(CodeBlock("\n".join(self.commands), "bash", "By hand"))
        return blocks


@dataclass(frozen=True)
class Page:
    """All entries, and what is true of the whole."""

    entries: Sequence[Entry]
    about: Mapping[str, Text]
    """What there is to say of the run, by its name."""
    config: str
    """The configuration, yaml."""

    @property
    def claims(self) -> list[Claim]:
        """The decidable ones."""
        return [claim for entry in self.entries for claim in entry.decidable_claims]

    @property
    def comparisons(self) -> list[Comparison]:
        return [number for entry in self.entries for number in entry.section.comparisons]

    @property
    def counts(self) -> Counts:
        return Counts(
            claims=len(self.claims),
            claims_held=sum(claim.holds is True for claim in self.claims),
            numbers=len(self.comparisons),
            misses=sum(comparison.miss for comparison in self.comparisons),
        )


@dataclass(frozen=True)
class Counts:
    """How many claims hold and how many numbers miss the paper's."""

    claims: int
    """Of the claims those that the data can decide."""
    claims_held: int
    numbers: int
    misses: int


def document(page: Page) -> Document:
    """Return the report as a document."""
    entries = [block for entry in page.entries for block in entry.blocks()]
    configuration: list[Block] = [
        Heading("Configuration", anchor="configuration"),
        CodeBlock(page.config.rstrip(), "yaml"),
    ]
    return Document(TITLE, [*front(page), *entries, *configuration])


def front(page: Page) -> list[Block]:
    """Return what comes before the entries."""
    counts = page.counts
    blocks: list[Block] = [
        Bullets([(f"{name}: ", *spans(value)) for name, value in page.about.items()]),
        Paragraph(
            prose(
                "All numbers in mm are mean per joint position errors relative to the pelvis, "
                "unless stated. *paper* is what the paper prints, of real data; *ours* is of the "
                "data that the heading names, the mean ± the standard deviation over the seeds. "
                "A *miss* is more than {} % worse than the paper.",
                f"{100 * TOLERANCE:.0f}",
            )
        ),
        Heading("Summary"),
        Paragraph(
            f"{counts.claims_held} of {counts.claims} claims hold; "
            f"{counts.numbers - counts.misses} of {counts.numbers} numbers are not a miss. "
            f"A claim with {NONE} is about what others published of real images, which "
            f"{SYNTHETIC} data cannot tell."
        ),
        Table(
            ["table or figure", "numbers", "median difference", "misses", "claims that hold"],
            [_summary_row(entry) for entry in page.entries],
        ),
    ]
    return blocks + _failed_claims(page) + _misses(page)


def _failed_claims(page: Page) -> list[Block]:
    rows = [
        [entry.label, claim.statement, claim.section, claim.evidence]
        for entry in page.entries
        for claim in entry.failed_claims
    ]
    table = Table(["in", "claim", "section", EVIDENCE], rows, left_columns=range(4))
    return [Heading("Claims that do not hold"), table] if rows else []


def _misses(page: Page) -> list[Block]:
    rows = [
        [entry.label, comparison.label, *comparison.cells()]
        for entry in page.entries
        for comparison in entry.misses
    ]
    header = ["in", "number", "paper", "ours", "difference"]
    table = Table(header, rows, left_columns=range(2))
    return [Heading("Misses"), table] if rows else []


def claims_table(claims: Sequence[Claim]) -> Table:
    """Return a table with a row for each claim."""
    rows = [
        [claim.statement, claim.section, HOLDS[claim.holds], claim.evidence] for claim in claims
    ]
    return Table(["claim", "section", "holds", EVIDENCE], rows, left_columns=range(4))


def _summary_row(entry: Entry) -> list[Text]:
    comparisons = entry.section.comparisons
    differences = [
        comparison.difference for comparison in comparisons if comparison.difference is not None
    ]
    claims = entry.decidable_claims
    held = sum(claim.holds is True for claim in claims)
    return [
        Link(entry.label, entry.label),
        str(len(comparisons)) if comparisons else NONE,
        f"{format_signed(100 * statistics.median(differences))} %" if differences else NONE,
        str(len(entry.misses)) if comparisons else NONE,
        f"{held} of {len(claims)}" if claims else NONE,
    ]


def write_page(page: Page, folder: Path) -> None:
    """Write report.md, report.html, report.json and figures/ (SVG and PDF) into ``folder``."""
    pictures = {}
    for entry in page.entries:
        for name, figure in entry.section.figures.items():
            for kind in ("svg", "pdf"):
                path = figure_path(name, kind)
                pictures[path] = draw(figure, kind)
                with atomic_write(folder / path) as handle:
                    handle.write(pictures[path])
    report = document(page)
    write_markdown(folder / "report.md", report)
    with atomic_write(folder / "report.html", "w") as handle:
        handle.write(render_html(report, pictures))
    write_json(folder / "report.json", content(page))


def content(page: Page) -> dict[str, Any]:
    """Return every number and claim as plain data, for programs."""
    return {
        "format_version": 1,
        "about": {name: plain_text(value) for name, value in page.about.items()},
        "items": {entry.label: _entry_content(entry) for entry in page.entries},
    }


def _entry_content(entry: Entry) -> dict[str, Any]:
    section = entry.section
    return {
        "data": section.data,
        "numbers": [_comparison_content(comparison) for comparison in section.comparisons],
        "claims": [_claim_content(claim) for claim in section.claims],
    }


def _claim_content(claim: Claim) -> dict[str, Any]:
    return {
        "statement": claim.statement,
        "where": claim.section,
        "holds": claim.holds,
        "by": claim.evidence,
    }


def _comparison_content(comparison: Comparison) -> dict[str, Any]:
    return {
        "what": comparison.label,
        "paper": comparison.paper,
        "ours": None if comparison.ours is None else list(comparison.ours.values),
        "miss": comparison.miss,
    }
