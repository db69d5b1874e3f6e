from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from ghpt.config import build
from ghpt.data.datasets.frames import Frames
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import synthetic_recordings
from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import project, reprojection_error
from ghpt.geometry.triangulation import triangulate
from ghpt.models.estimators.classical import Linear, person_scale
from ghpt.models.estimators.uncertainty import UncertaintyModel
from scenes import random_scene


def full(covariance):
    return covariance[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


def test_the_covariance_is_the_inverse_of_the_normal_matrix_by_finite_differences():
    scene = random_scene(0, frames=2, views=4)
    batch = scene.batch()
    views = batch.valid.clone()
    views[:, 3, :5] = False
    found = UncertaintyModel(noise=0.004, prior=1e12, shared=0.0)(batch, scene.points, views)
    step = 1e-3 * torch.eye(3, dtype=torch.float64)
    pixels = [project(scene.cameras, scene.points + s * d)[0] for d in step for s in (1, -1)]
    J = torch.stack([(pixels[2 * i] - pixels[2 * i + 1]) / 2e-3 for i in range(3)], dim=-1)
    J = (
        J
        / person_scale(batch.key_points, batch.valid)[..., None, None, None]
        * views[..., None, None]
    )
    normal = torch.einsum("bvjpi,bvjpk->bjik", J, J)
    torch.testing.assert_close(
        full(found.covariance), 0.004**2 * torch.linalg.inv(normal), rtol=1e-5, atol=0
    )


def test_the_error_is_the_root_mean_square_over_the_used_views():
    batch = random_scene(1, frames=3, views=5).noisy(4, 0).batch()
    views = torch.rand(batch.valid.shape, generator=torch.Generator().manual_seed(0)) < 0.6
    points = Linear()(batch).points
    found = UncertaintyModel(noise=0.004, prior=4.0, shared=0.0)(batch, points, views)
    square = torch.where(
        views, reprojection_error(batch.cameras, batch.key_points, points) ** 2, 0.0
    )
    enough = views.sum(1) >= 2
    torch.testing.assert_close(found.error[enough], (square.sum(1) / views.sum(1)).sqrt()[enough])
    assert (found.error[~enough] == 0).all()
    assert (found.covariance[~enough] == 0).all()


@pytest.mark.parametrize("views", [2, 3, 5, 10])
def test_gaussian_noise_is_found_and_the_truth_is_inside_as_often_as_said(views):
    frames = 400
    scene = random_scene(2, frames, views)
    size = person_scale(scene.key_points, torch.ones(scene.key_points.shape[:-1], dtype=torch.bool))
    noise = torch.randn(
        scene.key_points.shape, generator=torch.Generator().manual_seed(views), dtype=torch.float64
    )
    batch = replace(
        scene, key_points=scene.key_points + 0.005 * size[..., None, None] * noise
    ).batch()
    depth = project(scene.cameras, scene.points)[1]
    points = triangulate(scene.cameras, batch.key_points, (depth * size[..., None]) ** -2).points
    quality = UncertaintyModel(noise=None, prior=30.0, shared=0.0).fit_to(
        batch, points, batch.valid
    )
    assert quality.noise == pytest.approx(0.005, rel=0.35 if views == 2 else 0.1)
    offset = (points - scene.points)[..., None]
    covariance = full(quality(batch, points, batch.valid).covariance)
    distance = (offset.mT @ torch.linalg.solve(covariance, offset)).flatten()
    for share, limit in ((0.5, 2.366), (0.9, 6.251), (0.95, 7.815)):
        assert (distance <= limit).double().mean() == pytest.approx(
            share, abs=0.15 if views == 2 else 0.05
        )


def test_few_views_are_shrunk_towards_the_recordings_noise():
    scene = random_scene(3, frames=1, views=8).noisy(5, 0)
    batch = scene.batch()
    points = Linear()(batch).points
    one, two = (
        UncertaintyModel(noise=1e-9, prior=p, shared=0.0)(batch, points, batch.valid).covariance
        for p in (1.0, 1e9)
    )
    assert (two[..., 0] < 1e-3 * one[..., 0]).all()
    wide = UncertaintyModel(noise=1e-9, prior=1e9, shared=3.0)(
        batch, points, batch.valid
    ).covariance
    torch.testing.assert_close(
        wide[..., [0, 3, 5]], torch.full_like(wide[..., :3], 9.0), rtol=1e-3, atol=0
    )


@pytest.mark.parametrize("views", [2, 4])
def test_a_joint_s_own_residuals_count_as_their_degrees_of_freedom(views):
    scene = random_scene(4, frames=2, views=views).noisy(5, 0)
    batch = scene.batch()
    points = Linear()(batch).points
    own, noise = UncertaintyModel(noise=0.01, prior=3.0, shared=0.0), 0.01
    alone = replace(own, prior=1e12)(batch, points, batch.valid).covariance
    size = person_scale(batch.key_points, batch.valid)[..., None]
    square = (reprojection_error(batch.cameras, batch.key_points, points) / size).square().sum(1)
    expected = alone / noise**2 * ((3 * noise**2 + square) / (3 + 2 * views - 3))[..., None]
    torch.testing.assert_close(
        own(batch, points, batch.valid).covariance, expected, rtol=1e-6, atol=0
    )


@pytest.mark.parametrize(
    ("split", "bands"),
    [
        ("validation", ((0.7, 0.9), (0.95, 1.0), (0.97, 1.0))),
        ("test", ((0.35, 0.65), (0.75, 0.95), (0.82, 0.98))),
    ],
)
def test_calibration_on_embedded_people_known_to_the_detector_and_not(split, bands):
    """Absolute positions: people that the detector was trained on are inside more often than said,
    others as often.
    """
    conf = Path(__file__).parents[1] / "conf"
    detector = Detector(**yaml.safe_load((conf / "detector/human36m.yaml").read_text()))
    settings = yaml.safe_load((conf / "predictor/default.yaml").read_text())["classical"]
    estimator = yaml.safe_load((conf / "baselines/default.yaml").read_text())["adaptive_ransac"]
    predictor = build(settings, "predictor.classical")(
        estimator=build(estimator, "baselines.adaptive_ransac")
    )
    takes = list(islice(synthetic_recordings("h36m", split, 0, detector), 4))
    frames = Frames(takes, np.arange(0, sum(map(len, takes)), 16))
    labelled = frames[range(len(frames))]
    batch = labelled.observations
    result = predictor.fit_to(batch)(batch)
    offset = (result.points - labelled.truth.points).double()[result.has_position][..., None]
    distance = (
        offset.mT
        @ torch.linalg.solve(full(result.covariance)[result.has_position].double(), offset)
    ).flatten()
    for limit, (low, high) in zip((2.366, 6.251, 7.815), bands, strict=True):
        assert low < (distance <= limit).double().mean() < high


@pytest.mark.parametrize("bad", [{"noise": 0.0}, {"prior": 0.0}, {"shared": -1.0}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(GhptConfigError):
        UncertaintyModel(**({"noise": 0.004, "prior": 4.0, "shared": 0.0} | bad))
