"""What a detector's confidence is worth, measured on a recording."""

from dataclasses import replace

import pytest
import torch

from ghpt.models.estimators.classical import MEstimator
from ghpt.models.estimators.lo_ransac import LoRansac
from ghpt.models.estimators.ransac import AdaptiveRansac
from scenes import random_scene

ESTIMATORS = {
    "adaptive_ransac": AdaptiveRansac(
        threshold=0.02, pairs=24, seed=0, adapt=5.0, quantile=0.55, rounds=4
    ),
    "m_estimator": MEstimator(loss="geman_mcclure", scale=0.1, iterations=10, tolerance=1.0),
    "lo_ransac": LoRansac(threshold=0.1, seed=0),
}


def observed(exponent, frames=60, views=5, seed=0):
    """Observations whose noise has the variance ``confidence ** -exponent``, and their truth."""
    scene = random_scene(seed, frames, views)
    generator = torch.Generator().manual_seed(seed)
    shape = scene.key_points.shape
    confidence = 0.1 + 0.9 * torch.rand(shape[:-1], generator=generator, dtype=torch.float64)
    noise = torch.randn(shape, generator=generator, dtype=torch.float64)
    deviation = 2.0 * confidence ** (-exponent / 2)
    key_points = scene.key_points + deviation[..., None] * noise
    batch = replace(scene, key_points=key_points).batch()
    return replace(batch, confidence=confidence), scene.points


def exponent_of(batch, name="adaptive_ransac"):
    return ESTIMATORS[name].fit_to(batch).confidence_exponent


@pytest.mark.parametrize("exponent", [1.0, 1.5])
def test_the_exponent_of_the_noise_is_found(exponent):
    batch, _ = observed(exponent)
    assert exponent_of(batch) == pytest.approx(exponent, rel=0.2)


@pytest.mark.parametrize("exponent", [0.0, -1.0])
def test_confidence_that_says_nothing_or_the_opposite_is_not_used(exponent):
    batch, _ = observed(exponent)
    assert exponent_of(batch) == 0.0


def test_constant_confidence_is_not_used():
    batch, _ = observed(1.0)
    assert exponent_of(replace(batch, confidence=torch.ones_like(batch.confidence))) == 0.0


def test_two_views_say_nothing():
    batch, _ = observed(1.0, views=2)
    assert exponent_of(batch) == 0.0


def test_few_joints_are_no_evidence():
    batch, _ = observed(1.0, frames=1)
    few = batch.valid & (torch.arange(17) < 2)
    assert exponent_of(replace(batch, valid=few)) == 0.0


def test_a_nan_among_the_confidences_changes_nothing():
    batch, _ = observed(1.0)
    confidence = batch.confidence.clone()
    confidence[0, 0, 0] = torch.nan
    spoilt = replace(batch, confidence=confidence)
    assert exponent_of(spoilt) == pytest.approx(exponent_of(batch), rel=0.01)
    fitted = ESTIMATORS["adaptive_ransac"].fit_to(spoilt)
    assert fitted(spoilt).points.isfinite().all()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_weights_by_the_fitted_exponent_lessen_the_error(name):
    batch, truth = observed(2.0)
    estimator = ESTIMATORS[name]
    fitted = estimator.fit_to(batch)
    errors = [(e(batch).points - truth).norm(dim=-1).mean().item() for e in (estimator, fitted)]
    assert errors[1] < 0.9 * errors[0]
