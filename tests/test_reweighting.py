import pytest
import torch

from ghpt.geometry.cameras import project
from ghpt.geometry.reweighting import WEIGHTS, triangulate_robustly
from ghpt.geometry.state import State
from ghpt.geometry.triangulation import triangulate
from scenes import Scene, random_scene

TOLERANCE = 1e-6
SCALE = 4.0


def scene_with_outliers(frames=3, views=5):
    """Noise of 2 pixels, and every seventh key point of the first view 80 pixels off."""
    scene = random_scene(0, frames, views).noisy(2, 0)
    scene.key_points[:, 0, ::7] += 80
    return scene


def robustly(scene, loss, iterations, valid=None, tolerance=TOLERANCE):
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool) if valid is None else valid
    scale = torch.full(valid.shape[:2], SCALE, dtype=torch.float64)
    scale[:, 1] = 2 * SCALE
    result = triangulate_robustly(
        scene.cameras,
        scene.key_points,
        valid,
        scale,
        torch.ones_like(scene.key_points[..., 0]),
        WEIGHTS[loss],
        iterations,
        tolerance,
    )
    return result, scale


def weights_at(scene, points, scale, loss):
    """A view's weight in pixels at these points, over its squared depth."""
    pixels, depth = project(scene.cameras, points)
    r = (pixels - scene.key_points).norm(dim=-1) / scale[..., None]
    robust = {
        "huber": 1 / r.clamp(min=1),
        "cauchy": 1 / (1 + r**2),
        "geman_mcclure": 1 / (1 + r**2) ** 2,
    }
    return torch.where(depth > 0, robust[loss], 0.0) / depth**2


@pytest.mark.parametrize("loss", WEIGHTS)
def test_the_estimate_is_what_its_own_weights_give(loss):
    scene = scene_with_outliers()
    result, scale = robustly(scene, loss, 200)
    assert result.ok.all()
    again = triangulate(
        scene.cameras, scene.key_points, weights_at(scene, result.points, scale, loss)
    )
    torch.testing.assert_close(again.points, result.points, rtol=0, atol=1e-4)
    torch.testing.assert_close(again.depth_min, result.depth_min, rtol=0, atol=1e-3)


def test_one_iteration_is_one_reweighting_of_the_linear_solution():
    scene = scene_with_outliers()
    linear = triangulate(scene.cameras, scene.key_points, torch.ones(scene.key_points.shape[:-1]))
    result, scale = robustly(scene, "cauchy", 1)
    expected = triangulate(
        scene.cameras, scene.key_points, weights_at(scene, linear.points, scale, "cauchy")
    )
    torch.testing.assert_close(result.points, expected.points, rtol=0, atol=1e-6)


@pytest.mark.parametrize("iterations", [2, 3, 6])
def test_not_converged_is_said_where_the_last_step_is_longer_than_the_tolerance(iterations):
    scene = scene_with_outliers(frames=6)
    before = robustly(scene, "cauchy", iterations - 1)[0]
    step = (robustly(scene, "cauchy", iterations)[0].points - before.points).norm(dim=-1)
    tolerance = float(step.median())
    status = robustly(scene, "cauchy", iterations, tolerance=tolerance)[0].status
    assert torch.equal(status == State.NOT_CONVERGED, step > tolerance)
    assert ((status == State.OBSERVED) == (step <= tolerance)).all()


def test_a_joint_rests_only_when_its_step_is_far_below_the_tolerance():
    scene = scene_with_outliers(frames=6)
    exact = robustly(scene, "geman_mcclure", 200)[0].points
    coarse = robustly(scene, "geman_mcclure", 200, tolerance=5.0)[0].points
    assert (coarse - exact).norm(dim=-1).max() < 0.5


def test_a_resting_joint_stays_though_others_move():
    scene = scene_with_outliers(frames=6)
    together = robustly(scene, "geman_mcclure", 200, tolerance=5.0)[0].points
    for frame in range(6):
        rows = slice(frame, frame + 1)
        alone = Scene(scene.cameras.index(rows), scene.points[rows], scene.key_points[rows])
        points = robustly(alone, "geman_mcclure", 200, tolerance=5.0)[0].points
        torch.testing.assert_close(points[0], together[frame], rtol=0, atol=1e-9)


def test_what_is_not_seen_is_not_used_and_what_is_broken_is_said():
    scene = scene_with_outliers()
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    valid[:, 2:, 3] = False
    valid[:, 1:, 4] = False
    expected = robustly(scene, "cauchy", 50, valid)[0]
    spoilt = scene_with_outliers()
    spoilt.key_points[:, 2:, 3] = 1e5
    found = robustly(spoilt, "cauchy", 50, valid)[0]
    assert torch.equal(found.points, expected.points)
    assert (found.status[:, 4] == State.FEW_VIEWS).all()
    spoilt.key_points[0, 0, 0] = torch.nan
    status = robustly(spoilt, "cauchy", 50, valid)[0].status
    assert status[0, 0] == State.BAD_INPUT
    assert (status == State.BAD_INPUT).sum() == 1
