import numpy as np
import pytest
import torch

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.normal_equations import (
    LARGEST,
    local_cameras,
    minors,
    solve_symmetric,
    valid_cameras,
    valid_key_points,
    view_equations,
    weighted_sum,
)
from scenes import random_scene

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def damaged(field: str, place: tuple[int, ...], value: float) -> Cameras:
    """One rig of three cameras, the second with a number exchanged."""
    cameras = random_scene(0, frames=1, views=3).cameras.index(0)
    getattr(cameras, field)[1, *place] = value
    return cameras


@pytest.mark.parametrize(
    ("field", "place", "value"),
    [
        ("K", (0, 0), 0.0),
        ("K", (0, 0), -1000.0),
        ("K", (1, 1), 0.9e-12),
        ("K", (0, 2), 1.1e12),
        ("K", (1, 2), torch.nan),
        ("K", (2, 0), 2e-6),
        ("K", (2, 1), -2e-6),
        ("K", (2, 2), 1 + 2e-6),
        ("R", (0, 0), 2.0),
        ("R", (2, 1), torch.inf),
        ("t", (2,), -1.1e12),
        ("t", (0,), torch.nan),
    ],
)
def test_what_is_no_camera_is_refused_alone(field, place, value):
    assert valid_cameras(damaged(field, place, value)).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("field", "place", "value"),
    [
        ("K", (0, 0), 1 / LARGEST),
        ("K", (0, 2), LARGEST),
        ("K", (2, 0), 0.9e-6),
        ("K", (2, 2), 1 - 0.9e-6),
        ("t", (2,), -LARGEST),
    ],
)
def test_a_camera_at_the_limit_is_one(field, place, value):
    assert valid_cameras(damaged(field, place, value)).all()


def test_a_left_handed_camera_is_none():
    cameras = random_scene(0, frames=1, views=3).cameras
    mirrored = Cameras(cameras.K, cameras.R * torch.tensor([1.0, 1.0, -1.0]), cameras.t)
    assert not valid_cameras(mirrored).any()


def test_key_points_are_usable_up_to_the_limit_in_valid_cameras():
    cameras = damaged("K", (0, 0), 0.0)
    key_points = torch.zeros(3, 5, 2, dtype=torch.float64)
    key_points[0, 1, 0], key_points[0, 2, 1] = LARGEST, -1.1 * LARGEST
    key_points[2, 3, 1], key_points[2, 4, 0] = torch.nan, -torch.inf
    expected = [[True, True, False, True, True], [False] * 5, [True, True, True, False, False]]
    assert valid_key_points(cameras, key_points).tolist() == expected


def test_local_cameras_see_the_same_from_their_median_centre():
    scene = random_scene(1, frames=2, views=3, place=1e6)
    local, origin = local_cameras(scene.cameras)
    torch.testing.assert_close(
        origin, scene.cameras.centre.median(dim=-2).values, rtol=0, atol=1e-6
    )
    pixels, depth = project(local, scene.points - origin[:, None])
    torch.testing.assert_close(pixels, scene.key_points, rtol=0, atol=1e-6)
    torch.testing.assert_close(depth, project(scene.cameras, scene.points)[1], rtol=0, atol=1e-6)


def test_an_invalid_camera_becomes_one_at_the_origin_and_moves_nothing():
    cameras = damaged("t", (0,), 1e300)
    local, origin = local_cameras(cameras)
    two = cameras.index(slice(0, None, 2))
    torch.testing.assert_close(origin, two.centre.amin(0))  # the lower of two is their median
    torch.testing.assert_close(local.centre[1], -origin)
    assert torch.equal(local.K[1], torch.eye(3, dtype=torch.float64))
    assert torch.equal(local_cameras(damaged("t", (0,), torch.nan))[1], origin)


def test_the_equations_of_a_view_are_its_rows_squared():
    scene = random_scene(2, frames=2, views=3).noisy(5, 0)
    scene.cameras.K[..., 0, 1] = 7  # skew
    usable = torch.rand(2, 3, 17, generator=torch.Generator().manual_seed(0)) < 0.7
    found = view_equations(scene.cameras, scene.key_points, usable)
    K, R, t, x = (
        array.numpy()
        for array in (scene.cameras.K, scene.cameras.R, scene.cameras.t, scene.key_points)
    )
    for b, v, j in np.ndindex(2, 3, 17):
        P = K[b, v] @ np.column_stack([R[b, v], t[b, v]])
        rows = np.array([x[b, v, j, i] * P[2] - P[i] for i in range(2)])
        matrix, right = rows[:, :3].T @ rows[:, :3], -rows[:, :3].T @ rows[:, 3]
        expected = [matrix[place] for place in SYMMETRIC] + list(right)
        np.testing.assert_allclose(
            found[b, v, j], bool(usable[b, v, j]) * np.array(expected), rtol=1e-9, atol=1e-6
        )


def test_a_weighted_sum_is_over_the_views():
    rng = torch.Generator().manual_seed(0)
    equations, weights = torch.rand(3, 9, 5, generator=rng), torch.rand(3, 5, generator=rng)
    torch.testing.assert_close(
        weighted_sum(equations, weights), (equations * weights[:, None]).sum(0)
    )


def test_minors_are_the_cofactors():
    A = np.random.default_rng(0).normal(size=(3, 3))
    M = A @ A.T
    cofactors = np.linalg.det(M) * np.linalg.inv(M)
    found = minors(tuple(torch.tensor(M[place]) for place in SYMMETRIC))
    np.testing.assert_allclose(found, [cofactors[place] for place in SYMMETRIC], rtol=1e-9)


@pytest.mark.parametrize(("smallest", "solved"), [(1e-12, True), (1e-14, False), (0.0, False)])
def test_a_system_that_is_nearly_singular_is_not_solved(smallest, solved):
    """tr(M) tr(M^-1) of diag(1, 1, e) is about 2 / e."""
    numbers = (1.0, 0.0, 0.0, 1.0, 0.0, smallest, 2.0, 3.0, 4.0 * smallest)
    *solution, condition = solve_symmetric(
        tuple(torch.tensor([n], dtype=torch.float64) for n in numbers)
    )
    if solved:
        torch.testing.assert_close(
            torch.cat(solution), torch.tensor([2.0, 3.0, 4.0], dtype=torch.float64)
        )
        assert condition == pytest.approx((2 + smallest) * (2 + 1 / smallest))
    else:
        assert torch.cat(solution).tolist() == [0, 0, 0]
        assert condition == torch.inf


def test_a_negative_determinant_is_no_solution():
    numbers = (-1.0, 0.0, 0.0, -1.0, 0.0, -1.0, 1.0, 1.0, 1.0)
    assert solve_symmetric(tuple(torch.tensor([n]) for n in numbers))[3] == torch.inf
