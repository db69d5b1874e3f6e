"""A name in a report or in the terminal is shown as it is, whatever it is made of."""

import io
from itertools import pairwise

import numpy as np
import pytest
import torch
from markdown_it import MarkdownIt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.console import Console

from ghpt.commands.cameras import _print as print_checkup
from ghpt.commands.cameras import report as checkup_report
from ghpt.commands.prediction.report import prediction_report, print_prediction, print_verdict
from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.report.calibration import calibration_report, print_calibration
from ghpt.report.escape import Markdown, code, code_block, escaped, plain
from ghpt.report.rig_comparison import Similarity
from ghpt.report.rig_figure import rig_figure
from ghpt.report.tables import markdown

NAMES = (
    "a|b<c>[red]",
    "`x`",
    "*a* _b_ __c__",
    "[l](http://x)",
    "~~a~~ &lt;",
    "\\|",
    "$a$",
    "<b>",
    "_",
    "cam_01",
)
BAD = "a|b<c>[red]"


def rendered(text: str) -> list[tuple[str, str]]:
    """The text of all table cells, headings and paragraphs: (kind, what is shown)."""
    shown = []
    for opening, inline in pairwise(MarkdownIt("gfm-like", {"linkify": False}).parse(text)):
        if inline.type == "inline":
            assert not {"html_inline", "link_open", "image"} & {
                part.type for part in inline.children
            }
            shown.append((opening.type, "".join(part.content for part in inline.children)))
    return shown


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_shown_as_it_is_in_text_and_in_a_table(name):
    assert rendered(f"# A {escaped(name)} b") == [("heading_open", f"A {name} b")]
    assert rendered(f"- {code(name)}") == [("paragraph_open", name)]
    cells = rendered(markdown(["view", name], [[name, "1"], ["b", "2"]]))
    assert cells == [
        ("th_open", "view"),
        ("th_open", name),
        ("td_open", name),
        ("td_open", "1"),
        ("td_open", "b"),
        ("td_open", "2"),
    ]


def test_a_name_of_several_lines_stays_in_one():
    assert rendered(f"- {escaped('a' + chr(10) + '# b' + chr(27) + '[31m')}") == [
        ("paragraph_open", "a # b [31m")
    ]
    assert "\x1b" not in plain("a\x1b[31mb").plain


def test_a_command_with_backticks_does_not_end_its_block():
    assert MarkdownIt().parse(code_block("a\n```\n# b", "bash"))[0].content == "a\n```\n# b\n"


def test_what_is_markdown_already_stays():
    assert "| **a** |" in markdown([Markdown("**a**")], [])


def test_the_terminal_shows_brackets_and_colons_as_they_are():
    buffer = io.StringIO()
    Console(file=buffer, width=80).print(plain("[red]a[/red] :smile: [/]"))
    assert buffer.getvalue().strip() == "[red]a[/red] :smile: [/]"


ERRORS = {"median": 1.0, "p90": 2.0}
PROVENANCE = {"ghpt": "0", "commit": None, "seed": 0, "command": "python predict.py 'a`b'"}


def prediction() -> dict:
    each = {"views": {BAD: ERRORS}, **ERRORS}
    found = {
        "reprojection": each,
        "held_out": each,
        "placed": 1.0,
        "segments": {"median": 0.1, "each": {}},
    }
    found["segments"]["each"] = dict.fromkeys(BONE_NAMES, 0.1)
    return {
        "data": BAD,
        "cameras": [BAD],
        "estimator": "linear",
        "estimator_text": BAD,
        "frames": 3,
        "smooth_hz": None,
        "share": {"observed": 1.0, "filled": 0.0},
        "swapped": {BAD: 2},
        "observed": {BAD: 1.0},
        "evaluation": {"frames": 3, "estimators": {"linear": found, "x": found}},
        "provenance": PROVENANCE,
        "stature_mm": 1700.0,
        "verdict": {
            "level": "look at this",
            "undecidable": [BAD],
            "findings": [
                {
                    "level": "look at this",
                    "code": "moved",
                    "text": f"{BAD} is off",
                    "value": 0.1,
                    "limit": 0.0,
                    "command": f"python cameras.py {BAD}",
                },
            ],
        },
    }


def calibration() -> dict:
    camera = {
        "name": BAD,
        "calibrated": True,
        "reprojection_px": 1.0,
        "inliers": 1.0,
        "rotation_sd_deg": 0.1,
        "centre_sd_mm": 1.0,
    }
    return {
        "data": BAD,
        "frames": 3,
        "seed": 0,
        "cameras": [camera],
        "scale": {"text": BAD},
        "explains": {},
        "reference": BAD,
        "difference": {"scale": 1.0, "rotation_deg": {BAD: 1.0}, "centre_mm": {BAD: 1.0}},
        "diagnoses": [{"severity": "error", "code": "x", "text": BAD}],
        "provenance": PROVENANCE,
    }


def checkup() -> dict:
    finding = {"code": "x", "text": BAD, "before_px": 2.0, "after_px": 1.0, "mended": True}
    return {
        "title": BAD,
        "frames": 3,
        "stature_mm": 1700.0,
        "unit_mm": None,
        "findings": [finding],
        "cameras": [{"name": BAD, "error_px": 1.0, "mended_px": 1.0}],
    }


@pytest.mark.parametrize(
    ("numbers", "report", "times"),
    [
        (prediction, prediction_report, 8),
        (calibration, calibration_report, 6),
        (checkup, checkup_report, 3),
    ],
)
def test_a_report_shows_names_as_they_are(numbers, report, times):
    shown = [content for _, content in rendered(report(numbers()))]
    assert sum(content.count(BAD) for content in shown) == times


@pytest.mark.parametrize(
    ("numbers", "show", "times"),
    [
        (prediction, print_prediction, 4),
        (lambda: prediction()["verdict"], print_verdict, 3),
        (calibration, print_calibration, 6),
        (checkup, print_checkup, 3),
    ],
)
def test_the_terminal_shows_names_as_they_are(numbers, show, times, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    show(numbers())
    assert capsys.readouterr().out.count(BAD) == times


def test_a_dollar_in_a_camera_s_name_is_no_formula():
    rig = Cameras(
        torch.eye(3).double()[None] * torch.tensor([500.0, 500, 1]).double(),
        torch.eye(3).double()[None],
        torch.zeros(1, 3).double(),
    )
    same = Similarity(torch.eye(3).double(), 1.0, torch.zeros(3).double())
    points, estimated = torch.zeros(1, 17, 3).double(), torch.zeros(1, 17).bool()
    figure = rig_figure(
        r"$\a$", (r"$\b$",), rig, torch.zeros(1, 6, 6).double(), points, estimated, same
    )
    FigureCanvasAgg(figure).draw()
    assert np.isfinite(figure.get_size_inches()).all()
