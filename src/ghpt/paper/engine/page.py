"""report.md and report.html: the summary, the claims, the misses, then every table and figure."""

from __future__ import annotations

import base64
import json
import logging
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
from markdown_it import MarkdownIt
from matplotlib.figure import Figure

from ghpt.files import atomic_write, write_json
from ghpt.paper.engine.artefact import TOLERANCE, Artefact, Claim, Comparison, Section, signed
from ghpt.report.escape import Markdown, code_block, escaped
from ghpt.report.tables import markdown

TITLE = "Generalizable Human Pose Triangulation: the paper's tables and figures again"
PREFIX = {"table": "tab:", "figure": "fig:"}
FOLDER = "figures"
SYNTHETIC = "synthetic"
logging.getLogger("fontTools").setLevel(
    logging.WARNING
)  # it tells every glyph that goes into a PDF


@dataclass(frozen=True)
class Entry:
    """An artefact with what it shows."""

    artefact: Artefact
    section: Section
    commands: Sequence[str]
    """What makes its results, by hand."""

    @property
    def heading(self) -> str:
        """Label, title and data: a synthetic number can never be mistaken for a real one."""
        prefix = PREFIX.get(self.artefact.kind, "") if self.artefact.of_paper else ""
        return f"{prefix}{self.artefact.label}: {self.artefact.title} · {self.section.data}"

    @property
    def misses(self) -> list[Comparison]:
        return [number for number in self.section.comparisons if number.miss]

    def text(self) -> str:
        """Body, claims, and what explains the misses; Markdown."""
        parts = [self.section.body]
        if self.section.claims:
            parts.append(claims_table(self.section.claims))
        short = self.misses or [claim for claim in self.section.claims if claim.holds is False]
        if short and self.section.explained and SYNTHETIC in self.section.data:
            parts.append(f"**What explains the misses.** {self.section.explained}")
        return "\n\n".join(parts)

    @property
    def again(self) -> str:
        return f"python reproduce.py only=[{self.artefact.label}]"


@dataclass(frozen=True)
class Page:
    """All entries, and what is true of the whole."""

    entries: Sequence[Entry]
    about: Mapping[str, Any]
    """What to say of the run: words -> value."""
    config: str
    """The configuration, yaml."""

    @property
    def claims(self) -> list[Claim]:
        """Those that the data can tell."""
        return [claim for entry in self.entries for claim in told(entry)]

    def front(self) -> str:
        """What comes before the entries, Markdown."""
        lines = "\n".join(f"- {name}: {escaped(value)}" for name, value in self.about.items())
        held = sum(claim.holds for claim in self.claims)
        compared = sum(len(entry.section.comparisons) for entry in self.entries)
        misses = [(entry, number) for entry in self.entries for number in entry.misses]
        parts = [
            lines,
            "All numbers in mm are mean per joint position errors relative to the pelvis, unless stated. *paper* is "
            "what the paper prints, of real data; *ours* is of the data that the heading names, the mean ± the "
            f"standard deviation over the seeds. A *miss* is more than {100 * TOLERANCE:.0f} % worse than the paper.",
            "## Summary",
            f"{held} of {len(self.claims)} claims hold; {compared - len(misses)} of {compared} numbers are not a miss. "
            f"A claim with – is about what others published of real images, which {SYNTHETIC} data cannot tell.",
            markdown(
                ["table or figure", "numbers", "median difference", "misses", "claims that hold"],
                [_summary_row(entry) for entry in self.entries],
            ),
        ]
        failed = [
            (entry, claim)
            for entry in self.entries
            for claim in entry.section.claims
            if claim.holds is False
        ]
        if failed:
            rows = [
                [entry.artefact.label, claim.statement, claim.where, claim.by]
                for entry, claim in failed
            ]
            parts += [
                "## Claims that do not hold",
                markdown(
                    ["in", "claim", "section", "by (the paper's in brackets)"], rows, range(4)
                ),
            ]
        if misses:
            rows = [
                [entry.artefact.label, number.what, *number.cells()] for entry, number in misses
            ]
            parts += [
                "## Misses",
                markdown(["in", "number", "paper", "ours", "difference"], rows, range(2)),
            ]
        return "\n\n".join(parts)


HOLDS = {True: "yes", False: Markdown("**no**"), None: "–"}


def claims_table(claims: Sequence[Claim]) -> str:
    rows = [[claim.statement, claim.where, HOLDS[claim.holds], claim.by] for claim in claims]
    return markdown(["claim", "section", "holds", "by (the paper's in brackets)"], rows, range(4))


def told(entry: Entry) -> list[Claim]:
    return [claim for claim in entry.section.claims if claim.holds is not None]


def _summary_row(entry: Entry) -> list[str]:
    claims = told(entry)
    numbers = entry.section.comparisons
    # a comparison may lack a number, the paper's or ours
    known = [number.difference for number in numbers if number.difference is not None]
    return [
        Markdown(f"[{entry.artefact.label}](#{entry.artefact.label})"),
        str(len(numbers) or "–"),
        f"{signed(100 * statistics.median(known))} %" if known else "–",
        str(len(entry.misses)) if numbers else "–",
        f"{sum(claim.holds for claim in claims)} of {len(claims)}" if claims else "–",
    ]


def write_page(page: Page, folder: Path) -> None:
    """Write report.md, report.html, report.json and figures/ (SVG and PDF) into ``folder``."""
    pictures = {}
    for entry in page.entries:
        for name, figure in entry.section.figures.items():
            for kind in ("svg", "pdf"):
                content = drawn(figure, kind)
                with atomic_write(folder / FOLDER / f"{name}.{kind}") as handle:
                    handle.write(content)
                if kind == "svg":
                    pictures[f"{name}.svg"] = content
    with atomic_write(folder / "report.md", "w") as handle:
        handle.write(as_markdown(page))
    with atomic_write(folder / "report.html", "w") as handle:
        handle.write(as_html(page, pictures))
    write_json(folder / "report.json", as_data(page))


def drawn(figure: Figure, kind: str) -> bytes:
    """The same bytes for the same figure: no date, no random names; letters as outlines, so that no
    font is needed.
    """
    content = BytesIO()
    with matplotlib.rc_context(
        {"svg.hashsalt": "ghpt", "svg.fonttype": "path", "pdf.fonttype": 42}
    ):
        figure.savefig(
            content, format=kind, metadata={"Date" if kind == "svg" else "CreationDate": None}
        )
    return content.getvalue()


def as_markdown(page: Page) -> str:
    parts = [f"# {TITLE}", page.front()]
    for entry in page.entries:
        body = entry.text()
        for name in entry.section.figures:
            body = body.replace(f"]({name}.svg)", f"]({FOLDER}/{name}.svg)")
        commands = "\n".join(entry.commands)
        parts += [
            f'<a id="{entry.artefact.label}"></a>',
            f"## {escaped(entry.heading)}",
            body,
            f"Again: `{entry.again}`",
        ]
        parts += ["By hand:", code_block(commands, "bash")] if commands else []
    return (
        "\n\n".join([*parts, "## Configuration", code_block(page.config.rstrip(), "yaml")]) + "\n"
    )


def as_html(page: Page, pictures: Mapping[str, bytes]) -> str:
    """One file that needs no other: pictures are in it, and nothing is fetched."""
    renderer = MarkdownIt("commonmark", {"html": False}).enable("table")
    renderer.add_render_rule("table_open", lambda *_: '<div class="table"><table>')
    renderer.add_render_rule("table_close", lambda *_: "</table></div>")
    renderer.add_render_rule(
        "image", lambda _, tokens, index, *__: _picture(tokens[index], pictures)
    )
    entries = "\n".join(
        f'<section id="{entry.artefact.label}">\n<h2>{escape(entry.heading)}</h2>\n{renderer.render(entry.text())}'
        f"<p class='again'>Again: <code>{escape(entry.again)}</code></p>{_details(entry.commands)}</section>"
        for entry in page.entries
    )
    links = "".join(
        f'<li><a href="#{e.artefact.label}">{escape(e.artefact.label)}</a></li>'
        for e in page.entries
    )
    template = files("ghpt.paper.engine").joinpath("page.html").read_text(encoding="utf-8")
    blocks = {
        "TITLE": escape(TITLE),
        "LINKS": links,
        "FRONT": renderer.render(page.front()),
        "ENTRIES": entries,
        "CONFIG": escape(page.config),
    }
    for name, text in blocks.items():
        template = template.replace(f"<!--{name}-->", text)
    return template


def _picture(token: Any, pictures: Mapping[str, bytes]) -> str:
    source = base64.b64encode(pictures[token.attrs["src"]]).decode()
    return f'<img alt="{escape(token.content)}" src="data:image/svg+xml;base64,{source}">'


def _details(commands: Sequence[str]) -> str:
    if not commands:
        return ""
    return (
        f"<details><summary>By hand</summary><pre>{escape(chr(10).join(commands))}</pre></details>"
    )


def as_data(page: Page) -> dict[str, Any]:
    """Every number and claim, for programs."""
    return {
        "format_version": 1,
        "about": json.loads(json.dumps(page.about, default=str)),
        "items": {
            entry.artefact.label: {
                "data": entry.section.data,
                "numbers": [
                    {
                        "what": n.what,
                        "paper": n.paper,
                        "ours": None if n.ours is None else list(n.ours.values),
                        "miss": n.miss,
                    }
                    for n in entry.section.comparisons
                ],
                "claims": [vars(claim) for claim in entry.section.claims],
            }
            for entry in page.entries
        },
    }
