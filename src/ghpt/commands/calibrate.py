"""Calibration: from key points and intrinsics to a rig in the formats that others read."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.calibration.check.units import decide_unit
from ghpt.calibration.diagnosis import Diagnosis
from ghpt.calibration.millimetres import in_millimetres, of_scale, read_scale
from ghpt.calibration.rig import RigEstimate
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.inputs import InputSettings, own_cameras, own_key_points, recording_of
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.frames import MEASURED, frames_of_views
from ghpt.commands.train import display_path
from ghpt.config import build, check_type, suggest
from ghpt.data.formats.key_points import KeyPoints
from ghpt.data.formats.names import Name
from ghpt.data.people.views import Views, undistort_and_match
from ghpt.errors import GhptDataError, check
from ghpt.files import remove, sweep_temporaries
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.models.estimators.classical import Baseline
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
from ghpt.report.tables import display_name

_log = logging.getLogger(__name__)


class Scale(TypedDict):
    """What gives millimetres."""

    height: float | None
    segments: dict[str, Any] | None
    baseline: list[Name] | None
    assumed_height: float


class Settings(InputSettings):
    """What `calibrate` needs of the configuration."""

    scale: Scale
    calibration: dict[str, Any]
    baselines: dict[str, Any]
    triangulation: str
    evaluated_frames: int
    seed: int


@dataclass(frozen=True)
class Case:
    """What is calibrated, and what it can be compared with."""

    title: str
    source: str
    views: Views
    reference: str
    """What ``views.cameras.cameras``, where there are any, are: never used but for the comparison
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
    cameras = case.views.cameras
    views = case.views
    lengths = read_scale(config["scale"], cameras.names)
    sweep_temporaries(output)
    for name in RIG_FILES:  # of an earlier run: they must not pass for this one's
        remove(output / name)

    estimate: RigEstimate = calibration(
        cameras.names,
        cameras.K,
        torch.from_numpy(views.key_points).double(),
        torch.from_numpy(views.confidence).double(),
        torch.from_numpy(views.valid),
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
        "data": case.title,
        "source": case.source,
        "cameras_file": cameras.path,
        "frames": len(views),
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
    points = gauge.points(estimate.points)
    estimated = estimate.estimated
    if chosen:
        recording = _through(case, chosen, moved)
        points, estimated = triangulate_recording(recording, estimator)
        write_rig(output, cameras.select(chosen), moved.index(chosen), numbers)
        write_poses(output / "poses.npz", recording, points, estimated, numbers)
    reference = (case.reference, cameras.cameras) if cameras.calibrated else None
    covariance = gauge.covariance(estimate.covariance)
    write_rig_figure(
        output, numbers, moved, covariance, points, estimated, estimate.calibrated, reference
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
            case.source,
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
    """The user's own key points and cameras."""
    cameras = own_cameras(config, "intrinsics.toml")
    points = own_key_points(config)
    views = undistort_and_match(points, cameras, config["match"], config["views"])
    title = f"{Path(config['keypoints']).resolve().name} with {Path(config['cameras']).name}"
    return Case(
        title,
        str(Path(config["keypoints"]).resolve()),
        views,
        "the file's own calibration",
        people_note(points),
    )


def in_unit(case: Case, estimator: Baseline) -> Case:
    """With the file's own extrinsics in mm where the person tells their unit: they are compared
    with.
    """
    file = case.views.cameras
    if file.unit_known or not file.calibrated or len(file) < 2:
        return case
    frames = frames_of_views(case.views, case.source, case.title)
    file = decide_unit(file, frames.batch(frames.spread(MEASURED)), estimator, ask=False)
    return replace(case, views=replace(case.views, cameras=file))


def people_note(points: KeyPoints) -> tuple[Diagnosis, ...]:
    """A warning where one of several people was followed."""
    several = {view: n for view, n in zip(points.views, points.several, strict=True) if n}
    if not several:
        return ()
    text = "several people in " + ", ".join(f"{n} frames of {view}" for view, n in several.items())
    text += "; the one tracked best in each view was followed, and must be the same person in all"
    return (
        Diagnosis("several_people", "warning", tuple(several), text, float(max(several.values()))),
    )


def from_data(config: Mapping[str, Any]) -> Case:
    """One recording of a data set, whose true extrinsics serve the comparison alone."""
    data, found = recording_of(config)
    file = CameraSet.from_cameras(found.camera_names, found.cameras, path=data.source)
    arrays = (
        np.array(getattr(found, field)) for field in ("key_points", "confidence", "valid", "frame")
    )
    views = Views(file, *arrays, found.rate_hz)
    return Case(
        f"{found.name} of {display_name(data.name, data.source)}", data.source, views, "the truth"
    )


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
    return case.views.part(views).recording(case.title, cameras.index(views))


COMMAND = Command(name="calibrate", settings=dict, task=calibrate, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("calibrate")
