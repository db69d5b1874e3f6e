"""Calibration: from key points and intrinsics to a rig in the formats that others read."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.calibration.diagnosis import Diagnosis
from ghpt.calibration.millimetres import in_millimetres, of_scale, read_scale
from ghpt.calibration.rig import RigEstimate
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.inputs import (
    input_settings,
    own_cameras,
    own_people,
    own_sequence,
    recording_sequence,
    resolve_unit,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.train import display_path
from ghpt.config import build, check_type, suggest
from ghpt.data.formats.names import Name
from ghpt.data.people.detections import Detections
from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError, check
from ghpt.files import remove, sweep_temporaries
from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import MEASURED_FRAMES
from ghpt.observations import Recording
from ghpt.provenance import provenance
from ghpt.report.calibration import differences, explains, print_calibration, spread
from ghpt.report.rig_comparison import Similarity, align, triangulate_recording, upright
from ghpt.report.rig_files import (
    RIG_FILES,
    camera_numbers,
    write_numbers,
    write_poses,
    write_rig,
    write_rig_figure,
)

_log = logging.getLogger(__name__)


class Scale(TypedDict):
    """What gives millimetres."""

    height: float | None
    segments: dict[str, Any] | None
    baseline: list[Name] | None
    assumed_height: float


class Settings(TypedDict):
    """What `calibrate` needs of the configuration beside the input."""

    scale: Scale
    calibration: dict[str, Any]
    baselines: dict[str, Any]
    triangulation: str
    evaluated_frames: int
    seed: int


@dataclass(frozen=True)
class Case:
    """What is calibrated, and what it can be compared with."""

    sequence: Sequence
    reference: str
    """What the extrinsics of ``sequence.cameras``, where there are any, are: never used but for the comparison
    and the gauge.
    """
    notes: tuple[Diagnosis, ...] = ()


def files(config: dict[str, Any]) -> Files:
    """What a calibration reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    check_apart(config)
    names = ("calibration.json", "report.md", "rig.png", "rig.svg")
    return Files(input_paths(config), (*RIG_FILES, *names))


def calibrate(config: dict[str, Any], output: Path) -> dict[str, Any]:
    """Calibrate the cameras of ``config["keypoints"]``, or of a recording of ``config["data"]``.

    Writes calibration.json, report.md and the figure into ``output``, and of a usable rig
    ``RIG_FILES``; prints the table. Raises GhptDataError after writing if a diagnosis is an error:
    then only the cameras that it does not concern are in the rig's files, and with fewer than two
    there are none. Returns what calibration.json holds.
    """
    check_type(config, Settings, "")
    check(config["evaluated_frames"] >= 1, "evaluated_frames", "is not positive", "Give 1 or more.")
    check(
        config["triangulation"] in config["baselines"],
        "triangulation",
        f"is {config['triangulation']!r}",
        suggest(config["triangulation"], config["baselines"]),
    )
    calibration = build(config["calibration"], "calibration")
    estimator = build(
        config["baselines"][config["triangulation"]], f"baselines.{config['triangulation']}"
    )
    case = in_unit(from_files(config), estimator) if config["keypoints"] else from_data(config)
    cameras = case.sequence.cameras
    points = case.sequence.undistorted()
    lengths = read_scale(config["scale"], cameras.names)
    sweep_temporaries(output)
    for name in RIG_FILES:  # of an earlier run: they must not pass for this one's
        remove(output / name)

    estimate: RigEstimate = calibration(
        cameras.names,
        cameras.K,
        torch.from_numpy(points.pixels).double(),
        torch.from_numpy(points.confidence).double(),
        torch.from_numpy(points.valid),
        cameras.size,
        config["seed"],
    )
    placed = (
        torch.nonzero(estimate.calibrated)[:, 0].tolist()
        if int(estimate.calibrated.sum()) >= 2
        else []
    )

    def measure(rig: Cameras) -> tuple[Tensor, Tensor]:
        used = torch.nonzero(usable_cameras(estimate))[:, 0].tolist() or placed
        recording = spread(_through(case, used, rig), MEASURED_FRAMES)
        return triangulate_recording(recording, estimator)

    estimate, scale = in_millimetres(estimate, lengths, measure)
    chosen = torch.nonzero(usable_cameras(estimate))[:, 0].tolist()
    world, gauge = _gauge(
        estimate, placed, cameras.cameras if cameras.calibrated else None, case.reference
    )
    moved = gauge.cameras(estimate.cameras)
    rigs = {"estimated": moved} | ({case.reference: cameras.cameras} if cameras.calibrated else {})
    seen_by = {name: _through(case, placed, rig) for name, rig in rigs.items() if placed}
    numbers = {
        "data": case.sequence.title,
        "source": case.sequence.source,
        "cameras_file": cameras.path,
        "frames": len(case.sequence),
        "seed": config["seed"],
        "scale": scale,
        "world": world,
        "reference": case.reference if len(rigs) > 1 else None,
        "triangulation": config["triangulation"],
        "converged": estimate.converged,
        "usable": [cameras.names[v] for v in chosen],
        "cameras": camera_numbers(estimate, moved, gauge, cameras),
        "difference": differences(*seen_by.values()) if len(seen_by) > 1 else None,
        "explains": explains(seen_by, estimator, config["evaluated_frames"]),
        "diagnoses": [
            vars(found) for found in (*case.notes, *estimate.diagnoses, *of_scale(scale))
        ],
        "provenance": provenance(config["seed"]),
    }
    joints = gauge.points(estimate.points)
    estimated = estimate.estimated
    if chosen:
        recording = _through(case, chosen, moved)
        joints, estimated = triangulate_recording(recording, estimator)
        write_rig(output, cameras.select(chosen), moved.index(chosen), numbers)
        write_poses(output / "poses.npz", recording, joints, estimated, numbers)
    reference = (case.reference, cameras.cameras) if cameras.calibrated else None
    covariance = gauge.covariance(estimate.covariance)
    write_rig_figure(
        output, numbers, moved, covariance, joints, estimated, estimate.calibrated, reference
    )
    write_numbers(output, numbers)
    print_calibration(numbers)
    _log.info(
        "Report: %s, beside it the figure%s.",
        display_path(output / "report.md"),
        " and the rig" * bool(chosen),
    )
    errors = [d["text"] for d in numbers["diagnoses"] if d["severity"] == "error"]
    if errors:
        written = (
            f"only {', '.join(numbers['usable'])} are in the rig's files"
            if chosen
            else "no rig is written"
        )
        raise GhptDataError(
            case.sequence.source,
            "calibration",
            f"{errors[0].rstrip('.')}; {written}",
            f"See {display_path(output / 'report.md')}.",
        )
    return numbers


def summary(numbers: dict[str, Any]) -> str:
    """What `calibrate` returned, in words."""
    errors = [c["reprojection_px"] for c in numbers["cameras"] if c["calibrated"]]
    return f"{numbers['data']}: {len(errors)} cameras, {max(errors):.1f} px at most"


def from_files(config: Mapping[str, Any]) -> Case:
    """Return the user's own key points and cameras."""
    inputs = input_settings(config)
    cameras = own_cameras(inputs, "intrinsics.toml")
    people = own_people(inputs)
    sequence = own_sequence(inputs, people, cameras, person=None)
    return Case(sequence, "the file's own calibration", people_note(people))


def in_unit(case: Case, estimator: Estimator) -> Case:
    """Return the case with extrinsics in mm where the person tells their unit.

    They are what the calibration is compared with.
    """
    return replace(case, sequence=resolve_unit(case.sequence, estimator, ask=False))


def people_note(people: Detections) -> tuple[Diagnosis, ...]:
    """Return a warning where one of several people was followed."""
    crowded = people.crowded_frames()
    if not crowded:
        return ()
    frames = ", ".join(f"{count} frames of {view}" for view, count in crowded.items())
    text = (
        f"several people in {frames}; "
        "the one tracked best in each view was followed, and must be the same person in all"
    )
    most = float(max(crowded.values()))
    return (Diagnosis("several_people", "warning", tuple(crowded), text, most),)


def from_data(config: Mapping[str, Any]) -> Case:
    """Return one recording of a data set, whose true extrinsics serve the comparison alone."""
    return Case(recording_sequence(input_settings(config)), "the truth")


def usable_cameras(estimate: RigEstimate) -> Bool[Tensor, " V"]:
    """Calibrated cameras that no error concerns; an error that names none, or all, concerns all.
    Two or more.
    """
    usable = estimate.calibrated.clone()
    for found in estimate.diagnoses:
        if found.severity == "error":
            of = [estimate.names.index(name) for name in found.cameras if name in estimate.names]
            usable[of or slice(None)] = False
    return usable if int(usable.sum()) >= 2 else torch.zeros_like(usable)


def _gauge(
    estimate: RigEstimate, placed: list[int], reference: Cameras | None, name: str
) -> tuple[str, Similarity]:
    """The world that the rig is written in, in words, and the way there."""
    if reference is not None and placed:
        return f"that of {name}", align(
            estimate.cameras.index(placed), reference.index(placed), rigid=True
        )
    gauge = upright(
        estimate.points, estimate.estimated, estimate.cameras.index(placed or slice(None))
    )
    return (
        "z along the people's upright, x where the first camera looks, the floor at their lowest ankles",
        gauge,
    )


def _through(case: Case, views: list[int], cameras: Cameras) -> Recording:
    """Return the recording as a calibration of some of its cameras sees it."""
    sequence = case.sequence.select_views(views)
    points = sequence.undistorted()
    return Recording(
        name=sequence.title,
        subject=sequence.title,
        action="unknown",
        rate_hz=sequence.rate_hz or float("nan"),
        camera_names=sequence.cameras.names,
        cameras=cameras.index(views),
        key_points=points.pixels,
        confidence=points.confidence,
        valid=points.valid,
        frame=sequence.frame,
    )


COMMAND = Command(name="calibrate", settings=dict, task=calibrate, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("calibrate")
