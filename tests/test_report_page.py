"""The report: Markdown, one HTML file that needs no other, and data for programs."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from markdown_it import MarkdownIt
from matplotlib.figure import Figure

from ghpt.paper.engine.artefact import Artefact, Claim, Comparison, Section, Spread, figure_block
from ghpt.paper.engine.page import Counts, Entry, Page, write_page
from ghpt.report.document import Code, Document, Paragraph, Table, prose
from ghpt.report.markdown import render_markdown


def figure():
    drawn = Figure(figsize=(3, 2))
    drawn.subplots().plot([0, 1], [1, 0])
    return drawn


@pytest.fixture
def page():
    good = Comparison("weight", 29.1, Spread((26.0, 27.0)))
    bad = Comparison("most <b>", 20.0, Spread((26.0, 27.0)))
    claims = [
        Claim("most < least", "4.2", True, "1 < 2"),
        Claim("a & b", "4.3", False, "by 3 mm"),
        Claim("of others", "4.1", None, "25 against 30"),
    ]
    entries = [
        Entry(
            Artefact("first", "table", "A table", dict, dict),
            Section(
                "synthetic Human3.6M",
                [Paragraph(prose("A table of *x*:")), Table(["a", "b"], [["1", "2"]])],
                comparisons=[good, bad],
                claims=claims,
                explanation="Because of this.",
            ),
            ["python train.py data=h36m"],
        ),
        Entry(
            Artefact("second", "figure", "A figure", dict, dict),
            Section(
                "Human3.6M from /data",
                [Paragraph("Look:"), figure_block("curve", "curve")],
                {"curve": figure()},
            ),
            [],
        ),
    ]
    return Page(entries, {"data": "synthetic", "seeds": "2 (0, 1)"}, "seed: 0\nonly: null\n")


class Tags(HTMLParser):
    """What a page refers to, which ids it has, and its text."""

    def __init__(self, text):
        super().__init__()
        self.references, self.ids, self.text, self.tags = [], [], "", []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            if name in ("src", "href"):
                self.references.append(value)
            if name == "id":
                self.ids.append(value)

    def handle_data(self, data):
        self.text += data


def text_of(entry):
    return render_markdown(Document("", entry.blocks()))


def test_the_page_needs_no_other_file(page, tmp_path):
    write_page(page, tmp_path)
    tags = Tags((tmp_path / "report.html").read_text())
    assert not [r for r in tags.references if not r.startswith(("#", "data:image/svg+xml;base64,"))]
    assert sum(reference.startswith("data:") for reference in tags.references) == 1
    assert {r[1:] for r in tags.references if r.startswith("#")} <= set(tags.ids)
    assert "script" not in tags.tags
    assert "most <b>" in tags.text
    assert "a & b" in tags.text


def test_every_entry_says_its_data_its_claims_and_its_command(page, tmp_path):
    write_page(page, tmp_path)
    for text in (
        (tmp_path / "report.md").read_text(),
        Tags((tmp_path / "report.html").read_text()).text,
    ):
        assert "tab:first: A table · synthetic Human3.6M" in text
        assert "fig:second: A figure · Human3.6M from /data" in text
        assert "python reproduce.py only=[first]" in text
        assert "python train.py data=h36m" in text
        assert "1 of 2 claims hold" in text
        assert "Because of this." in text
        assert "seed: 0" in text
        assert re.search(r"26\.5 ± 0\.7", text)
        assert "+32.5 % (miss)" in text


def test_a_table_that_the_paper_lacks_has_no_label_of_its(page):
    entry = page.entries[0]
    own = Entry(replace(entry.artefact, of_paper=False), entry.section, [])
    assert (
        own.heading == entry.heading.removeprefix("tab:") == "first: A table · synthetic Human3.6M"
    )


def test_explanations_of_synthetic_numbers_are_not_given_for_real_ones(page, tmp_path):
    entry = page.entries[0]
    real = replace(entry.section, data="Human3.6M from /data")
    assert "Because of this." in text_of(entry)
    assert "Because of this." not in text_of(replace(entry, section=real))


def test_figures_are_vectors_and_the_same_bytes_twice(page, tmp_path):
    for name in ("a", "b"):
        write_page(page, tmp_path / name)
    for kind in ("svg", "pdf"):
        a, b = ((tmp_path / name / "figures" / f"curve.{kind}").read_bytes() for name in ("a", "b"))
        assert a == b
        assert b"image/png" not in a
    assert (tmp_path / "a" / "report.html").read_bytes() == (
        tmp_path / "b" / "report.html"
    ).read_bytes()
    markdown = (tmp_path / "a" / "report.md").read_text()
    assert "![curve](figures/curve.svg)" in markdown


def test_numbers_and_claims_for_programs(page, tmp_path):
    write_page(page, tmp_path)
    items = json.loads((tmp_path / "report.json").read_text())["items"]
    assert items["first"]["numbers"][0] == {
        "what": "weight",
        "paper": 29.1,
        "ours": [26.0, 27.0],
        "miss": False,
    }
    assert [claim["holds"] for claim in items["first"]["claims"]] == [True, False, None]
    assert items["second"] == {"data": "Human3.6M from /data", "numbers": [], "claims": []}


def test_a_comparison_without_a_number_is_shown_as_a_dash(page, tmp_path):
    """Whether the paper's or ours is missing: beside others, and alone."""
    known = page.entries[0].section.comparisons
    missing = [Comparison("theirs", None, Spread((1.0,))), Comparison("ours", 2.0, None)]
    lines = []
    for compared in ([*known, *missing], missing):
        entry = Entry(
            page.entries[0].artefact, Section("x", [Paragraph("y")], comparisons=compared), []
        )
        changed = replace(page, entries=[entry, page.entries[1]])
        write_page(changed, tmp_path)
        text = (tmp_path / "report.md").read_text()
        lines.append(next(line for line in text.splitlines() if line.startswith("| [first]")))
        numbers = json.loads((tmp_path / "report.json").read_text())["items"]["first"]["numbers"]
        assert [n["ours"] for n in numbers[-2:]] == [[1.0], None]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert cells[0][1:4] == ["4", "+11.8 %", "1"]
    assert cells[1][1:4] == ["2", "–", "0"]


def test_a_folder_s_name_is_shown_as_it_is(page, tmp_path):
    name = "/d/a|b<c>[red]`x`"
    section = replace(page.entries[0].section, data=f"Human3.6M from {name}")
    entry = Entry(page.entries[0].artefact, section, [f"python train.py data.root='{name}\n```'"])
    about = {"data": name, "command": Code(f"a `b` {name}")}
    write_page(replace(page, entries=[entry, page.entries[1]], about=about), tmp_path)
    markdown = MarkdownIt("gfm-like", {"linkify": False, "html": False}).render(
        (tmp_path / "report.md").read_text()
    )
    for text in (markdown, (tmp_path / "report.html").read_text()):
        tags = Tags(text)
        assert tags.text.count(name) == 4
        assert "c" not in tags.tags


def test_a_comparison_without_a_number_and_a_claim_without_a_measure_do_not_count(page, tmp_path):
    """The camera tables have both: they are not decidable, and end no report."""
    section = replace(
        page.entries[0].section,
        comparisons=[Comparison("E_3D", 23.0, None), Comparison("E_2D", 2.0, Spread((4.0,)))],
        claims=[Claim("of others", "4.1", None, "–"), Claim("ours", "4.2", True, "1 < 2")],
    )
    changed = replace(page, entries=[replace(page.entries[0], section=section)])
    assert changed.counts == Counts(claims=1, claims_held=1, numbers=2, misses=1)
    write_page(changed, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "1 of 1 claims hold; 1 of 2 numbers are not a miss." in text


@pytest.mark.parametrize(
    ("paper", "ours", "holds"),
    [(10.0, 10.2, True), (10.0, 11.0, False), (None, 11.0, None), (10.0, None, None)],
)
def test_a_comparison_holds_where_it_is_decidable(paper, ours, holds):
    comparison = Comparison("x", paper, None if ours is None else Spread((ours,)))
    assert comparison.holds is holds
    assert comparison.decidable == (holds is not None)
    assert comparison.miss == (holds is False)
