"""The camera check: what is wrong with a calibration, from the people in view, and the mended
files.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure as DrawnFigure

from ghpt.calibration.check.breakages import BREAKAGES
from ghpt.calibration.check.breakages import Case as SpoiltCase
from ghpt.calibration.check.camera_check import CameraCheck, CameraCheckResult
from ghpt.calibration.check.evidence import Evidence, choose, gather
from ghpt.calibration.check.mended_files import (
    CAMERAS_FILE,
    KEY_POINTS_FILE,
    MENDED,
    write_mended,
)
from ghpt.calibration.check.recording_time import in_one_time
from ghpt.calibration.check.setup import Setup, setup_of
from ghpt.calibration.findings import Finding
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.inputs import (
    InputSettings,
    find_recording,
    own_cameras,
    own_people,
    own_sequence,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.next_commands import commands_on, prediction_by
from ghpt.commands.time import clock_of
from ghpt.config import Target, build, suggest
from ghpt.data.people.retimed import retime
from ghpt.data.people.sequence import Sequence as PersonSequence
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.errors import GhptConfigError, GhptDataError, check
from ghpt.files import remove, sweep_temporaries, write_json
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.lens import distort
from ghpt.geometry.state import State
from ghpt.geometry.upright import upright
from ghpt.observations import Recording
from ghpt.provenance import provenance
from ghpt.report.camera_check import (
    CameraReport,
    CheckedCamera,
    camera_check_document,
    camera_check_summary,
)
from ghpt.report.course_figure import ViewCourse, check_figure
from ghpt.report.document import Block, Figure, Heading, Paragraph
from ghpt.report.html import write_html
from ghpt.report.markdown import write_markdown
from ghpt.report.rig_figure import DrawnPerson, DrawnRig, rig_figure
from ghpt.report.tables import display_name
from ghpt.report.terminal import print_document
from ghpt.skeleton import JOINTS

_RIG = "rig"
_COURSE = "course"
_GIVEN = "as the file has them"
_MENDED_LABEL = "mended"
_PICTURES: tuple[Block, ...] = (
    Heading("Who is where"),
    Figure(_RIG, "cameras and the person from above and from the side"),
    Heading("Over time"),
    Paragraph(
        "A view that is dark throughout has a wrong camera, or a detector that errs in it; one "
        "that becomes dark has moved or lost its place in time; a dark column is a moment in which "
        "the views disagree. Below are the joints that the agreeing views give together."
    ),
    Figure(_COURSE, "errors of the views and states of the joints over time"),
)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CamerasSettings(InputSettings):
    """The settings of cameras.py."""

    spoil: str | None
    camera_check: Target
    seed: int

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.spoil is None:
            return
        hint = "Leave it out, or leave out keypoints."
        check(not self.keypoints, "spoil", "is for demonstrations", hint)
        problem = f"there is no {self.spoil!r}"
        check(self.spoil in BREAKAGES, "spoil", problem, suggest(self.spoil, BREAKAGES))


@dataclass(frozen=True)
class Subject:
    """What is checked."""

    title: str
    source: str
    evidence: Evidence
    cameras: CameraSet
    setup: Setup
    sequence: PersonSequence | None
    """The user's key points, in one time; None for a demonstration."""
    time: tuple[Finding, ...] = ()
    """What was wrong with their time."""
    given_px: tuple[float, ...] = ()
    """The held-out error of each view before that was undone; empty where nothing was."""


def files(settings: CamerasSettings) -> Files:
    """Return what a check reads and writes."""
    check_apart(settings.keypoints, settings.output)
    reads = input_paths(settings.cameras, settings.keypoints, settings.data.get("root"))
    return Files(reads, (*MENDED, "cameras.json", "report.md", "report.html"))


def check_cameras(settings: CamerasSettings, output: Path) -> CameraReport:
    """Check the user's cameras, or those of a recording of the data set.

    Writes cameras.json and report.md into ``output`` and, of what can be mended, `MENDED`; prints
    what is wrong. Raises GhptDataError after writing if anything is. Returns what cameras.json
    holds.
    """
    camera_check: CameraCheck = build(settings.camera_check, "camera_check")
    opened = own_subject if settings.keypoints else demonstration
    subject = opened(settings, camera_check)
    sweep_temporaries(output)
    for name in MENDED:  # of an earlier run
        remove(output / name)
    result = camera_check(subject.evidence, subject.setup)
    found = (*subject.time, *result.findings)
    mended = any(finding.mended for finding in found)
    if mended:
        write_mended(output, subject.cameras, result, subject.sequence, subject.time)
    report = _report(subject, result, settings.seed, _next_command(settings, found, output))
    write_json(output / "cameras.json", report.plain())
    write_markdown(output / "report.md", camera_check_document(report))
    figures = {
        _RIG: _rig_figure(subject, result, mended),
        _COURSE: _course_figure(subject, result, mended),
    }
    write_html(output / "report.html", camera_check_document(report, _PICTURES), figures)
    print_document(camera_check_summary(report))
    path = display_path(output / "report.html")
    _log.info("Report: %s%s.", path, ", beside it the mended files" if mended else "")
    if report.findings:
        hint = f"See {path}. Next: {report.command}"
        raise GhptDataError(subject.source, "cameras", summary(report), hint)
    return report


def _next_command(settings: CamerasSettings, found: Sequence[Finding], output: Path) -> str:
    """Return what to type once the cameras are checked: predict where they are good or mended."""
    if not found or settings.spoil:
        return prediction_by(settings, output)
    if all(finding.mended for finding in found):
        written = {"cameras": output / CAMERAS_FILE, "keypoints": output / KEY_POINTS_FILE}
        files = {name: path for name, path in written.items() if path.exists()}
        return prediction_by(settings, output, **files)
    return commands_on(settings, {}, output).calibrate


def _rig_figure(subject: Subject, result: CameraCheckResult, mended: bool) -> DrawnFigure:
    """Return the figure of the cameras, beside them as the file has them where some are mended."""
    setup = result.setup
    cameras = Cameras(setup.K, setup.R, setup.t)
    label = _MENDED_LABEL if mended else _GIVEN
    person = DrawnPerson(result.points, result.estimated)
    rig = DrawnRig(subject.evidence.names, cameras, (person,), label=label)
    given = subject.setup
    ratio = (setup.t.norm(dim=-1) / given.t.norm(dim=-1).clamp(min=1e-9)).median()
    reference = Cameras(given.K, given.R, ratio * given.t) if mended else None
    up = upright(result.points, result.estimated, cameras)
    return rig_figure("", rig, up, reference, _GIVEN)


def _course_figure(subject: Subject, result: CameraCheckResult, mended: bool) -> DrawnFigure:
    """Return the figure of the views' errors over time, also after mending where some are mended,
    and of the joints.
    """
    evidence = subject.evidence
    frame = evidence.frame.double().numpy()
    views = {_GIVEN: ViewCourse(evidence.names, frame, result.given_course_px.numpy())}
    if mended:
        views[_MENDED_LABEL] = ViewCourse(evidence.names, frame, result.course_px.numpy())
    seen = evidence.valid[:, evidence.max_shift].sum(0) >= 2
    missing = torch.where(seen, int(State.REJECTED), int(State.FEW_VIEWS))
    state = torch.where(result.estimated, int(State.OBSERVED), missing).to(torch.int8)
    rate_hz = None if subject.sequence is None else subject.sequence.rate_hz
    return check_figure(views, JOINTS, state.numpy(), rate_hz)


def summary(report: CameraReport) -> str:
    """Return what was found, in words."""
    found = [
        f"{' and '.join(finding.cameras) or 'all cameras'}: {finding.code}"
        for finding in report.findings
    ]
    return ", ".join(found) or f"{report.title}: nothing wrong"


def own_subject(settings: CamerasSettings, camera_check: CameraCheck) -> Subject:
    """Return the user's own key points and cameras."""
    cameras = own_cameras(settings, "Calib.toml")
    people = own_people(settings)
    sequence = own_sequence(settings, people, cameras, person=None, check_sizes=False)
    clock = clock_of(settings.time, sequence, camera_check.time)
    timed = in_one_time(retime(sequence, clock), camera_check)
    evidence = gather(timed.sequence, camera_check.frames, camera_check.shift)
    key_points = Path(str(settings.keypoints)).resolve().name
    return Subject(
        title=f"{Path(str(settings.cameras)).name} with {key_points}",
        source=str(settings.cameras),
        evidence=evidence,
        cameras=sequence.cameras,
        setup=setup_of(sequence.cameras),
        sequence=timed.sequence,
        time=timed.findings,
        given_px=timed.given_px,
    )


def demonstration(settings: CamerasSettings, camera_check: CameraCheck) -> Subject:
    """Return a synthetic recording, spoilt on request."""
    if settings.data.get("root") is not None:
        hint = "Give keypoints and cameras, or the synthetic data."
        raise GhptConfigError("data.root", "is a data set on disk", hint)
    data, recording = find_recording(settings)
    evidence, cameras = synthetic_evidence(recording, data, camera_check, len(recording))
    case = SpoiltCase(evidence, setup_of(cameras))
    title = f"{recording.name} of {display_name(data.name, data.source)}"
    if settings.spoil is not None:
        case = BREAKAGES[settings.spoil].spoil(case)
        title += f", spoilt: {settings.spoil}"
    return Subject(title, data.source, case.evidence, cameras, case.setup, None)


def synthetic_evidence(
    recording: Recording, data: Any, camera_check: CameraCheck, frames: int
) -> tuple[Evidence, CameraSet]:
    """Return the middle ``frames`` frames of a synthetic recording, as its rig's lenses show them,
    and the rig.
    """
    rig = human36m_rig(recording.subject) if data.name == "h36m" else panoptic_rig(data.cameras)
    first = max(0, (len(recording) - frames) // 2)
    rows = slice(first, first + frames)
    ideal = torch.from_numpy(recording.key_points[rows].astype(np.float64)).transpose(0, 1)
    distorted = distort(ideal.flatten(1, 2), rig.K, rig.distortion)
    pixels = distorted.reshape(ideal.shape).transpose(0, 1)
    evidence = choose(
        rig.names,
        pixels.numpy(),
        np.array(recording.valid[rows]),
        np.array(recording.frame[rows]),
        camera_check.frames,
        camera_check.shift,
        recording.name,
    )
    return evidence, replace(rig, path=recording.name)


def _report(subject: Subject, result: CameraCheckResult, seed: int, command: str) -> CameraReport:
    given = subject.given_px or result.given_px.tolist()
    mended = result.error_px.tolist()
    names = subject.evidence.names
    cameras = [CheckedCamera(*each) for each in zip(names, given, mended, strict=True)]
    return CameraReport(
        title=subject.title,
        source=subject.source,
        frames=len(subject.evidence.frame),
        stature_mm=result.stature or None,
        unit_mm=result.unit_mm,
        findings=(*subject.time, *result.findings),
        cameras=tuple(cameras),
        provenance=provenance(seed),
        command=command,
    )


COMMAND = Command(
    name="cameras", settings=CamerasSettings, task=check_cameras, summary=summary, files=files
)


if __name__ == "__main__":
    run_by_name("cameras")
