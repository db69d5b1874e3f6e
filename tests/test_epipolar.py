from functools import partial

import cv2
import numpy as np
import pytest
import torch

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.epipolar import (
    decompose,
    depths,
    eight_point,
    eight_point_subsets,
    essential,
    homogeneous,
    in_front,
    normalise,
    pose_in_front,
    poses_in_front,
    ray_distances,
    robust_weights,
    sampson_error,
)
from ghpt.geometry.rotations import vector_to_matrix
from scenes import random_scene

EYE, ZERO = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)


def two_views(seed, frames=20):
    """A rig of two cameras and the joints of a person in many poses, [N, 3]."""
    scene = random_scene(seed, frames=frames, views=2)
    return scene.cameras.index(0), scene.points.reshape(-1, 3)


def images(rig, points, sigma=0.0, dtype=torch.float64):
    """The points in both views, normalised image coordinates, from pixels of that dtype with noise
    (pixels).
    """
    pixels = project(rig, points)[0]
    noise = torch.randn(
        pixels.shape, generator=torch.Generator().manual_seed(0), dtype=pixels.dtype
    )
    return normalise(rig.K, (pixels + sigma * noise).to(dtype)).unbind(-3)


def relative(rig):
    """The true R and t."""
    R = rig.R[1] @ rig.R[0].T
    return R, rig.t[1] - R @ rig.t[0]


def ones(points):
    return torch.ones(points.shape[:-1], dtype=torch.float64)


def solve(a, b, weights=None):
    weights = ones(a) if weights is None else weights
    E, determined = eight_point(a, b, weights)
    R, t, front = pose_in_front(E, a, b, (weights > 0) & determined[..., None])
    return R, t, determined & front


def batch(seeds=range(4), sigma=2.0):
    pairs = [images(*two_views(seed), sigma) for seed in seeds]
    return tuple(torch.stack(x) for x in zip(*pairs, strict=True))


def rotated(rig):
    """The second camera at the place of the first, turned."""
    Q = vector_to_matrix(torch.tensor([0.05, 0.1, 0.02], dtype=torch.float64))
    return Cameras(
        rig.K, torch.stack((rig.R[0], Q @ rig.R[0])), torch.stack((rig.t[0], Q @ rig.t[0]))
    )


def degenerate(name, seed):
    """A rig and points that leave the essential matrix undetermined."""
    rig, points = two_views(seed)
    if name == "plane":
        points = points * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    elif name == "line":
        points = points[:, :1] * torch.tensor([0.3, 0.6, 0.9], dtype=torch.float64)
    elif name == "identical":
        rig = rig.index([0, 0])
    elif name == "rotation":
        rig = rotated(rig)
    elif name == "seven":
        points = points[:7]
    elif name == "seven repeated":
        points = points[:7].repeat(20, 1)
    return rig, points


DEGENERATE_SCENES = ("plane", "line", "identical", "rotation", "seven", "seven repeated")


def test_normalised_coordinates_are_those_of_the_camera_frame():
    rig, points = two_views(0)
    K = rig.K.clone()
    K[:, 0, 1] = 11  # skew
    skewed = Cameras(K, rig.R, rig.t)
    expected = points @ rig.R.mT + rig.t[:, None]
    found = torch.stack(images(skewed, points))
    torch.testing.assert_close(found, expected[..., :2] / expected[..., 2:], rtol=0, atol=1e-12)
    assert normalise(rig.K.float(), project(rig, points)[0].float()).dtype == torch.float64


@pytest.mark.parametrize("seed", range(6))
def test_an_exact_scene_gives_the_true_pose_and_depths(seed):
    rig, points = two_views(seed)
    a, b = images(rig, points)
    R, t = relative(rig)
    length = t.norm()
    E, determined = eight_point(a, b, ones(a))
    assert determined
    torch.testing.assert_close(
        torch.linalg.svdvals(E), torch.tensor([1.0, 1, 0], dtype=torch.float64)
    )
    assert ((homogeneous(b) @ E) * homogeneous(a)).sum(-1).abs().max() < 1e-11
    torch.testing.assert_close(
        E / E.norm() * torch.sign((E * essential(R, t)).sum()), essential(R, t / length) / 2**0.5
    )
    Rs, ts = decompose(E)
    difference = (Rs - R).flatten(1).norm(dim=1) + (ts - t / length).norm(dim=1)
    assert (difference < 1e-8).sum() == 1
    assert (torch.linalg.det(Rs) - 1).abs().max() < 1e-12
    Rf, tf, ok = pose_in_front(E, a, b, ones(a) > 0)
    assert ok
    torch.testing.assert_close(Rf, R, rtol=0, atol=1e-9)
    torch.testing.assert_close(tf, t / length, rtol=0, atol=1e-9)
    true_depths = project(rig, points)[1]
    for found, true in zip(depths(R, t / length, a, b), true_depths, strict=True):
        torch.testing.assert_close(found * length, true, rtol=1e-9, atol=0)
    assert ray_distances(R[None], t[None] / length, a, b).max() < 1e-9
    assert sampson_error(E[None], a, b).max() < 1e-10


def test_only_the_true_one_of_the_four_has_all_points_in_front():
    rig, points = two_views(3)
    a, b = images(rig, points)
    R, t = relative(rig)
    Rs, ts = decompose(essential(R, t))
    front = in_front(Rs, ts, a.expand(4, -1, -1), b.expand(4, -1, -1))
    assert sorted(front.double().mean(-1).tolist())[2:] == pytest.approx([0, 1], abs=0.01)
    assert (Rs[front.all(-1)] - R).abs().max() < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_noisy_points_give_what_numpy_and_opencv_give(seed):
    rig, points = two_views(seed)
    a, b = images(rig, points, sigma=4)
    weights = torch.from_numpy(np.random.default_rng(seed).uniform(0.1, 3, len(a)))
    E, _ = eight_point(a, b, weights)
    expected = slow_eight_point(a.numpy(), b.numpy(), weights.numpy())
    torch.testing.assert_close(E * torch.sign((E * expected).sum()), expected, rtol=0, atol=1e-9)
    squared = [
        cv2.sampsonDistance(x, y, E.numpy())
        for x, y in zip(*(homogeneous(p).numpy() for p in (a, b)), strict=True)
    ]
    np.testing.assert_allclose(sampson_error(E[None], a, b)[0] ** 2, squared, rtol=1e-8)
    R, t, ok = pose_in_front(E, a, b, ones(a) > 0)
    assert ok
    _, R_cv, t_cv, _ = cv2.recoverPose(E.numpy(), a.numpy(), b.numpy(), np.eye(3))
    np.testing.assert_allclose(R, R_cv, atol=1e-9)
    np.testing.assert_allclose(t, t_cv[:, 0], atol=1e-9)


def slow_eight_point(a, b, weights):
    """The reference: the null vector by SVD of the equations of points normalised by loops."""
    matrices, normalised = [], []
    for points in (a, b):
        mean = sum(w * p for w, p in zip(weights, points, strict=True)) / sum(weights)
        distance = sum(
            w * np.hypot(*(p - mean)) for w, p in zip(weights, points, strict=True)
        ) / sum(weights)
        s = np.sqrt(2) / distance
        T = np.array([[s, 0, -s * mean[0]], [0, s, -s * mean[1]], [0, 0, 1]])
        matrices.append(T)
        normalised.append([T @ [*p, 1] for p in points])
    rows = [np.sqrt(w) * np.kron(y, x) for w, x, y in zip(weights, *normalised, strict=True)]
    F = matrices[1].T @ np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3) @ matrices[0]
    U, _, Vt = np.linalg.svd(F)
    return torch.from_numpy(U @ np.diag([1.0, 1, 0]) @ Vt)


def test_ray_distances_are_those_of_the_nearest_points():
    rig, points = two_views(5)
    a, b = images(rig, points, sigma=10)
    R, t = relative(rig)
    t = t / t.norm()
    turn = vector_to_matrix(torch.tensor([[0.0, 0, 0], [0.02, -0.1, 0.3]], dtype=torch.float64))
    Rs, ts = turn @ R, turn @ t
    found = ray_distances(Rs, ts, a, b)
    for h in range(2):
        alpha, beta = depths(Rs[h], ts[h], a, b)
        one = alpha[:, None] * (homogeneous(a) @ Rs[h].T) + ts[h]
        torch.testing.assert_close(
            found[h], (one - beta[:, None] * homogeneous(b)).norm(dim=-1), rtol=1e-6, atol=1e-12
        )


@pytest.mark.parametrize(
    "frames", [8, 40]
)  # 136 correspondences, and 680, of which every third makes the median
def test_robust_weights_are_those_of_sampson_distances_under_geman_and_mcclure(frames):
    a, b = images(*two_views(4, frames), sigma=3)
    E = essential(*(x[None] for x in relative(two_views(4)[0])))
    used = torch.rand(len(a), generator=torch.Generator().manual_seed(0)) < 0.8
    r = sampson_error(E, a, b)[0]
    step = -(-len(a) // 256)
    scale = 3 * r[::step][used[::step]].median()
    residual = ((homogeneous(b) @ E[0]) * homogeneous(a)).sum(-1)
    expected = torch.where(used, (r / residual) ** 2 / (1 + (r / scale) ** 2) ** 2, 0.0)
    found = robust_weights(E, a, b, used)
    torch.testing.assert_close(found[0], expected / expected.max(), rtol=1e-7, atol=0)
    torch.testing.assert_close(
        robust_weights(2 * E.expand(3, 3, 3), a, b, used), found.expand(3, -1)
    )


def test_robust_weights_of_nothing_are_0():
    a, b = images(*two_views(4))
    E = essential(*relative(two_views(4)[0]))[None]
    assert (robust_weights(E, a, b, ones(a) == 0) == 0).all()


def test_the_order_of_the_correspondences_and_their_repetition_are_nothing():
    a, b = batch()
    order = torch.randperm(a.shape[1], generator=torch.Generator().manual_seed(0))
    R, t, ok = solve(a, b)
    assert ok.all()
    for x, y in ((a[:, order], b[:, order]), (a.repeat(1, 3, 1), b.repeat(1, 3, 1))):
        R2, t2, ok2 = solve(x, y)
        assert ok2.all()
        torch.testing.assert_close(R2, R, rtol=0, atol=1e-10)
        torch.testing.assert_close(t2, t, rtol=0, atol=1e-10)


def test_the_resolution_is_nothing():
    rig, points = two_views(1)
    pixels = project(rig, points)[0]
    zoom = torch.tensor([4.0, 4.0, 1.0], dtype=torch.float64).diag()
    torch.testing.assert_close(
        normalise(zoom @ rig.K, 4 * pixels), normalise(rig.K, pixels), rtol=0, atol=1e-14
    )


def test_exchanging_the_views_gives_the_inverse_pose():
    a, b = batch()
    R, t, _ = solve(a, b)
    R_back, t_back, _ = solve(b, a)
    torch.testing.assert_close(R_back, R.mT, rtol=0, atol=1e-9)
    torch.testing.assert_close(t_back, -(R.mT @ t[..., None])[..., 0], rtol=0, atol=1e-9)


def test_a_batch_is_a_stack_of_singles():
    a, b = batch()
    weights = torch.rand(
        a.shape[:-1], generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    together = solve(a.reshape(2, 2, -1, 2), b.reshape(2, 2, -1, 2), weights.reshape(2, 2, -1))
    for i in range(4):
        for x, y in zip(solve(a[i], b[i], weights[i]), together, strict=True):
            torch.testing.assert_close(y.flatten(0, 1)[i], x, rtol=0, atol=1e-11)


def test_hypotheses_are_a_batch():
    """What takes H poses or subsets at once is what each gives alone."""
    a, b = batch(range(2), sigma=0.2)
    subsets = torch.rand(2, 30, a.shape[1], generator=torch.Generator().manual_seed(0)) < 0.3
    subsets[:, :10] = False
    subsets[:, :10, 5:13] = True  # minimal
    subsets[:, 20, 7:] = False  # too few
    E, ok = eight_point_subsets(a, b, subsets.double())
    R, t, front = poses_in_front(E, a, b, subsets & ok[..., None])
    distances, sampson = ray_distances(R, t, a, b), sampson_error(E, a, b)
    for i in range(2):
        for h in range(30):
            E1, ok1 = eight_point(a[i], b[i], subsets[i, h].double())
            assert ok[i, h] == ok1 == (h != 20)
            # all subsets share one normalisation, which weighs the equations of more than 8 points
            # a little differently
            tolerance = 1e-7 if h < 10 else 0.02
            torch.testing.assert_close(
                E[i, h] * torch.sign((E[i, h] * E1).sum()), E1, rtol=0, atol=tolerance
            )
            found, expected = (
                (R[i, h], t[i, h], front[i, h]),
                slow_pose(E[i, h], a[i], b[i], subsets[i, h] & ok1),
            )
            for x, y in zip(found, expected, strict=True):
                torch.testing.assert_close(x, y, rtol=0, atol=1e-12)
            one = ray_distances(R[i, h][None], t[i, h][None], a[i], b[i])[0]
            torch.testing.assert_close(distances[i, h], one, rtol=1e-9, atol=1e-12)
            one = sampson_error(E[i, h][None], a[i], b[i])[0]
            torch.testing.assert_close(sampson[i, h], one, rtol=1e-9, atol=1e-12)


def slow_pose(E, a, b, used):
    """The pose of the four with most of the used points in front, one after the other."""
    Rs, ts = decompose(E)
    counts = [int((in_front(R, t, a, b) & used).sum()) for R, t in zip(Rs, ts, strict=True)]
    best = max(counts)
    if counts.count(best) > 1:
        return EYE, ZERO, torch.tensor(False)
    return Rs[counts.index(best)], ts[counts.index(best)], torch.tensor(True)


@pytest.mark.parametrize("value", [1000.0, torch.nan, torch.inf, 1e200])
def test_a_point_without_weight_changes_no_bit(value):
    a, b = batch()
    weights = ones(a)
    weights[:, ::7] = 0
    expected = solve(a, b, weights)
    for moved in ((True, False), (False, True), (True, True)):
        x, y = (p.clone() for p in (a, b))
        for points, move in zip((x, y), moved, strict=True):
            if move:
                points[:, ::7] += value
        for one, other in zip(solve(x, y, weights), expected, strict=True):
            assert torch.equal(one, other)


def test_a_point_that_is_not_finite_counts_as_without_weight():
    a, b = batch()
    weights = ones(a)
    weights[:, 3] = 0
    x = a.clone()
    x[:, 3, 1] = torch.nan
    for one, other in zip(eight_point(x, b, ones(a)), eight_point(a, b, weights), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_determines_no_pose_is_masked_at_any_rounding_of_the_pixels(name, dtype):
    for seed in range(8):
        rig, points = degenerate(name, seed)
        a, b = images(rig, points, dtype=dtype)
        E, determined = eight_point(a, b, ones(a))
        assert not determined
        assert (E == 0).all()
        R, t, ok = solve(a, b)
        assert not ok
        assert torch.equal(R, EYE)
        assert torch.equal(t, ZERO)


@pytest.mark.parametrize("frames", [1, 80])
def test_a_person_in_3d_is_never_masked(frames):
    for seed in range(20):
        rig, points = two_views(seed, frames)
        for sigma, dtype in ((0, torch.float64), (0, torch.float32), (15, torch.float32)):
            a, b = images(rig, points, sigma, dtype)
            assert eight_point(a, b, ones(a))[1]


def test_a_small_person_s_float32_pixels_are_judged_rightly():
    """In float32 a person of 50 pixels at the far corner of a full-HD image is rounded at 1e-6 of
    its size.
    """
    rig, points = two_views(0)
    shift = torch.tensor([[1.0, 0, 1800], [0, 1, 1000], [0, 0, 1]], dtype=torch.float64)
    K = shift @ torch.tensor([0.1, 0.1, 1.0], dtype=torch.float64).diag() @ rig.K
    for name, expected in (
        ("honest", True),
        ("plane", False),
        ("rotation", False),
        ("line", False),
    ):
        rig, points = degenerate(name, 0)
        a, b = images(Cameras(K, rig.R, rig.t), points, dtype=torch.float32)
        assert eight_point(a, b, ones(a))[1] == expected


def test_minimal_samples_are_hardly_ever_masked():
    for seed in range(4):
        a, b = images(*two_views(seed), sigma=3)
        chosen = (
            torch.rand(500, len(a), generator=torch.Generator().manual_seed(seed))
            .topk(8, dim=-1)
            .indices
        )
        ok = eight_point(a[chosen], b[chosen], ones(a[chosen]))[1]
        assert ok.double().mean() > 0.99


def bad_pairs():
    """Correspondences and weights that determine nothing, each in place of one pair of a batch."""
    a, b = batch([7])
    n = a.shape[1]
    cases = {
        name: images(*degenerate(name, 7)) for name in ("plane", "line", "identical", "rotation")
    }
    for name, (x, y) in cases.items():
        yield name, x, y, torch.ones(n, dtype=torch.float64)
    yield "all NaN", torch.full_like(a[0], torch.nan), b[0], torch.ones(n, dtype=torch.float64)
    yield "infinite", torch.full_like(a[0], torch.inf), b[0], torch.ones(n, dtype=torch.float64)
    yield "huge", a[0] * 1e200, b[0], torch.ones(n, dtype=torch.float64)
    yield (
        "one place",
        a[0, :1].expand(n, 2),
        b[0, :1].expand(n, 2),
        torch.ones(n, dtype=torch.float64),
    )
    for name, value in (
        ("no weight", 0.0),
        ("negative", -1.0),
        ("NaN", torch.nan),
        ("infinite weights", torch.inf),
    ):
        yield name, a[0], b[0], torch.full((n,), value, dtype=torch.float64)
    yield "seven", a[0], b[0], (torch.arange(n) < 7).double()


@pytest.mark.parametrize("case", list(bad_pairs()), ids=lambda case: case[0])
def test_a_bad_pair_is_masked_and_its_neighbours_keep_every_bit(case):
    a, b = batch()
    weights = ones(a)
    expected = solve(a, b, weights)
    assert expected[2].all()
    x, y, w = (v.clone() for v in (a, b, weights))
    x[2], y[2], w[2] = case[1:]
    R, t, ok = solve(x, y, w)
    assert ok.tolist() == [True, True, False, True]
    assert torch.equal(R[2], EYE)
    assert torch.equal(t[2], ZERO)
    for found, other in zip((R, t), expected[:2], strict=True):
        assert torch.equal(found[ok], other[ok])


def test_geometry_never_raises_on_values():
    nan = torch.full((3, 3), torch.nan, dtype=torch.float64)
    one = EYE.clone()
    one[0, 1] = torch.nan
    a, b = batch([0])
    for E in (nan, one, torch.zeros_like(nan), torch.full_like(nan, torch.inf)):
        Rs, ts = decompose(E)
        assert torch.isfinite(Rs).all()
        assert torch.isfinite(ts).all()
    assert torch.isfinite(sampson_error(torch.zeros_like(nan)[None], a[0], b[0])).all()
    for measure in (partial(ray_distances, EYE[None], ZERO[None]), partial(depths, EYE, ZERO)):
        assert all(torch.isfinite(x).all() for x in measure(a[0], a[0]))


def test_parallel_rays_have_no_depth():
    a = torch.tensor([[0.1, 0.2], [0.0, 0.0]], dtype=torch.float64)
    t = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert all((x == 0).all() for x in depths(EYE, t, a, a))
    assert not in_front(EYE, t, a, a).any()


def test_no_points_in_front_of_any_give_no_pose():
    a, b = batch([0])
    R, t = relative(two_views(0)[0])
    Rf, tf, ok = pose_in_front(
        essential(R, t)[None], a, b, torch.zeros(a.shape[:-1], dtype=torch.bool)
    )
    assert not ok
    assert torch.equal(Rf[0], EYE)
    assert torch.equal(tf[0], ZERO)
