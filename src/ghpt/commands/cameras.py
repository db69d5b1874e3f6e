"""The camera doctor: what is wrong with a calibration, from the people in view, and the mended
files.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ghpt.calibration.check.breakages import BREAKAGES
from ghpt.calibration.check.evidence import Evidence, choose, gather
from ghpt.calibration.check.examination import Checkup, Doctor
from ghpt.calibration.check.mending import MENDED, write_mended
from ghpt.calibration.check.setup import Setup, as_filed
from ghpt.calibration.check.units import UNITS_MM
from ghpt.commands.app import Command
from ghpt.commands.calibrate import people_note
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.inputs import (
    find_recording,
    input_settings,
    own_cameras,
    own_people,
    own_sequence,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.train import display_path
from ghpt.config import build, check_type, suggest
from ghpt.data.people.sequence import Sequence
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.files import atomic_write, remove, sweep_temporaries, write_json
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import distort
from ghpt.observations import Recording
from ghpt.provenance import provenance
from ghpt.report.escape import escaped, plain
from ghpt.report.tables import display_name, markdown

_log = logging.getLogger(__name__)
_HEADER = ["camera", "error px", "mended px"]


class Settings(TypedDict):
    """What `examine` needs of the configuration beside the input."""

    spoil: str | None
    doctor: dict[str, Any]
    seed: int


@dataclass(frozen=True)
class Patient:
    """What is examined."""

    title: str
    source: str
    evidence: Evidence
    cameras: CameraSet
    setup: Setup
    sequence: Sequence | None
    """The user's key points; None for a demonstration."""


def files(config: dict[str, Any]) -> Files:
    """What an examination reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    check_apart(config)
    return Files(input_paths(config), (*MENDED, "checkup.json", "report.md"))


def examine(config: dict[str, Any], output: Path) -> dict[str, Any]:
    """Examine the cameras of ``config["cameras"]`` with ``config["keypoints"]``, or a recording of
    ``config["data"]``.

    Writes checkup.json and report.md into ``output`` and, of what can be mended, ``MENDED``; prints
    what is wrong. Raises GhptDataError after writing if anything is. Returns what checkup.json
    holds.
    """
    check_type(config, Settings, "")
    doctor = build(config["doctor"], "doctor")
    patient = from_files(config, doctor) if config["keypoints"] else from_data(config, doctor)
    sweep_temporaries(output)
    for name in MENDED:  # of an earlier run
        remove(output / name)
    checkup = doctor(patient.evidence, patient.setup)
    numbers = _numbers(patient, checkup) | {"provenance": provenance(config["seed"])}
    mended = any(finding.mended for finding in checkup.findings)
    if mended:
        write_mended(output, patient.cameras, checkup, patient.sequence)
    write_json(output / "checkup.json", numbers)
    with atomic_write(output / "report.md", "w") as handle:
        handle.write(report(numbers))
    _print(numbers)
    _log.info(
        "Report: %s%s.", display_path(output / "report.md"), ", beside it the mended files" * mended
    )
    if checkup.findings:
        raise GhptDataError(
            patient.source,
            "cameras",
            summary(numbers),
            f"See {display_path(output / 'report.md')}.",
        )
    return numbers


def summary(numbers: dict[str, Any]) -> str:
    """What `examine` found, in words."""
    found = [
        f"{' and '.join(f['cameras']) or 'all cameras'}: {f['code']}" for f in numbers["findings"]
    ]
    return ", ".join(found) or f"{numbers['title']}: nothing wrong"


def from_files(config: Mapping[str, Any], doctor: Doctor) -> Patient:
    """The user's own key points and cameras."""
    if config["spoil"]:
        raise GhptConfigError(
            "spoil", "is for demonstrations", "Leave it out, or leave out keypoints."
        )
    inputs = input_settings(config)
    file = own_cameras(inputs, "Calib.toml")
    people = own_people(inputs)
    sequence = own_sequence(inputs, people, file, person=None, check_sizes=False)
    evidence = gather(sequence, doctor.frames, doctor.shift)
    cameras = sequence.cameras
    for note in people_note(people):
        _log.warning(note.text)
    title = f"{Path(config['cameras']).name} with {Path(config['keypoints']).resolve().name}"
    return Patient(title, str(config["cameras"]), evidence, cameras, as_filed(cameras), sequence)


def from_data(config: Mapping[str, Any], doctor: Doctor) -> Patient:
    """A synthetic recording, spoilt on request."""
    if config["data"]["root"] is not None:
        raise GhptConfigError(
            "data.root",
            "is a data set on disk",
            "Give keypoints and cameras, or the synthetic data.",
        )
    data, found = find_recording(input_settings(config))
    evidence, cameras = from_recording(found, data, doctor, len(found))
    setup = as_filed(cameras)
    if config["spoil"]:
        if config["spoil"] not in BREAKAGES:
            raise GhptConfigError(
                "spoil", f"there is no {config['spoil']!r}", suggest(config["spoil"], BREAKAGES)
            )
        evidence, setup = BREAKAGES[config["spoil"]].spoil((evidence, setup))
    title = (
        f"{found.name} of {display_name(data.name, data.source)}"
        + f", spoilt: {config['spoil']}" * bool(config["spoil"])
    )
    return Patient(title, data.source, evidence, cameras, setup, None)


def from_recording(
    recording: Recording, data: Any, doctor: Doctor, frames: int
) -> tuple[Evidence, CameraSet]:
    """The middle ``frames`` frames of a synthetic recording, as its rig's lenses show them."""
    rig = human36m_rig(recording.subject) if data.name == "h36m" else panoptic_rig(data.cameras)
    first = max(0, (len(recording) - frames) // 2)
    rows = slice(first, first + frames)
    straight = torch.from_numpy(recording.key_points[rows].astype(np.float64)).transpose(0, 1)
    pixels = (
        distort(straight.flatten(1, 2), rig.cameras.K, rig.distortion)
        .reshape(straight.shape)
        .transpose(0, 1)
    )
    file = replace(rig, path=recording.name)
    valid = np.array(recording.valid[rows])
    frame = np.array(recording.frame[rows])
    return choose(
        rig.names, pixels.numpy(), valid, frame, doctor.frames, doctor.shift, recording.name
    ), file


def report(numbers: dict[str, Any]) -> str:
    """The Markdown report."""
    findings = "\n".join(f"- **{f['code']}**: {escaped(_sentence(f))}" for f in numbers["findings"])
    return (
        "\n\n".join(
            [
                f"# Check-up of {escaped(numbers['title'])}",
                f"{numbers['frames']} frames, {len(numbers['cameras'])} views. {_stature(numbers)}",
                "## Findings",
                findings or "Nothing is wrong.",
                "## Cameras",
                markdown(_HEADER, _rows(numbers)),
                "Each view's key points against the joints that the other views triangulate: median distance, pixels, as the "
                "files have it and with everything mended that can be.",
            ]
        )
        + "\n"
    )


def _numbers(patient: Patient, checkup: Checkup) -> dict[str, Any]:
    errors = zip(
        patient.evidence.names, checkup.given_px.tolist(), checkup.error_px.tolist(), strict=True
    )
    return {
        "title": patient.title,
        "source": patient.source,
        "frames": len(patient.evidence.frame),
        "stature_mm": checkup.stature or None,
        "unit_mm": checkup.unit_mm,
        "findings": [vars(finding) for finding in checkup.findings],
        "cameras": [
            {"name": name, "error_px": given, "mended_px": after} for name, given, after in errors
        ],
    }


def _print(numbers: dict[str, Any]) -> None:
    console = Console()
    title = plain(f"Check-up of {numbers['title']}", "table.title")
    table = Table(
        title=title,
        caption="median error against the other views",
        title_justify="left",
        caption_justify="left",
    )
    for i, column in enumerate(_HEADER):
        table.add_column(column, justify="right" if i else "left")
    for row in _rows(numbers):
        table.add_row(*map(plain, row))
    console.print(table)
    console.print(_stature(numbers), highlight=False)
    for finding in numbers["findings"]:
        line = Text.assemble((finding["code"], "red"), ": ", plain(_sentence(finding)))
        console.print(line, soft_wrap=True)
    if not numbers["findings"]:
        console.print("Nothing is wrong.", highlight=False)


def _rows(numbers: dict[str, Any]) -> list[list[str]]:
    return [
        [c["name"], f"{c['error_px']:.1f}", f"{c['mended_px']:.1f}"] for c in numbers["cameras"]
    ]


def _sentence(finding: Mapping[str, Any]) -> str:
    before = finding["before_px"]
    after = finding["after_px"]
    if not before:
        return f"{finding['text']}."
    return f"{finding['text']} ({before:.1f} px" + (
        f", then {after:.1f} px)." if finding["mended"] else ")."
    )


def _stature(numbers: dict[str, Any]) -> str:
    height = numbers["stature_mm"]
    unit = numbers["unit_mm"]
    if not height:
        return "The person's size cannot be told."
    said = f"The person measures {height / 1000:.2f} m"
    return (
        f"{said}, which tells the file's unit: {UNITS_MM[unit]} (unit_mm={unit:g})."
        if unit
        else f"{said}."
    )


COMMAND = Command(name="cameras", settings=dict, task=examine, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("cameras")
