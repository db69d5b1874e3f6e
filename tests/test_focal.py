"""Focal lengths that nobody gave: the adjustment, what its ± is worth, and when it says nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from composed import calibrate_settings
from ghpt.calibration.focal import (
    FocalAdjustment,
    FocalLengths,
    _linearise,
    _residual,
    lens_errors,
    seen_by,
    state_of,
    without,
)
from ghpt.calibration.intrinsics import IntrinsicsEstimation
from ghpt.calibration.rig import RigCalibration
from ghpt.config import build
from ghpt.data.synthetic.body import random_body
from ghpt.data.synthetic.motion import synthesize_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras, project

SIZE = torch.tensor([1000, 1000])
FRAMES = 30
CENTRE_STD = torch.full((4,), 0.015, dtype=torch.float64)


@pytest.fixture(scope="module")
def walk() -> torch.Tensor:
    """Joints [T J 3] of a person who walks, mm."""
    rng = np.random.default_rng(5)
    truth = synthesize_motion(random_body(rng), "Walking", 10 * FRAMES, 25.0, rng, False)
    return torch.from_numpy(truth[::10]).double()


def cameras(*focal: float) -> Cameras:
    """Human3.6M's cameras with these focal lengths and the principal point at the centre."""
    rig = human36m_rig("S9").cameras
    K = torch.eye(3, dtype=torch.float64).repeat(4, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = torch.tensor(focal, dtype=torch.float64).expand(4)
    K[:, :2, 2] = 499.5
    return Cameras(K, rig.R, rig.t)


def shown(walk: torch.Tensor, rig: Cameras, noise: float, k1: float = 0.0) -> torch.Tensor:
    """Return pixels [T V J 2] through lenses with one radial coefficient."""
    pixels, _ = project(rig.index(None), walk)
    focal = rig.K[:, 0, 0][:, None, None]
    ideal = (pixels - 499.5) / focal
    bent = ideal * (1 + k1 * ideal.square().sum(-1, keepdim=True)) * focal + 499.5
    random = torch.Generator().manual_seed(0)
    return bent + noise * torch.randn(bent.shape, dtype=torch.float64, generator=random)


def begun(walk: torch.Tensor, rig: Cameras, pixels: torch.Tensor, ratio: float):
    """Return what views see, and the true rig, with a first guess of the focal length."""
    K = rig.K.clone()
    K[:, :2, :2] *= ratio
    seen = seen_by(K, pixels, torch.ones(pixels.shape[:3], dtype=torch.bool))
    return seen, state_of(rig.R, rig.t, walk.flatten(0, 1))


def adjustment() -> FocalAdjustment:
    return build(calibrate_settings().intrinsics["adjustment"], "adjustment")


def test_derivatives_are_the_differences(walk):
    rig = cameras(1150.0)
    seen, state = begun(walk[:2], rig, shown(walk[:2], rig, 2.0), 0.9)
    state = replace(state, k1=torch.full((4,), 0.05, dtype=torch.float64))
    noise = torch.full((4,), 0.01, dtype=torch.float64)
    system = _linearise(seen, state, noise, 1e6)
    step = 1e-6
    residual, _ = _residual(seen, state)
    by_focal, _ = _residual(seen, replace(state, log_ratio=state.log_ratio + step))
    by_k1, _ = _residual(seen, replace(state, k1=state.k1 + step))
    moved, _ = _residual(seen, replace(state, points=state.points + torch.tensor([step, 0, 0])))
    for column, other in ((6, by_focal), (7, by_k1)):
        difference = (other - residual) / step / 0.01
        torch.testing.assert_close(system.by_view[..., column], difference, rtol=1e-4, atol=1e-3)
    difference = (moved - residual) / step / 0.01
    torch.testing.assert_close(system.by_point[..., 0], difference, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("focal", FocalLengths)
def test_without_noise_the_focal_lengths_are_exact(walk, focal):
    rig = cameras(1150.0)
    seen, state = begun(walk, rig, shown(walk, rig, 1e-4), 0.9)
    found = adjustment()(seen, state, focal, False, CENTRE_STD)
    torch.testing.assert_close(found.ratio, torch.full((4,), 1 / 0.9).double(), rtol=1e-3, atol=0)


def test_radial_distortion_is_found_beside_the_focal_length(walk):
    rig = cameras(1150.0)
    seen, state = begun(walk, rig, shown(walk, rig, 0.01, k1=-0.2), 0.95)
    found = adjustment()(seen, state, FocalLengths.SHARED, True, CENTRE_STD)
    torch.testing.assert_close(found.ratio, torch.full((4,), 1 / 0.95).double(), rtol=5e-3, atol=0)
    torch.testing.assert_close(found.k1, torch.full((4,), -0.2).double(), rtol=0, atol=0.01)


def test_each_camera_s_own_focal_length_is_found_with_its_uncertainty(walk):
    rig = cameras(1000.0, 1100.0, 1200.0, 1300.0)
    seen, state = begun(walk, rig, shown(walk, rig, 2.0), 1.0)
    state = replace(state, log_ratio=torch.full((4,), 0.05).double())
    found = adjustment()(seen, state, FocalLengths.EACH, False, CENTRE_STD)
    error = found.ratio - 1
    assert float(error.abs().max()) < 0.03
    assert float((error / found.std).abs().max()) < 3
    assert float(found.std.max()) < 0.05


def test_uncertainty_grows_where_fewer_views_see_the_person(walk):
    rig = cameras(1150.0)
    walk = walk[::2]
    seen, state = begun(walk, rig, shown(walk, rig, 2.0), 1.0)
    every = adjustment()(seen, state, FocalLengths.SHARED, False, CENTRE_STD)
    lost = torch.tensor([False, False, False, True])
    fewer = adjustment()(without(seen, lost), state, FocalLengths.SHARED, False, CENTRE_STD)
    assert float(fewer.std[0]) > float(every.std[0])


def estimated(pixels: torch.Tensor, views: int, **changes: object):
    settings = calibrate_settings("calibration.frames=30")
    estimation: IntrinsicsEstimation = build({**settings.intrinsics, **changes}, "intrinsics")
    calibration: RigCalibration = build(settings.calibration, "calibration")
    guess = estimation.guess_cameras(("a", "b", "c", "d")[:views], SIZE)
    own = pixels[:, :views]
    valid = torch.ones(own.shape[:3], dtype=torch.bool)
    return estimation(calibration, guess, own, valid.double(), valid, 0)


def test_a_shared_focal_length_is_found_from_the_image_size_alone(walk):
    found = estimated(shown(walk, cameras(1150.0), 2.0), 4)
    assert found.findings == ()
    assert found.K[:, 0, 0].tolist() == pytest.approx([1150] * 4, rel=0.012)
    assert float(found.std.max()) < 0.02


def test_two_cameras_determine_no_focal_length(walk):
    found = estimated(shown(walk, cameras(1150.0), 2.0), 2)
    assert [finding.code for finding in found.findings] == ["focal_unknown"]


def test_cameras_that_do_not_share_a_focal_length_are_named(walk):
    found = estimated(shown(walk, cameras(1000.0, 1000.0, 1000.0, 1350.0), 2.0), 4)
    assert [finding.code for finding in found.findings] == ["focal_differs"]
    assert "d" in found.findings[0].cameras


@pytest.mark.parametrize(
    "words",
    [
        ["image_size=[1920]"],
        ["image_size=[1920,-1]"],
        ["image_size=[9,9]", "cameras=x", "keypoints=y"],
    ],
)
def test_an_image_size_that_is_none_is_refused(words):
    with pytest.raises(GhptConfigError, match="image_size"):
        calibrate_settings(*words)


def test_another_word_for_the_focal_lengths_is_refused():
    with pytest.raises(GhptConfigError, match="some"):
        build(calibrate_settings("intrinsics.focal=some").intrinsics, "intrinsics")


def test_the_rig_is_known_less_where_its_focal_lengths_are(walk):
    rig = cameras(1150.0)
    pixels = shown(walk[::2], rig, 2.0)
    valid = torch.ones(pixels.shape[:3], dtype=torch.bool)
    settings = calibrate_settings("calibration.frames=30")
    calibration: RigCalibration = build(settings.calibration, "calibration")
    every = FocalLengths.EACH
    errors = lens_errors(every, torch.full((4,), 0.02).double(), torch.full((4,), 0.01).double())
    names = ("a", "b", "c", "d")
    given = (names, rig.K, pixels, valid.double(), valid, SIZE.repeat(4, 1), 0)
    known = calibration(*given).rotation_std_deg
    unknown = calibration(*given, lenses=errors).rotation_std_deg
    assert (unknown > known).all()
    # principal points off by 0.01 focal lengths turn cameras by as many radians at most
    assert float(unknown.max()) < float(known.max()) + 1.2
