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
from torch import Tensor

from ghpt.calibration.rig import RigEstimate
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.files import atomic_write, finite, remove, write_json
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.observations import Recording
from ghpt.report.calibration import calibration_report
from ghpt.report.rig_comparison import Similarity, align, upright
from ghpt.report.rig_figure import rig_figure
from ghpt.skeleton import JOINTS

RIG_FILES = ("rig.toml", "rig_anipose.toml", "intri.yml", "extri.yml", "poses.npz")
"""What is written of a usable rig alone."""


def camera_numbers(
    estimate: RigEstimate, moved: Cameras, gauge: Similarity, file: CameraSet
) -> list[dict[str, Any]]:
    """For each camera what calibration.json holds; ``moved``: the cameras after ``gauge``, in the
    files' world.
    """
    covariance = gauge.covariance(estimate.covariance)
    turn = estimate.rotation_std_deg
    centre = gauge.scale * estimate.centre_std
    numbers = []
    for v, name in enumerate(estimate.names):
        camera: dict[str, Any] = {"name": name, "calibrated": bool(estimate.calibrated[v])}
        values = {
            "reprojection_px": estimate.reprojection[v],
            "inliers": estimate.inliers[v],
            "rotation_sd_deg": turn[v],
            "centre_sd_mm": centre[v],
            "R": moved.R[v],
            "t_mm": moved.t[v],
            "centre_mm": moved.centre[v],
            "covariance": covariance[v],
        }
        camera |= {
            key: value.tolist() if camera["calibrated"] else None for key, value in values.items()
        }
        size = None if file.size is None else file.size[v].tolist()
        numbers.append(
            camera
            | {"K": file.K[v].tolist(), "distortion": file.distortion[v].tolist(), "size": size}
        )
    return numbers


def write_rig(output: Path, file: CameraSet, cameras: Cameras, numbers: dict[str, Any]) -> None:
    """The calibrated cameras for Pose2Sim, aniposelib, OpenCV and EasyMocap.

    An image size that the user's file does not give is left out of the yml files; in the TOML
    files, which must have one, it is twice the principal point, and the metadata say so.
    """
    metadata = {
        "adjusted": False,
        "error": max(c["reprojection_px"] or 0.0 for c in numbers["cameras"]),
        "data": numbers["data"],
        "scale": numbers["scale"]["text"],
        "world": numbers["world"],
        "software": f"ghpt {numbers['provenance']['ghpt']}",
    }
    if file.size is None:
        metadata["size"] = "not known: twice the principal point"
    rig = file.with_cameras(cameras)
    write_pose2sim(output / "rig.toml", rig, metadata)
    write_aniposelib(output / "rig_anipose.toml", rig, metadata)
    write_opencv(output, rig)


def write_poses(
    path: Path,
    recording: Recording,
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    numbers: dict[str, Any],
) -> None:
    """The recording's 3D joints: mm, NaN where not estimated."""
    values = torch.where(estimated[..., None], points, torch.nan).double().numpy()
    meta = {
        key: numbers[key]
        for key in ("data", "source", "scale", "world", "triangulation", "usable", "provenance")
    }
    text = json.dumps(finite(meta), allow_nan=False)
    with atomic_write(path) as handle:
        np.savez_compressed(
            handle,
            points=values,
            estimated=estimated.numpy(),
            frame=recording.frame,
            joints=np.array(JOINTS),
            rate_hz=np.array(recording.rate_hz),
            unit=np.array("mm"),
            meta=np.array(text),
        )


def write_rig_figure(
    output: Path,
    numbers: dict[str, Any],
    cameras: Cameras,
    covariance: Float[Tensor, "V 6 6"],
    points: Float[Tensor, "T J 3"],
    estimated: Bool[Tensor, "T J"],
    calibrated: Bool[Tensor, " V"],
    reference: tuple[str, Cameras] | None,
) -> None:
    """rig.png and rig.svg of the calibrated cameras, and of a reference's brought onto them by
    ``align``.
    """
    if not bool(calibrated.any()):
        for name in ("rig.png", "rig.svg"):
            remove(output / name)
        return
    shown = cameras.index(calibrated)
    names = tuple(camera["name"] for camera in numbers["cameras"] if camera["calibrated"])
    heading = f"Calibration of {numbers['data']}\nscale {numbers['scale']['text']}"
    other = None
    name = ""
    if reference is not None and int(calibrated.sum()) >= 2:
        own = reference[1].index(calibrated)
        other = align(own, shown).cameras(own)
        name = f"{reference[0]}, at this scale"
    up = upright(points, estimated, shown)
    figure = rig_figure(
        heading, names, shown, covariance[calibrated], points, estimated, up, other, name
    )
    for suffix, canvas in (("png", FigureCanvasAgg), ("svg", FigureCanvasSVG)):
        data = io.BytesIO()
        canvas(figure).print_figure(data, dpi=150, format=suffix)
        with atomic_write(output / f"rig.{suffix}") as handle:
            handle.write(data.getvalue())


def write_numbers(output: Path, numbers: dict[str, Any]) -> None:
    """calibration.json and report.md."""
    write_json(output / "calibration.json", numbers)
    with atomic_write(output / "report.md", "w") as handle:
        handle.write(calibration_report(numbers))
