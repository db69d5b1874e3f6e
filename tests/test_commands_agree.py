"""calibrate.py, cameras.py and predict.py say the same of one recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import sizes
from composed import calibrate_settings, cameras_settings
from ghpt.calibration.findings import Finding
from ghpt.commands.calibration.beside import check_reference
from ghpt.commands.calibration.case import open_case
from ghpt.commands.cameras import own_subject
from ghpt.commands.predict import predict
from ghpt.config import build
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.skeleton import MIRROR
from predicting import config
from test_verdict import NAMES, RIG, late, pixels, points_file

pytestmark = pytest.mark.usefixtures("blank_figures")

OF_THE_RESULT = ("left_out_error", "few_views_agree", "rejected", "little_observed")
"""What predict.py says of its own result."""
QUICK = ("camera_check.clean=0.004", "camera_check.frames=24", "camera_check.shift=12")
Said = set[tuple[str, tuple[str, ...]]]


def codes(findings: tuple[Finding, ...]) -> Said:
    return {(found.code, tuple(sorted(found.cameras))) for found in findings}


def said_by_calibrate(words: tuple[str, ...]) -> Said:
    settings = calibrate_settings(*words)
    estimator = build(settings.baselines[settings.estimator], "baselines")
    check = build(settings.camera_check, "camera_check")
    return codes(check_reference(open_case(settings, estimator), check))


def said_by_cameras(words: tuple[str, ...]) -> Said:
    settings = cameras_settings(*words)
    check = build(settings.camera_check, "camera_check")
    subject = own_subject(settings, check)
    return codes(check(subject.evidence, subject.setup).findings)


def said_by_predict(words: tuple[str, ...], folder: Path) -> Said:
    quick = ("camera_check.clean=0.004", "evaluated_frames=40", "fitted_frames=40", "formats=[npz]")
    estimator = "trajectory" if sizes.NIGHTLY else "frame"
    result = predict(config(*words, *quick, f"estimator={estimator}"), folder)
    assert result is not None
    assert result.verdict is not None
    said = codes(result.verdict.findings)
    return {(code, cameras) for code, cameras in said if code not in OF_THE_RESULT}


def rig_file(folder: Path, cameras: Cameras) -> Path:
    path = folder / "Calib.toml"
    write_pose2sim(path, CameraSet.from_cameras(NAMES, cameras, 0 * RIG.distortion, RIG.size), {})
    return path


def transposed(view: int) -> Cameras:
    R = RIG.cameras.R.clone()
    R[view] = RIG.cameras.R[view].T
    return Cameras(RIG.cameras.K, R, RIG.cameras.t)


def moved(view: int) -> Cameras:
    """A camera that was rotated by 4 degrees where it stands."""
    rotation = vector_to_matrix(torch.deg2rad(torch.tensor([0.0, 4.0, 0.0])).double())
    R = RIG.cameras.R.clone()
    t = RIG.cameras.t.clone()
    R[view] = rotation @ R[view]
    t[view] = rotation @ t[view]
    return Cameras(RIG.cameras.K, R, t)


def of_one_view(view: int, change) -> np.ndarray:
    values = pixels().copy()
    values[:, view] = change(values[:, view])
    return values


EXCHANGED = [2, 1, 0, 3]
GIANT = Cameras(RIG.cameras.K, RIG.cameras.R, 1000 * RIG.cameras.t)
MISTAKES = {
    "none": (pixels(), RIG.cameras, set()),
    "late": (late(pixels(), 3, 10), RIG.cameras, {("out_of_sync", ("cam_03",))}),
    "sides": (
        of_one_view(1, lambda own: own[:, list(MIRROR)]),
        RIG.cameras,
        {("sides_swapped", ("cam_01",))},
    ),
    "exchanged": (
        pixels()[:, EXCHANGED],
        RIG.cameras,
        {("views_swapped", ("cam_00", "cam_02"))},
    ),
    "transposed": (pixels(), transposed(2), {("rotation_transposed", ("cam_02",))}),
    "moved": (pixels(), moved(1), {("moved", ("cam_01",))}),
    "metres": (pixels(), GIANT, {("unit", ())}),
}


TRIED = tuple(MISTAKES) if sizes.NIGHTLY else ("none", "exchanged")
"""Of the mistakes; the others are tried at night. A real recording below has a moved camera."""


@pytest.mark.parametrize("name", TRIED)
def test_the_commands_name_the_same_mistake_of_the_same_cameras(name, tmp_path):
    values, cameras, expected = MISTAKES[name]
    points = points_file(tmp_path / "points.npz", values)
    words = (f"keypoints={points}", f"cameras={rig_file(tmp_path, cameras)}", *QUICK)
    assert said_by_cameras(words) == expected
    assert said_by_calibrate(words) == expected
    assert said_by_predict(words, tmp_path / "out") == expected


POSE2SIM = ("pose2sim_single/pose", "pose2sim_single/Calib_qualisys.toml")
CALISCOPE = ("caliscope/xy_HOLISTIC.csv", "caliscope/camera_array.toml")


@pytest.mark.parametrize(
    ("points", "cameras", "expected"),
    sizes.representatives([(*POSE2SIM, {("moved", ("cam01", "cam03"))})], [(*CALISCOPE, set())]),
)
def test_the_commands_agree_on_real_recordings(points, cameras, expected, shared_data, tmp_path):
    words = (f"keypoints={shared_data / points}", f"cameras={shared_data / cameras}", "rate_hz=30")
    words = (*words, "camera_check.frames=32", "camera_check.shift=12")
    assert said_by_cameras(words) == expected
    assert said_by_calibrate(words) == expected
    assert said_by_predict(words, tmp_path / "out") == expected
