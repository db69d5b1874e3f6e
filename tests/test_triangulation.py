from itertools import combinations

import numpy as np
import pytest
import torch

from ghpt.geometry.cameras import Cameras, project, reprojection_error
from ghpt.geometry.normal_equations import solve_symmetric
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.geometry.state import FILE_STATES, State
from ghpt.geometry.triangulation import System, triangulate, triangulate_subsets
from scenes import random_scene


def every_subset(views, frames=1, joints=17, least=2):
    """All subsets of at least ``least`` views, as hypotheses: [B, H, J, V]."""
    subsets = [s for k in range(least, views + 1) for s in combinations(range(views), k)]
    chosen = torch.zeros(len(subsets), views, dtype=torch.bool)
    for row, subset in zip(chosen, subsets, strict=True):
        row[list(subset)] = True
    return chosen[None, :, None].expand(frames, -1, joints, -1)


def ones(scene):
    return torch.ones(scene.key_points.shape[:-1], dtype=torch.float64)


def least_squares(cameras, key_points, weights):
    """The reference: one numpy least-squares problem for each joint, from 3x4 projection
    matrices."""
    K, R, t, x, w = (a.numpy() for a in (cameras.K, cameras.R, cameras.t, key_points, weights))
    points = np.zeros((x.shape[0], x.shape[2], 3))
    for b, j in np.ndindex(points.shape[:2]):
        rows = []
        for v in np.flatnonzero(w[b, :, j]):
            P = K[b, v] @ np.column_stack([R[b, v], t[b, v]])
            rows += [np.sqrt(w[b, v, j]) * (x[b, v, j, i] * P[2] - P[i]) for i in range(2)]
        A = np.array(rows)
        points[b, j] = np.linalg.lstsq(A[:, :3], -A[:, 3], rcond=None)[0]
    return torch.from_numpy(points)


def test_exact_key_points_give_the_points_back_for_every_subset_of_views():
    scene = random_scene(0, frames=2, views=5)
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    subsets = every_subset(5, frames=2)
    points, ok = triangulate_subsets(scene.cameras, scene.key_points, valid, subsets)
    assert ok.all()
    assert (points - scene.points[:, None]).abs().max() < 1e-6
    for h in range(subsets.shape[1]):
        result = triangulate(scene.cameras, scene.key_points, subsets[:, h].mT.double())
        assert result.ok.all()
        assert (result.points - scene.points).abs().max() < 1e-8


def test_noisy_key_points_give_the_least_squares_solution():
    scene = random_scene(1, frames=3, views=4).noisy(5, 0)
    K = scene.cameras.K.clone()
    K[..., 0, 1] = 7  # skew
    cameras = Cameras(K, scene.cameras.R, scene.cameras.t)
    weights = torch.from_numpy(np.random.default_rng(0).uniform(0.1, 3, (3, 4, 17)))
    weights[:, 0, :5] = 0
    expected = least_squares(cameras, scene.key_points, weights)
    torch.testing.assert_close(
        triangulate(cameras, scene.key_points, weights).points, expected, rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("hypotheses", [7, 64])
def test_subsets_are_the_same_looked_up_and_solved_one_by_one(hypotheses):
    scene = random_scene(2, frames=2, views=5).noisy(5, 0)
    rng = np.random.default_rng(1)
    subsets = torch.from_numpy(rng.random((2, hypotheses, 17, 5)) < 0.5)
    valid = torch.from_numpy(rng.random((2, 5, 17)) < 0.8)
    points, ok = triangulate_subsets(scene.cameras, scene.key_points, valid, subsets)
    unseen = (subsets & ~valid.mT[:, None]).any(-1)
    assert not ok[unseen].any()
    assert (points[~ok] == 0).all()
    for h in range(hypotheses):
        result = triangulate(scene.cameras, scene.key_points, subsets[:, h].mT.double())
        assert torch.equal(ok[:, h] | unseen[:, h], result.ok | unseen[:, h])
        torch.testing.assert_close(
            points[:, h][ok[:, h]], result.points[ok[:, h]], rtol=0, atol=1e-6
        )


def test_the_order_of_the_views_is_nothing():
    scene = random_scene(3, views=6).noisy(5, 0)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    there = triangulate(scene.cameras, scene.key_points, ones(scene))
    back = triangulate(
        scene.cameras.index((slice(None), order)), scene.key_points[:, order], ones(scene)
    )
    torch.testing.assert_close(there.points, back.points, rtol=0, atol=1e-8)


@pytest.mark.parametrize("damage", [1000.0, torch.nan, torch.inf, 1e300])
def test_a_view_that_is_not_used_changes_nothing(damage):
    scene = random_scene(4, views=4).noisy(5, 0)
    weights = ones(scene)
    weights[:, 2, :9] = 0
    moved = scene.key_points.clone()
    moved[:, 2, :9] += damage
    before, after = (triangulate(scene.cameras, x, weights) for x in (scene.key_points, moved))
    assert torch.equal(before.points, after.points)
    assert after.ok.all()


def test_the_unit_of_length_is_nothing():
    in_mm, in_m = (random_scene(5, scale=s).noisy(5, 0) for s in (1.0, 1e-3))
    a, b = (triangulate(s.cameras, s.key_points, ones(s)) for s in (in_mm, in_m))
    torch.testing.assert_close(a.points, b.points * 1e3, rtol=0, atol=1e-7)
    torch.testing.assert_close(a.cond, b.cond, rtol=1e-9, atol=0)


def test_the_world_frame_is_nothing():
    scene = random_scene(6).noisy(5, 0)
    turn = vector_to_matrix(torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64))
    shift = torch.tensor([4e5, -2e5, 1e5], dtype=torch.float64)
    cameras = scene.cameras
    R = cameras.R @ turn.mT
    moved = Cameras(cameras.K, R, cameras.t - (R @ shift))
    here, there = (triangulate(c, scene.key_points, ones(scene)) for c in (cameras, moved))
    torch.testing.assert_close(here.points @ turn.mT + shift, there.points, rtol=0, atol=1e-6)
    torch.testing.assert_close(here.angle, there.angle, rtol=0, atol=1e-9)


def test_a_batch_is_the_stack_of_its_frames_under_any_leading_dimensions():
    scene = random_scene(7, frames=6, views=3).noisy(5, 0)
    weights = ones(scene)
    together = triangulate(scene.cameras, scene.key_points, weights)
    for b in range(6):
        alone = triangulate(scene.cameras.index(b), scene.key_points[b], weights[b])
        torch.testing.assert_close(alone.points, together.points[b], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.angle, together.angle[b], rtol=0, atol=1e-9)
    cameras = Cameras(
        *(x.unflatten(0, (2, 3)) for x in (scene.cameras.K, scene.cameras.R, scene.cameras.t))
    )
    folded = triangulate(cameras, *(x.unflatten(0, (2, 3)) for x in (scene.key_points, weights)))
    assert torch.equal(folded.points.flatten(0, 1), together.points)


def test_a_weight_counts_how_often_a_view_is_there():
    scene = random_scene(8, views=3).noisy(5, 0)
    twice = torch.tensor([0, 1, 2, 2])
    weights = ones(scene)
    weights[:, 2] = 2
    doubled = triangulate(
        scene.cameras.index((slice(None), twice)), scene.key_points[:, twice], ones(scene)[:, twice]
    )
    weighted = triangulate(scene.cameras, scene.key_points, weights)
    torch.testing.assert_close(doubled.points, weighted.points, rtol=0, atol=1e-8)
    scaled = triangulate(scene.cameras, scene.key_points, weights * 1e-200)
    torch.testing.assert_close(scaled.points, weighted.points, rtol=0, atol=1e-8)


def test_the_angle_of_two_views_is_that_between_their_rays():
    scene = random_scene(9, frames=5, views=2)
    ray = scene.points[:, None] - scene.cameras.centre[:, :, None]
    ray = ray / ray.norm(dim=-1, keepdim=True)
    expected = (ray[:, 0] * ray[:, 1]).sum(-1).abs().acos()
    result = triangulate(scene.cameras, scene.key_points, ones(scene))
    torch.testing.assert_close(result.angle, expected, rtol=0, atol=1e-8)
    torch.testing.assert_close(result.depth_min, project(scene.cameras, scene.points)[1].amin(1))


def test_small_systems_are_solved_and_their_condition_is_bounded():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(500, 5, 3)) * 10.0 ** rng.uniform(-2, 2, (500, 1, 3))
    M, right = A.transpose(0, 2, 1) @ A, rng.normal(size=(500, 3))
    i, j = np.triu_indices(3)
    *solution, cond = solve_symmetric(tuple(torch.from_numpy(x) for x in (*M[:, i, j].T, *right.T)))
    expected = np.linalg.solve(M, right[..., None])[..., 0]
    np.testing.assert_allclose(
        torch.stack(solution, -1), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()
    )
    true = np.linalg.cond(M)
    assert (cond.numpy() >= true * (1 - 1e-6)).all()
    assert (cond.numpy() <= 9 * true * (1 + 1e-6)).all()


def test_gradients_are_right_and_none_reaches_what_is_masked():
    scene = random_scene(10, frames=1, views=3).noisy(3, 0)
    weights = ones(scene)[..., :2]
    key_points = scene.key_points[..., :2, :].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: triangulate(scene.cameras, x, weights).points, key_points, atol=1e-4
    )
    broken = key_points.detach().clone()
    broken[0, 0, 0] = torch.nan
    weights[0, 0, 0] = 0
    broken.requires_grad_()
    triangulate(scene.cameras, broken, weights).points.sum().backward()
    assert torch.isfinite(broken.grad).all()
    assert (broken.grad[0, 0, 0] == 0).all()
    assert (broken.grad[0, 1, 0] != 0).all()


def test_too_few_views_are_said_and_no_point_is_made():
    scene = random_scene(11, frames=1, views=4)
    weights = ones(scene)
    weights[0, :, 0] = 0
    weights[0, 1:, 1] = 0
    result = triangulate(scene.cameras, scene.key_points, weights)
    assert result.status[0, :3].tolist() == [State.FEW_VIEWS, State.FEW_VIEWS, State.OBSERVED]
    assert (result.points[0, :2] == 0).all()
    assert (result.angle[0, :2] == 0).all()


def test_31_views_and_many_subsets_stay_small():
    scene = random_scene(12, frames=2, views=31)
    subsets = torch.rand((2, 300, 17, 31), generator=torch.Generator().manual_seed(0)) < 0.3
    valid = torch.ones(2, 31, 17, dtype=torch.bool)
    points, ok = triangulate_subsets(scene.cameras, scene.key_points, valid, subsets)
    assert torch.equal(ok, subsets.sum(-1) >= 2)
    assert (points - scene.points[:, None]).abs().amax(-1)[ok].max() < 1e-5


def test_far_from_the_world_s_origin_no_digits_are_lost_but_those_of_t():
    scene = random_scene(13, frames=20, views=3, place=1e10)
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    points, ok = triangulate_subsets(
        scene.cameras, scene.key_points, valid, every_subset(3, frames=20)
    )
    assert ok.all()
    rounding = scene.cameras.t.abs().max() * torch.finfo(torch.float64).eps
    assert (points - scene.points[:, None]).norm(dim=-1).median() < 10 * rounding


def test_a_camera_on_the_moon_costs_the_others_no_digits():
    scene = random_scene(14, views=4)
    away = scene.cameras.t.clone()
    away[:, 3] = 4e11
    cameras = Cameras(scene.cameras.K, scene.cameras.R, away)
    weights = ones(scene)
    weights[:, 3] = 0
    assert (
        triangulate(cameras, scene.key_points, weights).points - scene.points
    ).abs().max() < 1e-8


def test_a_narrow_baseline_keeps_the_digits_that_squaring_would_cost():
    scene = random_scene(15, frames=20, views=2)
    K, R = (x[:, :1].expand(-1, 2, -1, -1) for x in (scene.cameras.K, scene.cameras.R))
    t = scene.cameras.t[:, :1] - torch.tensor(
        [[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64
    )  # 1 mm apart
    cameras = Cameras(K, R, t)
    result = triangulate(cameras, project(cameras, scene.points)[0], ones(scene))
    assert result.ok.all()
    assert (result.points - scene.points).norm(dim=-1).median() < 1e-7
    assert (result.points - scene.points).norm(dim=-1).max() < 1e-4


def test_the_numbers_of_the_states_are_those_of_the_files():
    placed = ("OBSERVED", "SUPPORTED", "FILLED")
    names = (*placed, "FEW_VIEWS", "PARALLEL", "BEHIND", "BAD_INPUT", "REJECTED")
    assert {state.name: state.value for state in FILE_STATES} == {
        name: i for i, name in enumerate(names)
    }


@pytest.mark.parametrize("coordinate", [0, 1])
@pytest.mark.parametrize("value", [torch.nan, -torch.inf, 1.1e12])
def test_either_coordinate_of_a_key_point_may_be_broken(coordinate, value):
    scene = random_scene(16, frames=1, views=3)
    scene.key_points[0, 1, 5, coordinate] = value
    status = triangulate(scene.cameras, scene.key_points, ones(scene)).status[0]
    assert status[5] == State.BAD_INPUT
    assert (status != State.OBSERVED).sum() == 1


@pytest.mark.parametrize("weight", [torch.nan, torch.inf])
def test_a_broken_weight_is_said(weight):
    scene = random_scene(17, frames=1, views=3)
    weights = ones(scene)
    weights[0, 2, 4] = weight
    status = triangulate(scene.cameras, scene.key_points, weights).status[0]
    assert status[4] == State.BAD_INPUT
    assert (status != State.OBSERVED).sum() == 1


def test_two_cameras_at_one_place_fix_no_point_though_a_third_is_elsewhere():
    scene = random_scene(18, frames=2, views=3)
    turn = vector_to_matrix(torch.tensor([0.02, -0.03, 0.1], dtype=torch.float64))
    R, t = scene.cameras.R.clone(), scene.cameras.t.clone()
    R[:, 1], t[:, 1] = turn @ R[:, 0], t[:, 0] @ turn.mT
    cameras = Cameras(scene.cameras.K, R, t)
    noise = 5 * torch.randn(scene.key_points.shape, generator=torch.Generator().manual_seed(0))
    key_points = project(cameras, scene.points)[0] + noise  # without it the two rays are one
    weights = ones(scene)
    weights[:, 2, :9] = 0
    status = triangulate(cameras, key_points, weights).status
    assert (status[:, :9] == State.PARALLEL).all()
    assert (status[:, 9:] == State.OBSERVED).all()


def test_a_point_behind_one_camera_is_said_with_its_depth():
    scene = random_scene(19, frames=1, views=3)
    points = scene.points.clone()
    points[:, 3] = 2 * scene.cameras.centre[:, 0]  # the rig looks at the origin
    key_points, depth = project(scene.cameras, points)
    result = triangulate(scene.cameras, key_points, ones(scene))
    assert result.status[0, 3] == State.BEHIND
    assert (result.status != State.OBSERVED).sum() == 1
    torch.testing.assert_close(result.depth_min, depth.amin(1))
    assert (result.points[0, 3] == 0).all()


def test_the_angle_of_many_views_is_the_root_mean_square_of_the_sines():
    scene = random_scene(20, frames=2, views=4)
    weights = ones(scene)
    weights[:, 3, ::2] = 0
    ray = scene.points[:, None] - scene.cameras.centre[:, :, None]
    ray = ray / ray.norm(dim=-1, keepdim=True)
    pairs = list(combinations(range(4), 2))
    sines = torch.stack([torch.linalg.cross(ray[:, i], ray[:, j]).norm(dim=-1) for i, j in pairs])
    used = torch.stack([(weights[:, i] > 0) & (weights[:, j] > 0) for i, j in pairs])
    expected = ((sines**2 * used).sum(0) / used.sum(0)).sqrt().asin()
    result = triangulate(scene.cameras, scene.key_points, weights)
    torch.testing.assert_close(result.angle, expected, rtol=0, atol=1e-8)


def test_rows_are_put_in_their_places():
    scene = random_scene(21, frames=4, views=3)
    whole = triangulate(scene.cameras, scene.key_points, ones(scene))
    few = ones(scene)[:2].clone()
    few[:, 1:] = 0
    part = triangulate(scene.cameras.index(slice(2)), scene.key_points[:2], few)
    mixed = whole.with_rows(torch.tensor([3, 1]), part)
    assert (mixed.status[[1, 3]] == State.FEW_VIEWS).all()
    for name in ("points", "status", "angle", "depth_min", "cond"):
        assert torch.equal(getattr(mixed, name)[[0, 2]], getattr(whole, name)[[0, 2]])
        assert torch.equal(getattr(mixed, name)[[3, 1]], getattr(part, name))


def test_squared_residuals_are_those_of_the_projection():
    scene = random_scene(22, frames=2, views=3).noisy(4, 0)
    system = System(scene.cameras, scene.key_points, torch.ones(3, 17, 2, dtype=torch.bool))
    points = scene.points.clone()
    points[:, 2] = 2 * scene.cameras.centre[:, 1]  # behind the second camera
    expected = reprojection_error(scene.cameras, scene.key_points, points).square()
    local = (points - system.origin[:, None]).permute(2, 1, 0)
    square = torch.full((3, 17, 2), 4.0, dtype=torch.float64)
    square[:, 5] = 0
    for view in range(3):
        found = system.square_residuals(local, square, view).mT
        torch.testing.assert_close(found[:, 6:], expected[:, view, 6:] / 4, rtol=1e-6, atol=1e-9)
        assert torch.isinf(found[:, 5]).all()
    assert torch.isinf(system.square_residuals(local, square, 1)[2]).all()


def test_frames_beyond_what_is_worked_on_at_once_are_the_same():
    scene = random_scene(23, frames=3, views=4).noisy(5, 0)
    many = [x.repeat(200, *[1] * (x.ndim - 1)) for x in (scene.key_points, ones(scene))]
    cameras = Cameras(*(x.repeat(200, *[1] * (x.ndim - 1)) for x in vars(scene.cameras).values()))
    together = triangulate(cameras, *many)
    few = triangulate(scene.cameras, scene.key_points, ones(scene))
    torch.testing.assert_close(together.points, few.points.repeat(200, 1, 1), rtol=0, atol=1e-9)
    shared = scene.cameras.index(0)
    rig = Cameras(*(x.expand(600, *x.shape) for x in vars(shared).values()))
    alone = triangulate(shared, many[0][299], many[1][299])
    torch.testing.assert_close(triangulate(rig, *many).points[299], alone.points, rtol=0, atol=1e-9)


def test_a_subset_s_point_is_in_front_of_every_camera_of_it():
    scene = random_scene(24, frames=1, views=3)
    points = scene.points.clone()
    points[:, 3] = 2 * scene.cameras.centre[:, 0]  # behind the first camera
    key_points = project(scene.cameras, points)[0]
    valid = torch.ones(1, 3, 17, dtype=torch.bool)
    subsets = every_subset(3)
    found, ok = triangulate_subsets(scene.cameras, key_points, valid, subsets)
    assert torch.equal(ok[..., 3], ~subsets[:, :, 3, 0])
    assert ok[..., :3].all()
    assert (found[..., 3, :][~ok[..., 3]] == 0).all()


def test_the_smallest_depth_is_over_the_used_views():
    scene = random_scene(25, frames=2, views=4)
    depth = project(scene.cameras, scene.points)[1]
    nearest = depth == depth.amin(1, keepdim=True)
    result = triangulate(scene.cameras, scene.key_points, (~nearest).double())
    torch.testing.assert_close(result.depth_min, depth.masked_fill(nearest, torch.inf).amin(1))
