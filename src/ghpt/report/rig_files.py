"""What a calibration leaves in its folder."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as DrawnFigure
from torch import Tensor

from ghpt.calibration.comparison import align_robustly
from ghpt.calibration.rig import RigEstimate
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.files import atomic_write, finite, remove, write_json
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.lens import is_fisheye
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.observations import Recording
from ghpt.report.calibration import (
    CalibratedCamera,
    CalibrationResult,
    calibration_document,
)
from ghpt.report.document import Block, Figure, Heading
from ghpt.report.html import write_html
from ghpt.report.markdown import write_markdown
from ghpt.report.rig_figure import DrawnRig, rig_figure
from ghpt.skeleton import JOINTS

RIG_FILES = ("rig.toml", "rig_anipose.toml", "intri.yml", "extri.yml", "poses.npz")
"""What is written of a usable rig alone."""
_RIG = "rig"
_PICTURES: tuple[Block, ...] = (
    Heading("The rig"),
    Figure(_RIG, "cameras with their uncertainty, and the person, from above and from the side"),
)
_FIGURES = {"rig.png": FigureCanvasAgg, "rig.svg": FigureCanvasSVG}


def calibrated_cameras(
    estimate: RigEstimate, world: Similarity, file: CameraSet
) -> tuple[CalibratedCamera, ...]:
    """Return the cameras of an estimate in another world.

    ``file``: the cameras whose intrinsics were calibrated with.
    """
    return tuple(_camera(estimate, world, file, view) for view in range(len(estimate.names)))


def _camera(
    estimate: RigEstimate, world: Similarity, file: CameraSet, view: int
) -> CalibratedCamera:
    rig = world.cameras(estimate.cameras)
    calibrated = bool(estimate.calibrated[view])

    def number(values: Tensor) -> Any:
        return values[view].tolist() if calibrated else None

    return CalibratedCamera(
        name=estimate.names[view],
        calibrated=calibrated,
        reprojection_px=number(estimate.reprojection),
        inliers=number(estimate.inliers),
        rotation_sd_deg=number(estimate.rotation_std_deg),
        centre_sd_mm=number(world.scale * estimate.centre_std),
        R=number(rig.R),
        t_mm=number(rig.t),
        centre_mm=number(rig.centre),
        covariance=number(world.covariance(estimate.covariance)),
        K=file.K[view].tolist(),
        distortion=file.distortion[view].tolist(),
        size=None if file.size is None else file.size[view].tolist(),
    )


def write_rig(output: Path, cameras: CameraSet, result: CalibrationResult) -> None:
    """Write calibrated cameras for Pose2Sim, aniposelib, OpenCV and EasyMocap.

    An image size that the user's file does not give is left out of the yml files; in the TOML
    files, which must have one, it is twice the principal point, and the metadata say so.
    """
    errors = [camera.reprojection_px or 0.0 for camera in result.cameras]
    metadata: dict[str, str | float | bool] = {
        "adjusted": False,
        "error": max(errors),
        "data": result.data,
        "scale": result.scale.text,
        "world": result.world,
        "software": f"ghpt {result.provenance['ghpt']}",
    }
    if cameras.size is None:
        metadata["size"] = "not known: twice the principal point"
    write_pose2sim(output / "rig.toml", cameras, metadata)
    write_aniposelib(output / "rig_anipose.toml", cameras, metadata)
    if not is_fisheye(cameras.distortion).any():
        write_opencv(output, cameras)


def write_poses(
    path: Path,
    recording: Recording,
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    result: CalibrationResult,
) -> None:
    """Write the recording's 3D joints: mm, NaN where not estimated."""
    meta = {
        "data": result.data,
        "source": result.source,
        "scale": result.scale.plain(),
        "world": result.world,
        "triangulation": result.triangulation,
        "usable": result.usable,
        "provenance": result.provenance,
    }
    values = torch.where(estimated[..., None], points, torch.nan).double().numpy()
    with atomic_write(path) as handle:
        np.savez_compressed(
            handle,
            points=values,
            estimated=estimated.numpy(),
            frame=recording.frame,
            joints=np.array(JOINTS),
            rate_hz=np.array(recording.rate_hz),
            unit=np.array("mm"),
            meta=np.array(json.dumps(finite(meta), allow_nan=False)),
        )


def write_result(
    output: Path,
    result: CalibrationResult,
    rig: DrawnRig,
    calibrated: Bool[Tensor, " V"],
    reference: Cameras | None,
) -> None:
    """Write calibration.json, report.md, report.html, and the figure as rig.png and rig.svg.

    The figure shows the calibrated cameras, and a reference's brought onto them by
    `align_robustly`; where no camera is calibrated there is none, and an earlier one is removed.
    """
    write_json(output / "calibration.json", result.plain())
    write_markdown(output / "report.md", calibration_document(result))
    if not bool(calibrated.any()):
        for name in _FIGURES:
            remove(output / name)
        write_html(output / "report.html", calibration_document(result), {})
        return
    figure = _draw_rig(result, rig.select(calibrated), calibrated, reference)
    write_html(output / "report.html", calibration_document(result, _PICTURES), {_RIG: figure})
    for name, canvas in _FIGURES.items():
        data = io.BytesIO()
        canvas(figure).print_figure(data, dpi=150, format=name.rpartition(".")[2])
        figure.set_layout_engine("none")  # it is laid out
        with atomic_write(output / name) as handle:
            handle.write(data.getvalue())


def _draw_rig(
    result: CalibrationResult,
    shown: DrawnRig,
    calibrated: Bool[Tensor, " V"],
    reference: Cameras | None,
) -> DrawnFigure:
    heading = f"Calibration of {result.data}\nscale {result.scale.text}"
    other = None
    if reference is not None and int(calibrated.sum()) >= 2:
        own = reference.index(calibrated)
        other = align_robustly(own, shown.cameras).cameras(own)
    (person,) = shown.people
    up = upright(person.points, person.estimated, shown.cameras)
    return rig_figure(heading, shown, up, other, f"{result.reference}, at this scale")
