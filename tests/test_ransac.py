"""The threshold that follows a frame's noise."""

from dataclasses import replace

import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import project
from ghpt.models.estimators.classical import Linear, person_scale
from ghpt.models.estimators.ransac import AdaptiveRansac, Ransac
from ghpt.paper.robustness.perturbation import RotatedCameras
from scenes import random_scene

FIXED = Ransac(threshold=0.005, pairs=64, seed=0)
ADAPTIVE = AdaptiveRansac(threshold=0.005, pairs=64, seed=0, adapt=5.0, quantile=0.55, rounds=4)


def error(estimator, scene, batch):
    return (estimator(batch).points - scene.points).norm(dim=-1).mean()


def test_little_noise_leaves_the_threshold_alone():
    scene = random_scene(0, frames=4, views=5).noisy(0.2, 0)
    assert torch.equal(ADAPTIVE(scene.batch()).points, FIXED(scene.batch()).points)


def test_much_noise_widens_it_in_the_frames_that_have_it():
    quiet, loud = (
        random_scene(0, frames=6, views=5).noisy(0.2, 0),
        random_scene(0, frames=6, views=5).noisy(15, 0),
    )
    mixed = replace(loud, key_points=torch.cat([loud.key_points[:3], quiet.key_points[3:]]))
    batch = mixed.batch()
    found = ADAPTIVE.triangulate(batch)
    inlier_threshold = ADAPTIVE.inlier_threshold(batch, found.points)
    assert (inlier_threshold[:3] > 0.01).all()
    assert (inlier_threshold[3:] == 0.005).all()
    assert torch.equal(found.points[3:], FIXED(batch).points[3:])
    linear = error(Linear(), loud, loud.batch())
    assert error(ADAPTIVE, loud, loud.batch()) < 1.1 * linear < error(FIXED, loud, loud.batch())


def test_cameras_that_are_off_widen_it_though_two_of_four_views_agree_by_chance():
    scene = random_scene(0, frames=40, views=4).noisy(1, 0)
    every_frame_anew = replace(scene.batch(), recording=torch.arange(40))
    batch = RotatedCameras(2.0)(every_frame_anew, 0)
    above, median = (replace(ADAPTIVE, adapt=2.0, quantile=quantile) for quantile in (0.6, 0.5))
    linear, fixed, above, median = (
        error(estimator, scene, batch) for estimator in (Linear(), FIXED, above, median)
    )
    assert above < 1.05 * linear < median < fixed


def test_outliers_do_not_widen_it():
    scene = random_scene(1, frames=5, views=6).noisy(0.2, 1)
    wrong = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(0)) < 0.2
    )
    size = person_scale(scene.key_points, torch.ones_like(wrong))[..., None, None]
    far = replace(scene, key_points=scene.key_points + 0.3 * size * wrong[..., None])
    batch = far.batch()
    found = ADAPTIVE.triangulate(batch)
    assert (ADAPTIVE.inlier_threshold(batch, found.points) == 0.005).all()
    views, agreed = ADAPTIVE.inlier_views(batch, found.points, found.ok)
    assert not (views & wrong)[agreed[:, None].expand_as(wrong)].any()


@pytest.mark.parametrize("sure", [(0, 1), (2, 3)])
def test_of_two_pairs_that_agree_the_confident_one_counts(sure):
    """Views 2 and 3 see another place: each pair of views explains itself."""
    scene = random_scene(3, frames=4, views=4)
    elsewhere, _ = project(scene.cameras, scene.points + 300.0)
    key_points = scene.key_points.clone()
    key_points[:, 2:] = elsewhere[:, 2:]
    confidence = torch.full(key_points.shape[:-1], 0.1, dtype=torch.float64)
    confidence[:, list(sure)] = 0.9
    batch = replace(scene, key_points=key_points).batch(confidence=confidence)
    trusting = replace(FIXED, confidence_exponent=1.0)
    offset = (trusting(batch).points - scene.points).norm(dim=-1)
    expected = 0.0 if sure == (0, 1) else 300.0 * 3**0.5
    torch.testing.assert_close(offset, torch.full_like(offset, expected), atol=0.1, rtol=0)


def test_a_frame_in_which_nothing_is_seen_keeps_the_threshold():
    scene = random_scene(2, frames=3, views=4).noisy(15, 0)
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    valid[1] = False
    batch = scene.batch(valid)
    found = ADAPTIVE.triangulate(batch)
    assert not found.ok[1].any()
    assert ADAPTIVE.inlier_threshold(batch, found.points)[1] == 0.005


@pytest.mark.parametrize(
    "settings", [{"adapt": 0.0}, {"rounds": 0}, {"threshold": -1.0}, {"quantile": 1.0}]
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(GhptConfigError):
        AdaptiveRansac(
            **{"threshold": 0.1, "pairs": 4, "seed": 0, "adapt": 5.0, "quantile": 0.55, "rounds": 4}
            | settings
        )
