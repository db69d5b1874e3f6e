"""A name in a report or in the terminal is shown as it is, whatever it is made of."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from markdown_it import MarkdownIt
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ghpt.calibration.comparison import BoneVariation, Quantiles, ViewErrors
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.millimetres import RigScale
from ghpt.commands.prediction.report import (
    report_document,
    summary_document,
    verdict_document,
)
from ghpt.commands.prediction.result import PredictionResult
from ghpt.commands.prediction.statistics import (
    Coverage,
    EstimatorErrors,
    Evaluation,
    ScaledErrors,
)
from ghpt.commands.prediction.verdict import Verdict
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.report.calibration import (
    CalibratedCamera,
    CalibrationResult,
    Differences,
    calibration_document,
    calibration_summary,
)
from ghpt.report.camera_check import (
    CameraReport,
    CheckedCamera,
    camera_check_document,
    camera_check_summary,
)
from ghpt.report.markdown import render_markdown
from ghpt.report.rig_figure import DrawnPerson, DrawnRig, rig_figure
from ghpt.report.terminal import print_document

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


PROVENANCE = {"ghpt": "0", "commit": None, "seed": 0, "command": "python predict.py 'a`b'"}


def prediction() -> PredictionResult:
    errors = ViewErrors(1.0, 2.0, 3, {BAD: Quantiles(1.0, 2.0, 3)})
    found = EstimatorErrors(
        reprojection=errors,
        held_out=errors,
        segments=BoneVariation(0.1, dict.fromkeys(BONE_NAMES, 0.1)),
        placed=1.0,
        scales=ScaledErrors(None, {}),
    )
    finding = Finding(
        "moved", Severity.WARNING, f"{BAD} is off", value=0.1, command=f"python cameras.py {BAD}"
    )
    return PredictionResult(
        data=BAD,
        source=BAD,
        cameras=(BAD,),
        estimator="linear",
        estimator_text=BAD,
        rate_hz=None,
        fill_frames=None,
        smooth_hz=None,
        coverage=Coverage(
            frames=3,
            share={"observed": 1.0, "supported": 0.0, "filled": 0.0},
            observed={BAD: 1.0},
            completeness=1.0,
            swapped={BAD: 2},
            stature_mm=1700.0,
        ),
        scales=ScaledErrors(None, {}),
        unit_mm=1.0,
        evaluation=Evaluation(3, {"linear": found, "x": found}),
        formats=[],
        world={},
        provenance=PROVENANCE,
        verdict=Verdict((finding,), (BAD,)),
    )


def calibration() -> CalibrationResult:
    camera = CalibratedCamera(
        name=BAD,
        calibrated=True,
        reprojection_px=1.0,
        inliers=1.0,
        rotation_sd_deg=0.1,
        centre_sd_mm=1.0,
        R=None,
        t_mm=None,
        centre_mm=None,
        covariance=None,
        K=[],
        distortion=[],
        size=None,
    )
    return CalibrationResult(
        data=BAD,
        source="",
        cameras_file="",
        frames=3,
        seed=0,
        scale=RigScale("height", BAD, 1.0),
        world="",
        reference=BAD,
        triangulation="linear",
        converged=True,
        usable=(BAD,),
        cameras=(camera,),
        evidence=None,
        difference=Differences({BAD: 1.0}, {BAD: 1.0}, 1.0),
        explains={},
        findings=(Finding("x", Severity.ERROR, BAD),),
        provenance=PROVENANCE,
        command="next",
    )


def camera_check() -> CameraReport:
    return CameraReport(
        title=BAD,
        source="",
        frames=3,
        stature_mm=1700.0,
        unit_mm=None,
        findings=(Finding("x", Severity.ERROR, BAD, before_px=2.0, after_px=1.0, mended=True),),
        cameras=(CheckedCamera(BAD, 1.0, 1.0),),
        provenance=PROVENANCE,
        command="next",
    )


@pytest.mark.parametrize(
    ("numbers", "report", "times"),
    [
        (prediction, report_document, 8),
        (calibration, calibration_document, 6),
        (camera_check, camera_check_document, 3),
    ],
)
def test_a_report_shows_names_as_they_are(numbers, report, times):
    shown = [content for _, content in rendered(render_markdown(report(numbers())))]
    assert sum(content.count(BAD) for content in shown) == times


@pytest.mark.parametrize(
    ("numbers", "show", "times"),
    [
        (prediction, summary_document, 4),
        (prediction, lambda numbers: verdict_document(numbers, "out/report.html"), 3),
        (calibration, calibration_summary, 6),
        (camera_check, camera_check_summary, 3),
    ],
)
def test_the_terminal_shows_names_as_they_are(numbers, show, times, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    print_document(show(numbers()))
    assert capsys.readouterr().out.count(BAD) == times


def test_a_dollar_in_a_camera_s_name_is_no_formula():
    rig = Cameras(
        torch.eye(3).double()[None] * torch.tensor([500.0, 500, 1]).double(),
        torch.eye(3).double()[None],
        torch.zeros(1, 3).double(),
    )
    same = Similarity(torch.eye(3).double(), 1.0, torch.zeros(3).double())
    points, estimated = torch.zeros(1, 17, 3).double(), torch.zeros(1, 17).bool()
    drawn = DrawnRig(
        (r"$\b$",), rig, (DrawnPerson(points, estimated),), torch.zeros(1, 6, 6).double()
    )
    figure = rig_figure(r"$\a$", drawn, same)
    FigureCanvasAgg(figure).draw()
    assert np.isfinite(figure.get_size_inches()).all()
