from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from ghpt.data.synthetic.body import occlusion, random_body, stature, trunk_frame
from ghpt.data.synthetic.detector import KINDS, Detector
from ghpt.data.synthetic.motion import synthesize_motion
from ghpt.data.synthetic.random_processes import gaussian_process, generator
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry import lens
from ghpt.geometry.cameras import CameraSet, project
from ghpt.skeleton import JOINT, JOINTS, MIRROR

CONF = Path(__file__).parents[1] / "conf" / "detector"
RIG = human36m_rig("S9")
PERFECT = {
    "noise": 1e-9,
    "noise_seconds": 0.2,
    "noise_white": 0.3,
    "noise_slow": 0.3,
    "noise_slow_seconds": 1.0,
    "neighbours": 0.0,
    "noise_spread": 0.0,
    "joints": dict.fromkeys(KINDS, 1.0),
    "bias": 0.0,
    "bias_seed": 0,
    "bias_of_subject": 0.3,
    "view_bias": 0.0,
    "view_bias_degrees": 30.0,
    "drift": 0.0,
    "drift_seconds": 1.0,
    "occluded_noise": 1.0,
    "outlier_rate": 0.0,
    "outlier_rate_occluded": 0.0,
    "outlier_size": 0.03,
    "outlier_seconds": 0.5,
    "swap_rate": 0.0,
    "swap_seconds": 0.4,
    "swap_together": 0.0,
    "miss_rate": 0.0,
    "miss_rate_occluded": 0.0,
    "miss_seconds": 0.3,
    "confidence_typical": 1.0,
    "confidence_slope": 0.5,
    "confidence_knowledge": 0.5,
    "familiar": 0.5,
}


def take(action: str = "Greeting", frames: int = 600) -> np.ndarray:
    rng = np.random.default_rng(11)
    return synthesize_motion(random_body(rng), action, frames, 50.0, rng)


def detect(
    points: np.ndarray, rig: CameraSet = RIG, seed: int = 0, familiar: bool = False, **numbers
):
    return Detector(**PERFECT | numbers)(points, rig, 50.0, seed, "S9", "S9/Greeting-1", familiar)


def residual(points: np.ndarray, found) -> np.ndarray:
    """Pixel error relative to the person's size in the image, T V J 2; NaN where not seen."""
    ideal, depth = project(RIG.cameras, torch.from_numpy(points))
    size = 1145.0 * stature(points) / depth[:, :, JOINT["pelvis"], None, None].numpy()
    return np.where(found.valid[..., None], (found.key_points - ideal.numpy()) / size, np.nan)


def test_a_perfect_detector_sees_the_ideal_projection():
    points = take()
    found = detect(points)
    ideal, _ = project(RIG.cameras, torch.from_numpy(points))
    raw = lens.distort(ideal.transpose(0, 1).flatten(1, 2), RIG.cameras.K, RIG.distortion)
    raw = raw.unflatten(1, (len(points), len(JOINTS))).transpose(0, 1)
    inside = ((raw >= 0) & (raw <= RIG.size[:, None] - 1)).all(dim=-1).numpy()
    assert found.valid[inside].all()
    np.testing.assert_allclose(found.key_points[found.valid], ideal.numpy()[found.valid], atol=0.02)


def test_what_is_outside_the_image_is_missed():
    found = detect(take() + np.array([0.0, 0.0, 2500.0]))
    assert not found.valid[:, :, JOINT["head_top"]].any()
    assert (found.key_points[~found.valid] == 0).all()
    assert (found.confidence[~found.valid] == 0).all()
    assert not detect(take() + np.array([0.0, 0.0, 30_000.0])).valid.any()


def test_noise_has_the_size_asked_for_in_statures():
    points = take()
    kinds = dict.fromkeys(KINDS, 1.0) | {"wrist": 2.0}
    error = residual(points, detect(points, noise=0.005, joints=kinds))
    for joint, scale in (("nose", 1.0), ("left_wrist", 2.0)):
        assert np.nanstd(error[:, :, JOINT[joint]]) == pytest.approx(0.005 * scale, rel=0.2)
    assert np.abs(np.nanmean(error)) < 5e-4


def test_familiar_people_are_found_better():
    points = take()
    error = [
        np.nanmean(
            np.linalg.norm(
                residual(points, detect(points, noise=0.005, bias=0.01, familiar=f)), axis=-1
            )
        )
        for f in (False, True)
    ]
    assert error[1] == pytest.approx(0.5 * error[0], rel=0.02)


def test_bias_turns_with_the_body_and_is_the_same_in_all_views():
    points = take("Walking")
    detector = Detector(**PERFECT | {"bias": 0.01})
    error = detector.draw_body_error(len(points), 50.0, 0, "S9", "take")
    offset = detector.displace_joints(points, error, False) - points
    in_trunk = (trunk_frame(points).mT @ offset[:, JOINT["spine"], :, None])[..., 0]
    np.testing.assert_allclose(in_trunk, np.broadcast_to(in_trunk[0], in_trunk.shape), atol=1e-6)
    limb = points[:, JOINT["left_wrist"]] - points[:, JOINT["left_elbow"]]
    assert (
        np.ptp((offset[:, JOINT["left_wrist"]] * limb).sum(axis=-1) / np.linalg.norm(limb, axis=-1))
        < 40
    )
    valid = residual(points, detect(points, bias=0.01))
    expected, _ = project(
        RIG.cameras,
        torch.from_numpy(
            detector.displace_joints(
                points, detector.draw_body_error(len(points), 50.0, 0, "S9", "S9/Greeting-1"), False
            )
        ),
    )
    ideal, depth = project(RIG.cameras, torch.from_numpy(points))
    size = 1145.0 * stature(points) / depth[:, :, JOINT["pelvis"], None, None]
    difference = valid - ((expected - ideal) / size).numpy()
    assert np.nanmax(np.abs(difference)) < 1e-4


def test_the_definition_is_mirrored_between_the_sides():
    detector = Detector(**PERFECT | {"bias": 0.01, "bias_of_subject": 0.0})
    bias = detector.draw_body_error(10, 50.0, 0, "S9", "take").bias
    np.testing.assert_allclose(bias[list(MIRROR)], bias * [1, 1, -1, 1], atol=1e-12)
    other = detector.draw_body_error(10, 50.0, 5, "S1", "other").bias
    np.testing.assert_array_equal(bias, other)


def facing_joints(yaw: float) -> np.ndarray:
    """A standing person in camera coordinates, 4 m away; yaw 0 faces the camera."""
    standing = synthesize_motion(
        random_body(np.random.default_rng(0)), "Waiting", 2, 50.0, np.random.default_rng(1)
    )
    standing = (standing - standing[:, [JOINT["pelvis"]]])[:1]
    local = (trunk_frame(standing).mT @ standing.mT).mT
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = np.moveaxis(local, -1, 0)
    return np.stack([c * y - s * x, -z, 4000.0 - (c * x + s * y)], axis=-1).astype(np.float32)


def test_the_body_hides_the_nose_from_behind_and_the_far_side_from_the_side():
    front, side, back = (
        occlusion(facing_joints(yaw), 1730.0)[0] for yaw in (0.0, np.pi / 2, np.pi)
    )
    assert front[JOINT["nose"]] == 0
    assert front.mean() < 0.3
    near, far = (
        ("right", "left")
        if facing_joints(np.pi / 2)[0, JOINT["left_hip"], 2] > 4000
        else ("left", "right")
    )
    assert side[JOINT[f"{far}_hip"]] + side[JOINT[f"{far}_shoulder"]] > side[JOINT[f"{near}_hip"]]
    assert side[JOINT[f"{near}_shoulder"]] == 0
    assert back[JOINT["nose"]] > 0.3
    for hidden in (front, side, back):
        assert ((hidden >= 0) & (hidden <= 1)).all()


def test_outliers_are_as_frequent_and_large_as_asked_for_and_last():
    points = take(frames=4000)
    found = detect(points, outlier_rate=0.05, outlier_rate_occluded=0.05, outlier_size=0.05)
    length = np.linalg.norm(residual(points, found), axis=-1)
    out = length > 1e-4
    assert np.mean(out) == pytest.approx(0.05, rel=0.2)
    assert length[out].mean() == pytest.approx(0.05, rel=0.25)
    assert np.mean(out[1:][out[:-1]]) > 0.8
    assert np.nanmax(np.abs(np.diff(length, axis=0))) < 0.2


def view_biases(points: np.ndarray, degrees: float = 30.0) -> np.ndarray:
    """Of all views [T V J 2]."""
    numbers = {"view_bias": 0.01, "view_bias_degrees": degrees}
    detector = Detector(**PERFECT | numbers)
    views = range(len(RIG.names))
    return np.stack([detector.draw_view_bias(points, RIG, v, 0, "S9") for v in views], axis=1)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """Points turned about the vertical through the pelvis."""
    angle = np.deg2rad(degrees)
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    pelvis = points[:, [JOINT["pelvis"]]]
    return (points - pelvis) @ rotation.T + pelvis


def test_the_bias_of_a_view_lasts_until_the_body_turns():
    points = take(frames=1)
    still = view_biases(points)
    correlation = [
        np.corrcoef(still.ravel(), view_biases(turned(points, angle)).ravel())[0, 1]
        for angle in (5.0, 30.0, 120.0)
    ]
    assert correlation[0] > 0.95
    assert 0.3 < correlation[1] < 0.8
    assert abs(correlation[2]) < 0.35
    views = still[0].reshape(4, -1)
    assert np.abs(np.corrcoef(views)[np.triu_indices(4, 1)]).max() < 0.5
    assert still.std() == pytest.approx(1.0, rel=0.25)


def test_the_bias_of_a_view_is_in_its_key_points():
    points = take(frames=50)
    error = residual(points, detect(points, view_bias=0.01))
    expected = 0.01 * view_biases(points)
    measured = np.isfinite(error)
    np.testing.assert_allclose(error[measured], expected[measured], atol=1e-3)


def test_spread_noise_has_the_same_size_and_heavier_tails():
    points = take(frames=3000)
    plain = np.abs(residual(points, detect(points, noise=0.005)))
    spread = np.abs(residual(points, detect(points, noise=0.005, noise_spread=0.6)))
    rms = [np.sqrt(np.nanmean(error**2)) for error in (plain, spread)]
    assert rms[1] == pytest.approx(rms[0], rel=0.05)
    assert np.nanquantile(spread, 0.999) > 1.5 * np.nanquantile(plain, 0.999)


def test_neighbours_share_errors():
    points = take(frames=2000)
    error = residual(points, detect(points, noise=0.005, neighbours=0.5))

    def correlation(one: str, other: str) -> float:
        a, b = error[:, :, JOINT[one]].ravel(), error[:, :, JOINT[other]].ravel()
        both = np.isfinite(a) & np.isfinite(b)
        return float(np.corrcoef(a[both], b[both])[0, 1])

    assert correlation("left_knee", "left_ankle") == pytest.approx(0.5, abs=0.08)
    assert correlation("left_hip", "left_ankle") == pytest.approx(0.25, abs=0.08)
    assert correlation("left_wrist", "left_ankle") == pytest.approx(0.0, abs=0.08)


def test_legs_and_arms_are_swapped_together():
    detector = Detector(**PERFECT | {"swap_together": 0.9})
    flip = detector.draw_processes(4000, 50.0, generator(0, "camera")).flip
    assert np.corrcoef(flip.T)[0, 1] == pytest.approx(0.9, abs=0.05)
    np.testing.assert_allclose(flip.std(axis=0), 1.0, atol=0.15)


def test_swaps_exchange_the_sides_of_legs_or_arms():
    points = take(frames=3000)
    found = detect(points, swap_rate=0.05)
    ideal = project(RIG.cameras, torch.from_numpy(points))[0].numpy()
    wrong = np.linalg.norm(found.key_points - ideal, axis=-1) > 0.5
    legs = [
        JOINT[f"{side}_{part}"] for side in ("right", "left") for part in ("hip", "knee", "ankle")
    ]
    mirrored = np.linalg.norm(found.key_points - ideal[:, :, list(MIRROR)], axis=-1) < 0.5
    flipped = wrong[..., legs].any(axis=-1) & found.valid[..., legs].all(axis=-1)
    assert 0.005 < flipped.mean() < 0.15
    assert mirrored[flipped][:, legs].all()
    assert not wrong[..., JOINT["nose"]][found.valid[..., JOINT["nose"]]].any()


def test_confidence_knows_something_of_the_error_and_not_everything():
    points = take(frames=2000)
    from scipy.stats import spearmanr

    correlation = []
    for knowledge in (0.3, 0.9):
        found = detect(points, noise=0.005, confidence_knowledge=knowledge)
        error = np.linalg.norm(residual(points, found), axis=-1)[found.valid]
        assert ((found.confidence >= 0) & (found.confidence <= 1)).all()
        correlation.append(-spearmanr(error, found.confidence[found.valid]).statistic)
    assert 0.15 < correlation[0] < 0.45
    assert 0.75 < correlation[1] < 0.97


def test_a_view_does_not_depend_on_the_other_views():
    points = take(frames=100)
    numbers = {
        "noise": 0.005,
        "outlier_rate": 0.1,
        "swap_rate": 0.01,
        "miss_rate": 0.05,
        "bias": 0.01,
        "drift": 0.01,
    }
    every = detect(points, **numbers)
    two = CameraSet.from_cameras(
        RIG.names[2:0:-1], RIG.cameras.index([2, 1]), RIG.distortion[[2, 1]], RIG.size[[2, 1]]
    )
    some = detect(points, rig=two, **numbers)
    np.testing.assert_array_equal(some.key_points, every.key_points[:, [2, 1]])
    np.testing.assert_array_equal(some.confidence, every.confidence[:, [2, 1]])
    assert (detect(points, seed=1, **numbers).key_points != every.key_points).any()


@pytest.mark.parametrize("persistence", [0.5, 5.0, 40.0])
def test_processes_are_stationary_unit_gaussians(persistence):
    values = gaussian_process(generator(0, "test"), (3000,), 100, persistence)
    np.testing.assert_allclose(values.std(axis=1), 1.0, atol=0.06)
    np.testing.assert_allclose(values.mean(axis=1), 0.0, atol=0.08)
    lag = max(round(6 * persistence), 1)
    if lag < 90:
        assert abs(np.corrcoef(values[0], values[lag])[0, 1]) < 0.1


@pytest.mark.parametrize("name", ["human36m", "panoptic", "field"])
def test_the_fitted_numbers_make_a_detector(name):
    detector = Detector(**yaml.safe_load((CONF / f"{name}.yaml").read_text()))
    found = detector(take(), RIG, 50.0, 0, "S9", "S9/Greeting-1")
    assert 0.9 < found.valid.mean() <= 1.0
    assert np.isfinite(found.key_points).all()
    assert 0.4 < found.confidence[found.valid].mean() < 0.95
    assert replace(detector, bias=0.0) != detector


def test_every_64th_frame_can_be_detected_alone():
    """What the fit relies on: errors depend on other frames only through the processes."""
    points = take(frames=400)
    numbers = {"noise": 0.005, "outlier_rate": 0.1, "swap_rate": 0.02, "miss_rate": 0.05}
    detector = Detector(**PERFECT | numbers)
    processes = detector.draw_processes(len(points), 50.0, generator(0, "camera"))
    sampled = processes.subsample(64)
    whole = detector.detect_view(points, points, RIG, 1, processes, False)
    some = detector.detect_view(points[::64], points[::64], RIG, 1, sampled, False)
    np.testing.assert_allclose(some.key_points, whole.key_points[::64], atol=1e-3)
    np.testing.assert_array_equal(some.valid, whole.valid[::64])
