from dataclasses import replace

import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras, reprojection_error
from ghpt.geometry.state import State
from ghpt.models.estimators.classical import Linear, MEstimator, WeightedLinear, person_scale
from ghpt.models.estimators.lo_ransac import LoRansac
from ghpt.models.estimators.ransac import AdaptiveRansac, Ransac
from ghpt.observations import Observations
from scenes import random_scene

ROBUST = {
    "ransac": Ransac(threshold=0.02, pairs=100, seed=0),
    "ransac_random": Ransac(threshold=0.02, pairs=9, seed=0),
    "adaptive_ransac": AdaptiveRansac(
        threshold=0.02, pairs=100, seed=0, adapt=5.0, quantile=0.55, rounds=4
    ),
    "huber": MEstimator(loss="huber", scale=0.002, iterations=40, tolerance=1e-3),
    "cauchy": MEstimator(loss="cauchy", scale=0.002, iterations=40, tolerance=1e-3),
    "geman_mcclure": MEstimator(loss="geman_mcclure", scale=0.01, iterations=40, tolerance=1e-3),
    "lo_ransac": LoRansac(threshold=0.02, seed=0),
}
ALL = {"linear": Linear(), "weighted_linear": WeightedLinear(power=2.0), **ROBUST}
each = pytest.mark.parametrize("baseline", ALL.values(), ids=ALL.keys())
each_robust = pytest.mark.parametrize("baseline", ROBUST.values(), ids=ROBUST.keys())


def spoilt(frames=3, views=8, seed=0):
    """A scene with 0.5 pixels of noise and one view of each joint 150 pixels off."""
    scene = random_scene(seed, frames, views).noisy(0.5, seed)
    generator = torch.Generator().manual_seed(seed)
    view = torch.randint(views, (frames, 1, 17), generator=generator)
    wrong = torch.zeros(frames, views, 17, dtype=torch.bool).scatter_(1, view, True)
    return replace(scene, key_points=scene.key_points + 150.0 * wrong[..., None]), wrong


def worst(estimate, scene):
    return (estimate.points - scene.points).norm(dim=-1)[estimate.estimated].max()


@each
def test_exact_key_points_give_the_truth(baseline):
    scene = random_scene(0, frames=3, views=5)
    estimate = baseline(scene.batch())
    assert estimate.estimated.all()
    assert worst(estimate, scene) < 1e-4


@each_robust
def test_one_wrong_view_moves_a_robust_estimate_little(baseline):
    scene, _ = spoilt()
    assert worst(Linear()(scene.batch()), scene) > 50
    assert worst(baseline(scene.batch()), scene) < 15


def test_confidence_0_is_as_good_as_not_seen():
    scene, wrong = spoilt()
    confidence = torch.where(wrong, 0.0, 0.7).double()
    weighted = WeightedLinear(power=2.0)(scene.batch(confidence=confidence))
    masked = Linear()(scene.batch(valid=~wrong))
    torch.testing.assert_close(weighted.points, masked.points, rtol=0, atol=1e-7)
    torch.testing.assert_close(weighted.points, scene.points, rtol=0, atol=8)


@each
def test_all_cover_what_linear_covers(baseline):
    scene = random_scene(5, frames=6, views=4).noisy(3, 0)
    valid = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(1)) < 0.5
    )
    confidence = torch.zeros(valid.shape, dtype=torch.float64)
    estimate = baseline(scene.batch(valid, confidence))
    assert torch.equal(estimate.estimated, Linear()(scene.batch(valid)).estimated)
    assert torch.equal(estimate.estimated, valid.sum(1) >= 2)
    assert torch.isfinite(estimate.points).all()


@each
def test_a_frame_s_estimate_depends_on_no_other_frame(baseline):
    scene, _ = spoilt(frames=5, views=6)
    batch = scene.batch()
    together = baseline(batch)
    parts = {
        f: getattr(batch, f)
        for f in (
            "index",
            "recording",
            "key_points",
            "confidence",
            "valid",
        )
    }
    alone = replace(
        batch, cameras=batch.cameras.index(slice(3, 4)), **{f: x[3:4] for f, x in parts.items()}
    )
    torch.testing.assert_close(baseline(alone).points[0], together.points[3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["linear", "ransac", "huber", "cauchy"])
def test_the_order_of_the_views_is_nothing(name):
    scene, _ = spoilt()
    order = torch.tensor([5, 0, 7, 2, 1, 6, 4, 3])
    turned = replace(
        scene,
        cameras=scene.cameras.index((slice(None), order)),
        key_points=scene.key_points[:, order],
    )
    there, back = (ALL[name](s.batch()).points for s in (scene, turned))
    torch.testing.assert_close(there, back, rtol=0, atol=1e-6)


@each_robust
def test_the_resolution_and_the_unit_are_nothing(baseline):
    scene, _ = spoilt(views=6)
    zoom = torch.tensor([4.0, 4.0, 1.0], dtype=torch.float64).diag()
    cameras = Cameras(zoom @ scene.cameras.K, scene.cameras.R, scene.cameras.t)
    large = replace(scene, cameras=cameras, key_points=scene.key_points * 4)
    torch.testing.assert_close(
        baseline(large.batch()).points, baseline(scene.batch()).points, rtol=0, atol=1e-2
    )


def test_ransac_takes_the_inliers_of_the_best_pair():
    scene, wrong = spoilt(frames=2, views=5)
    estimate = ROBUST["ransac"](scene.batch())
    expected = Linear()(scene.batch(valid=~wrong))
    torch.testing.assert_close(estimate.points, expected.points, rtol=0, atol=1e-7)


def test_random_pairs_are_pairs_of_seen_views():
    scene = random_scene(1, frames=4, views=9)
    valid = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(1)) < 0.4
    )
    pairs = Ransac(threshold=0.02, pairs=20, seed=0)._pairs(scene.batch(valid))
    assert pairs.shape == (4, 20, 17, 9)
    assert not (pairs & ~valid.mT[:, None]).any()
    enough = (valid.sum(1) >= 2)[:, None].expand(-1, 20, -1)
    assert (pairs.sum(-1)[enough] == 2).all()


def test_ransac_without_an_inlier_falls_back_to_linear():
    scene = random_scene(2, views=4).noisy(50, 0)
    baseline = Ransac(threshold=1e-9, pairs=100, seed=0)
    torch.testing.assert_close(baseline(scene.batch()).points, Linear()(scene.batch()).points)


def test_the_m_estimator_minimises_pixels_and_says_when_it_has_not_finished():
    scene = random_scene(3, frames=4, views=5).noisy(3, 0)
    batch = scene.batch()
    square = MEstimator(loss="huber", scale=10.0, iterations=50, tolerance=1e-6).triangulate(batch)
    assert square.ok.all()

    def cost(points):
        return reprojection_error(batch.cameras, batch.key_points, points).square().sum(1)

    assert (cost(square.points) < cost(Linear()(batch).points)).float().mean() > 0.95
    step = torch.randn(
        200, *square.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    for direction in step:  # nothing 3 mm away is better
        assert (
            cost(square.points + 3 * direction / direction.norm(dim=-1, keepdim=True))
            > cost(square.points)
        ).all()
    short = MEstimator(loss="huber", scale=1e-4, iterations=1, tolerance=1e-6)
    result = short.triangulate(batch)
    assert (result.status == State.NOT_CONVERGED).all()
    assert short(batch).estimated.all()


def test_the_size_of_a_person_is_the_diagonal_of_what_is_seen():
    key_points = torch.tensor([[[0.0, 0], [3, 4], [100, 100]]])
    valid = torch.tensor([[True, True, False]])
    assert person_scale(key_points, valid).tolist() == [5.0]
    assert person_scale(key_points, ~valid).tolist() == [0.0]
    assert person_scale(key_points, valid & False).tolist() == [0.0]


@each
def test_a_batch_of_no_frames_gives_no_points(baseline):
    whole = vars(random_scene(4).batch())
    empty = {
        k: v[:0] if isinstance(v, torch.Tensor) else v.index(slice(0, 0)) for k, v in whole.items()
    }
    estimate = baseline(Observations(**empty))
    assert estimate.points.shape == (0, 17, 3)


@each
def test_the_dtype_is_that_of_the_key_points(baseline):
    scene, _ = spoilt(frames=1, views=4)
    batch = scene.batch()
    single = replace(
        batch, key_points=batch.key_points.float(), confidence=batch.confidence.float()
    )
    estimate = baseline(single)
    assert estimate.points.dtype == torch.float32
    torch.testing.assert_close(estimate.points.double(), baseline(batch).points, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    "build",
    [
        lambda: WeightedLinear(power=0.0),
        lambda: Ransac(threshold=-1.0, pairs=10, seed=0),
        lambda: Ransac(threshold=0.1, pairs=0, seed=0),
        lambda: MEstimator(loss="cauchy", scale=float("nan"), iterations=3, tolerance=0.1),
        lambda: LoRansac(threshold=0.0, seed=0),
    ],
)
def test_impossible_settings_are_refused(build):
    with pytest.raises(GhptConfigError):
        build()
