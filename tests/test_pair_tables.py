import io
from itertools import combinations

import pytest
import torch
from rich.console import Console

from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.models.measured import TestRun
from ghpt.models.relative_pose.evaluation import (
    ALONE,
    ERRORS,
    NAMES,
    PairNumbers,
    PairSelection,
    PairsMeasured,
)
from ghpt.paper import published as paper
from ghpt.report.markdown import render_markdown
from ghpt.report.pair_tables import (
    comparison_table,
    dissection_table,
    pair_report_document,
    pair_summary_document,
    paper_numbers,
)
from ghpt.report.terminal import print_document


def measured(data="h36m", source="synthetic", split="test", trained="h36m", views=4, frames=80):
    """A run whose errors are 1000 times the place of the pair; one pair has no median."""
    pairs = {}
    for place, (a, b) in enumerate(combinations(range(views), 2)):
        errors = dict.fromkeys(ERRORS, 1000.0 * place + 0.5) | {"E_R": 0.0123}
        pairs[f"{a + 1}-{b + 1}"] = PairNumbers(
            median=errors if place else {**errors, "E_3D": None},
            coverage=0.987,
            mean=errors,
            deviation=dict.fromkeys(ERRORS),
            alone={part: {"E_2D": 0.4, "E_3D": None} for part in ALONE},
        )
    means = {**dict.fromkeys(ERRORS, 12.3), "E_3D": None}
    numbers = PairSelection(means, coverage=0.987, pairs=pairs)
    provenance = {
        "ghpt": "0.1.0",
        "commit": "abc",
        "checkpoint": "last.ckpt",
        "training": {"data": trained, "source": source},
    }
    run = TestRun(data, source, split, frames, 0, provenance, "camera")
    cameras = [f"c{i}" for i in range(views)]
    return PairsMeasured(run, dict.fromkeys(NAMES, numbers), draws=40, cameras=cameras)


def report(**changes) -> str:
    return render_markdown(pair_report_document(measured(**changes)))


def printed(values: dict) -> list[str]:
    buffer = io.StringIO()
    console = Console(file=buffer, width=80, color_system=None)
    print_document(pair_summary_document(values), console)
    return buffer.getvalue().splitlines()


def test_the_pairs_that_the_paper_calls_diagonal_are_not():
    centre = human36m_rig("S9").cameras.centre[:, :2]
    direction = centre - centre.mean(dim=0)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    degrees = {
        (a, b): torch.rad2deg(torch.acos(direction[a - 1] @ direction[b - 1]))
        for a, b in paper.FUNDAMENTAL
    }
    assert {pair for pair in degrees if degrees[pair] > 170} == {(1, 4), (2, 3)}
    assert {pair for pair in degrees if degrees[pair] < 50} == {(1, 3), (2, 4)}
    assert list(paper.FUNDAMENTAL) == list(paper.FUNDAMENTAL_DISSECTION)


def test_paper_values_only_where_the_paper_has_them():
    assert paper_numbers(measured(), paper.FUNDAMENTAL)["1-3"]["E_2D"] == 3.7
    for other in (
        {"data": "cmu3"},
        {"split": "validation"},
        {"trained": "cmu3"},
        {"views": 3},
        {"views": 5},
        {"frames": 20},
    ):
        assert paper_numbers(measured(**other), paper.FUNDAMENTAL) == {}, other
        assert "brackets" not in report(**other)


@pytest.mark.parametrize("views", [2, 4, 5, 7])
def test_terminal_tables_fit_80_columns(views):
    lines = printed(measured(views=views))
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    text = " ".join(" ".join(lines).split())
    assert "synthetic Human3.6M" in text
    for name in ("weight", "8-point", "USAC_ACCURATE", "PoseLib", "rig (all views)"):
        assert any(name in line for line in lines)


def test_the_first_table_has_every_pair_with_the_papers_numbers_beside():
    lines = [
        line.replace("│", " ").split() for line in printed(measured()) if line.startswith("│")
    ][:6]
    assert [line[0] for line in lines] == ["1-3", "2-4", "1-4", "2-3", "3-4", "1-2"]
    assert lines[0][1:7] == ["12.3", "(17)", "1000", "(23)", "1000", "(3.7)"]
    assert lines[5][7:9] == ["–", "(4.9)"]  # no median


def test_many_pairs_are_summed_up():
    table = comparison_table(measured(views=7))
    assert table.header == ["selection", "median", "worst", "its pair", "mean", "cov"]
    assert table.rows[0] == ["weight", "11000", "–", "1-2", "–", "98.7"]
    assert "the 10 worst of 21 pairs" in " ".join(printed(measured(views=7)))
    assert "| 6-7 " in report(views=7)  # the report has all


def test_report_has_every_number_of_every_name():
    text = report()
    assert text.startswith(
        "# Relative camera poses on synthetic Human3.6M, test split, trained on synthetic"
    )
    blocks = [block for block in text.split("\n\n") if block.startswith("|")]
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1
    assert sum(
        line.startswith("| usac_magsac".upper()[:13]) for line in text.splitlines()
    ) == 1 + 2 * len(ERRORS)
    assert "nan" not in text.lower().replace("finan", "")
    assert "None" not in text
    real = report(source="/data/h36m")
    assert "synthetic" not in real
    assert "/data/h36m" in real.splitlines()[0]


def test_dissection_is_beside_the_papers():
    table = dissection_table(measured())
    assert len(table.header) == 5
    assert table.rows[0] == ["1-3", "0.40 (1.2)", "– (10.8)", "0.40 (1.8)", "– (18.2)"]
