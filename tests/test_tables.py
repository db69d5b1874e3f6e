import io

import pytest
from rich.console import Console

from ghpt.metrics.pose_prior import PARTS
from ghpt.models.measured import Measured, TestRun
from ghpt.models.pose.evaluation import NAMES
from ghpt.models.pose.numbers import PoseMeans, PoseNumbers
from ghpt.paper import published as paper
from ghpt.report.markdown import render_markdown
from ghpt.report.tables import (
    COLUMNS,
    display_name,
    main_rows,
    max_difference,
    report_document,
    summary_document,
)
from ghpt.report.terminal import print_document


def measured(data="h36m", source="synthetic", split="test", trained="h36m", value=30.0):
    numbers = PoseNumbers(
        means=PoseMeans(1234.56, value, 22.0, None),
        coverage=0.99876,
        per_joint={},
        per_action={"Eating": 29.0, "WalkingTogether": None},
        pose_prior={"S9": dict.fromkeys(PARTS, 0.00123), "S11": dict.fromkeys(PARTS)},
        without_damaged=PoseMeans(28.25, 28.25, 28.25, 28.25),
    )
    provenance = {
        "ghpt": "0.1.0",
        "commit": "abc",
        "checkpoint": "last.ckpt",
        "training": {"data": trained, "source": source},
    }
    run = TestRun(data, source, split, frames=100, seed=0, provenance=provenance)
    return Measured(run, dict.fromkeys(NAMES, numbers))


def report(**changes) -> str:
    return render_markdown(report_document(measured(**changes)))


def cells(values: dict) -> dict[str, dict[str, str]]:
    return {row[0]: dict(zip(COLUMNS, row, strict=True)) for row in main_rows(values)}


def test_the_papers_own_table_gives_its_last_column():
    for test, printed in paper.GENERALIZATION_MAX_DIFFERENCE.items():
        row = [paper.GENERALIZATION[train, test] for train in paper.ARRANGEMENTS]
        assert printed == pytest.approx(max_difference(row), abs=0.1)
        assert printed <= round(max_difference(row), 1)  # cut or rounded
    # Of the obvious definitions only division by the smallest fits the row with the widest spread.
    row = [paper.GENERALIZATION[train, "h36m"] for train in paper.ARRANGEMENTS]
    assert round(100 * (max(row) - min(row)) / max(row), 1) != 15.1


def test_papers_tables_agree_with_each_other():
    assert paper.GENERALIZATION["h36m", "h36m"] == paper.QUANTITATIVE_HYPOTHESES["h36m"]["weight"]
    assert (
        paper.QUANTITATIVE_MEAN
        == paper.QUANTITATIVE_HYPOTHESES["h36m"]["weight"]
        == paper.LIMITATION["test"]
    )
    assert sum(paper.QUANTITATIVE.values()) / 15 == pytest.approx(
        29.6, abs=0.1
    )  # by frames, not by actions: 29.1
    others = [
        v
        for (train, test), v in paper.GENERALIZATION.items()
        if train != test and "h36m" not in (train, test)
    ]
    assert sum(others) / 12 == pytest.approx(25.42, abs=0.005)  # tab:sota-comparison


def test_paper_values_only_where_the_paper_has_them():
    h36m = cells(measured())
    assert h36m["weight"]["paper"] == "29.1"
    assert h36m["weight"]["difference"] == "+3.1 %"
    assert h36m["RANSAC"]["paper"] == "27.4"
    assert h36m["linear"]["paper"] == h36m["linear"]["difference"] == "–"
    across = cells(measured(trained="cmu3"))
    assert across["weight"]["paper"] == "31.0"
    assert across["most"]["paper"] == "–"  # printed for training on Human3.6M only
    assert across["random"]["paper"] == "45.0"  # needs no training
    panoptic = cells(measured(data="cmu3", trained="cmu1"))
    assert panoptic["weight"]["paper"] == "24.9"
    assert panoptic["most"]["paper"] == "25.0"
    assert all(row["paper"] == "–" for row in cells(measured(split="validation")).values())
    assert all(row["paper"] == "–" for row in cells(measured(data="mine", trained=None)).values())


def test_synthetic_is_never_mistaken_for_real():
    assert display_name("h36m", "synthetic") == "synthetic Human3.6M"
    assert display_name("cmu2", "/data/panoptic") == "Panoptic CMU2 from /data/panoptic"
    text = report()
    assert text.startswith("# Test on synthetic Human3.6M, test split, trained on synthetic Human")
    assert "These data are synthetic" in text
    real = report(source="/data/h36m")
    assert "synthetic" not in real
    assert "/data/h36m" in real.splitlines()[0]


def test_report_fits_100_columns_and_every_row_has_every_column():
    tables = [line for line in report().splitlines() if line.startswith("|")]
    assert max(map(len, tables)) <= 100
    blocks = report().split("\n\n")
    for block in (block for block in blocks if block.startswith("|")):
        assert len({line.count("|") for line in block.splitlines()}) == 1
    assert (
        sum(line.startswith("| weight ") for line in tables) == 2
    )  # the main table and the one without damaged
    assert "28.2" in report()


def test_terminal_table_fits_80_columns():
    buffer = io.StringIO()
    document = summary_document(measured(data="cmu4", trained="cmu2"))
    print_document(document, Console(file=buffer, width=80, color_system=None))
    lines = buffer.getvalue().splitlines()
    assert "synthetic Panoptic CMU4" in " ".join(lines)
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    for name in ("weight", "worst", "LO-RANSAC"):
        assert any(name in line for line in lines)
