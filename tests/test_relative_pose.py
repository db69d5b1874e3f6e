import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.geometry.cameras import Cameras
from ghpt.metrics.relative_pose import (
    MeanError,
    error_2d,
    error_3d,
    quaternion_error,
    rotation_deg,
    translation_deg,
    translation_error,
)


def rotations(count: int, seed: int):
    turns = Rotation.random(count, np.random.default_rng(seed))
    return turns, torch.from_numpy(turns.as_matrix())


def pair(target_turn_deg: float = 0.0, target_shift=(0.0, 0.0, 0.0)) -> Cameras:
    """Two cameras 4 m from the origin, 60 degrees apart; the target's pose may be off."""
    centre_deg = (0.0, 60.0)
    turn = [Rotation.from_euler("y", angle, degrees=True).as_matrix() for angle in centre_deg]
    t = np.array([[0.0, 0.0, 4000.0], [0.0, 0.0, 4000.0]])
    turn[1] = Rotation.from_euler("xyz", [target_turn_deg] * 3, degrees=True).as_matrix() @ turn[1]
    t[1] += np.array(target_shift)
    K = torch.tensor([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]], dtype=torch.float64).expand(
        2, 3, 3
    )
    return Cameras(K, torch.from_numpy(np.stack(turn)), torch.from_numpy(t))


POINTS = 500 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_rotation_errors_equal_scipy():
    (a, a_matrix), (b, b_matrix) = rotations(200, 0), rotations(200, 1)
    qa, qb = a.as_quat(canonical=True), b.as_quat(canonical=True)
    nearest = np.minimum(np.linalg.norm(qa - qb, axis=1), np.linalg.norm(qa + qb, axis=1))
    np.testing.assert_allclose(quaternion_error(a_matrix, b_matrix), nearest, atol=1e-12)
    np.testing.assert_allclose(
        rotation_deg(a_matrix, b_matrix), np.rad2deg((a * b.inv()).magnitude()), atol=1e-9
    )


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 90.0, 179.9999, 180.0])
def test_rotation_angle_keeps_its_digits_at_both_ends(degrees):
    base = rotations(20, 2)[0]
    turned = Rotation.from_rotvec([0, np.deg2rad(degrees), 0]) * base
    result = rotation_deg(torch.from_numpy(turned.as_matrix()), torch.from_numpy(base.as_matrix()))
    np.testing.assert_allclose(result, degrees, atol=1e-10 if degrees < 1 else 1e-6)


def test_small_rotation_near_180_degrees_is_small():
    a = Rotation.from_rotvec([np.pi - 1e-3, 0, 0])
    b = Rotation.from_rotvec([np.pi + 1e-3, 0, 0])
    error = quaternion_error(*(torch.from_numpy(x.as_matrix())[None] for x in (a, b)))
    assert error.item() == pytest.approx(1e-3, rel=1e-5)


def test_translation_errors():
    truth = torch.tensor([[100.0, 0, 0], [0, 3.0, 0], [1.0, 1.0, 0]])
    estimate = torch.tensor([[100.0, 0, 30], [0, -3.0, 0], [2.0, 2.0, 0]])
    np.testing.assert_allclose(translation_error(estimate, truth), [30, 6, 2**0.5])
    np.testing.assert_allclose(
        translation_deg(estimate, truth), [np.rad2deg(np.arctan(0.3)), 180, 0], atol=1e-9
    )


def test_error_2d_is_zero_at_the_truth_and_the_principal_shift_away():
    assert error_2d(pair(), pair(), POINTS)[0].max() == 0
    shifted = pair()
    K = shifted.K.clone()
    K[1, 0, 2] += 3
    K[1, 1, 2] += 4
    errors, counted = error_2d(Cameras(K, shifted.R, shifted.t), pair(), POINTS)
    assert counted.all()
    np.testing.assert_allclose(errors, 5, atol=1e-9)
    K = shifted.K.clone()
    K[0, 0, 2] += 3
    assert (
        error_2d(Cameras(K, shifted.R, shifted.t), pair(), POINTS)[0].max() == 0
    )  # the reference is given


def test_error_3d_is_zero_at_the_truth_only():
    assert error_3d(pair(), pair(), POINTS)[0].max() < 1e-6
    errors = [
        error_3d(pair(degrees), pair(), POINTS)[0].mean().item() for degrees in (0.01, 0.1, 1.0)
    ]
    assert errors == sorted(errors)
    assert errors[0] > 0.1


def test_error_3d_of_a_longer_baseline_is_the_scale():
    truth = pair()
    # With the reference camera's centre as the origin, a baseline longer by 1 % scales the scene by
    # 1 %.
    centre = truth.centre
    longer = centre[0] + 1.01 * (centre[1] - centre[0])
    t = torch.stack((truth.t[0], -truth.R[1] @ longer))
    errors, counted = error_3d(Cameras(truth.K, truth.R, t), truth, POINTS)
    assert counted.all()
    np.testing.assert_allclose(
        errors, 0.01 * torch.linalg.vector_norm(POINTS - centre[0], dim=-1), rtol=1e-6
    )


def test_points_behind_do_not_count():
    points = torch.cat((POINTS, torch.tensor([[0.0, 0.0, -9000.0]], dtype=torch.float64)))
    for error in (error_2d, error_3d):
        errors, counted = error(pair(0.1), pair(), points)
        assert counted.sum() == 50
        assert errors[-1] == 0
        metric = MeanError(error)
        metric.update(pair(0.1), pair(), points)
        result = metric.compute()
        assert result.mean.item() == pytest.approx(errors[:50].mean().item(), rel=1e-12)
        assert result.coverage.item() == 50 / 51


def test_a_point_behind_the_true_cameras_does_not_count_though_the_estimate_has_it_in_front():
    """The estimated baseline points the other way, which changes the sign of every depth."""
    K = torch.tensor([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]], dtype=torch.float64).expand(
        2, 3, 3
    )
    R = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    t = torch.tensor([[0.0, 0, 0], [-500, 0, 0]], dtype=torch.float64)
    errors, counted = error_3d(
        Cameras(K, R, -t), Cameras(K, R, t), POINTS - torch.tensor([0.0, 0.0, 4000.0])
    )
    assert not counted.any()
    assert (errors == 0).all()


def test_mean_error_over_uneven_processes():
    turns, truth = rotations(97, 3)[1], rotations(97, 4)[1]
    whole, shares = MeanError(rotation_deg), [MeanError(rotation_deg) for _ in range(2)]
    whole.update(turns, truth)
    shares[0].update(turns[:90], truth[:90])
    shares[1].update(turns[90:], truth[90:])
    shares[0].merge_state(shares[1])
    assert shares[0].compute().mean.item() == pytest.approx(whole.compute().mean.item(), rel=1e-13)
    assert shares[0].measured == 97
    assert whole.compute().mean.item() == pytest.approx(
        rotation_deg(turns, truth).mean().item(), rel=1e-13
    )
