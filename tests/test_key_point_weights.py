"""The weight of each key point: features, network, training, and the weights that ship."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from ghpt.data.datasets.frames import Frames
from ghpt.data.synthetic.random_recordings import VIEWS, random_recordings
from ghpt.errors import GhptConfigError
from ghpt.models.estimators.classical import Linear
from ghpt.models.estimators.frame_learned import FrameLearned
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.models.key_points.features import NAMES
from ghpt.models.key_points.problem import KeyPointWeights
from ghpt.models.key_points.scorer import KeyPointScorer
from ghpt.models.loss import PrecisionLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.weights import load_shipped
from ghpt.observations import Labelled
from ghpt.skeleton import JOINTS

RANSAC = {"threshold": 0.02, "pairs": 24, "adapt": 5.0, "quantile": 0.55, "rounds": 4}
LEARNED = FrameLearned("key_points", trust=0.5)


@pytest.fixture(scope="module")
def labelled():
    """Frames of twelve random recordings of the split that no training sees."""
    recordings = list(random_recordings("test", 0, 12, 6))
    return Frames(recordings, np.arange(72))[range(72)]


@pytest.fixture
def model():
    def adam(parameters):
        return torch.optim.Adam(parameters, lr=2e-2)

    return StochasticEstimator(
        problem=KeyPointWeights(**RANSAC),
        scorer=lambda size: KeyPointScorer(size, width=16, clip=8.0),
        loss=PrecisionLoss(alpha=0.05, gamma=1.0),
        optimizer=adam,
        hypotheses=1,
        temperature=1.0,
        gumbel=False,
        logit_std_cap=None,
        selection="weight",
        seed=0,
    )


def mean_error(estimate, truth):
    distance = (estimate.points - truth.points).norm(dim=-1)
    return distance[estimate.estimated].mean().item()


def test_random_recordings_have_two_to_eight_views_and_are_a_function_of_their_names():
    first = list(random_recordings("train", 0, 5, 2))
    again = list(random_recordings("train", 0, 5, 2))
    views = {int(recording.valid.any((0, 2)).sum()) for recording in first}
    assert views <= set(range(2, VIEWS + 1))
    assert len(views) > 2
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.key_points, b.key_points)


def test_features_are_finite_and_zero_for_what_is_not_seen(labelled, model):
    observations = labelled.observations
    hypotheses = model.problem.generate(observations, 1, observations.index)
    features = model.problem.featurize(hypotheses)
    assert features.shape == (len(labelled), VIEWS * len(JOINTS), len(NAMES))
    assert features.isfinite().all()
    assert (features[~hypotheses.usable().flatten(1)] == 0).all()


def test_what_cannot_be_seen_changes_nothing(labelled):
    observations = labelled.observations.rows(slice(0, 40))
    hidden = ~observations.valid[..., None]
    spoilt = replace(
        observations, key_points=torch.where(hidden, torch.nan, observations.key_points)
    )
    a = LEARNED(observations)
    b = LEARNED(spoilt)
    assert torch.equal(a.estimated, b.estimated)
    torch.testing.assert_close(a.points, b.points)


@torch.no_grad()
def test_weights_do_not_depend_on_the_order_of_the_views(labelled):
    observations = labelled.observations.rows(slice(0, 40))
    order = torch.randperm(VIEWS, generator=torch.Generator().manual_seed(0))
    shuffled = replace(
        observations,
        cameras=observations.cameras.index((slice(None), order)),
        key_points=observations.key_points[:, order],
        confidence=observations.confidence[:, order],
        valid=observations.valid[:, order],
    )
    model = load_shipped("key_points")
    start = model.problem.generate(observations, 1, observations.index)
    moved = replace(start, observations=shuffled)
    weights = model.scorer(model.problem.featurize(start)).softmax(-1).unflatten(1, (VIEWS, -1))
    turned = model.scorer(model.problem.featurize(moved)).softmax(-1).unflatten(1, (VIEWS, -1))
    torch.testing.assert_close(weights[:, order], turned, atol=1e-5, rtol=1e-2)


def test_a_frame_has_the_same_points_in_any_batch(labelled):
    observations = labelled.observations.rows(slice(0, 30))
    together = LEARNED(observations).points
    alone = torch.cat([LEARNED(observations.rows(slice(i, i + 1))).points for i in range(30)])
    torch.testing.assert_close(together, alone, atol=0.01, rtol=0)


def test_equal_weights_are_the_linear_estimate_of_equal_cameras(labelled, model):
    observations = labelled.observations
    K = observations.cameras.K[:, :1].expand_as(observations.cameras.K)
    observations = replace(observations, cameras=replace(observations.cameras, K=K))
    hypotheses = model.problem.generate(observations, 1, observations.index)
    count = hypotheses.usable().flatten(1).shape[1]
    estimate = model.problem.aggregate(hypotheses, torch.full((len(labelled), count), 1 / count))
    expected = Linear().triangulate(observations)
    both = estimate.estimated & expected.ok
    torch.testing.assert_close(estimate.points[both], expected.points[both])


def test_training_lowers_the_error(labelled, model):
    optimizer = model.configure_optimizers()
    part = labelled.rows(slice(0, 48))
    losses = []
    for step in range(10):
        pool = model.sample(part.observations, "hypotheses", part.truth, step)
        loss = model.terms(pool, pool.keys).total.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.95 * losses[0]


def test_shipped_weights_are_ahead_of_the_best_classical_estimator(labelled):
    ransac = AdaptiveRansac(threshold=0.02, pairs=24, seed=0, adapt=5.0, quantile=0.55, rounds=4)
    learned = mean_error(LEARNED(labelled.observations), labelled.truth)
    classical = mean_error(ransac(labelled.observations), labelled.truth)
    assert learned < 0.9 * classical


def test_a_joint_of_one_view_is_not_estimated(labelled):
    observations = labelled.observations
    only = observations.valid & (torch.arange(VIEWS) == 0)[:, None]
    assert not LEARNED(replace(observations, valid=only)).estimated.any()


def test_no_frames_give_no_poses(labelled: Labelled):
    assert LEARNED(labelled.observations.rows(slice(0, 0))).points.shape == (0, len(JOINTS), 3)


def test_an_unknown_name_of_weights_is_refused():
    with pytest.raises(GhptConfigError, match="key_points"):
        load_shipped("none")


def test_a_schedule_changes_the_learning_rate_step_by_step(model):
    model.schedule = partial(torch.optim.lr_scheduler.ExponentialLR, gamma=0.5)
    configured = model.configure_optimizers()
    configured["optimizer"].step()
    configured["lr_scheduler"]["scheduler"].step()
    assert configured["optimizer"].param_groups[0]["lr"] == pytest.approx(1e-2)
    assert configured["lr_scheduler"]["interval"] == "step"
