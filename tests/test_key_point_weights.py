"""The weight of each key point, and of each joint's hypotheses: features, network, training, and
the weights that ship.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from ghpt.data.datasets.frames import Frames
from ghpt.data.synthetic.random_recordings import VIEWS, random_recordings
from ghpt.errors import GhptConfigError
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.metrics.pose_error import joint_errors
from ghpt.models.estimators.classical import Linear
from ghpt.models.estimators.frame_learned import FrameLearned
from ghpt.models.estimators.ransac import AdaptiveRansac
from ghpt.models.joint.features import featurize
from ghpt.models.joint.problem import JointSubsets
from ghpt.models.key_points.features import NAMES
from ghpt.models.key_points.problem import KeyPointWeights
from ghpt.models.key_points.scorer import KeyPointScorer
from ghpt.models.loss import PrecisionLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.weights import load_shipped
from ghpt.observations import Labelled, PoseEstimate
from ghpt.paper.robustness.perturbation import Outliers
from ghpt.skeleton import JOINTS

RANSAC = {"threshold": 0.02, "pairs": 24, "adapt": 5.0, "quantile": 0.55, "rounds": 4}
ONCE = FrameLearned("key_points", joints=None)
LEARNED = replace(ONCE, passes=4)
BOTH = replace(LEARNED, joints="joint")


@pytest.fixture(scope="module")
def labelled():
    """Frames of twelve random recordings of the split that no training sees."""
    recordings = list(random_recordings("test", 0, 12, 6))
    return Frames(recordings, np.arange(72))[range(72)]


@pytest.fixture(scope="module")
def joints(labelled):
    """Hypotheses of the joints of a few frames."""
    observations = labelled.observations.rows(slice(0, 40))
    return JointSubsets("key_points").generate(observations, 12, observations.index)


@pytest.fixture
def model():
    def adam(parameters):
        return torch.optim.Adam(parameters, lr=2e-2)

    return StochasticEstimator(
        problem=KeyPointWeights(**RANSAC),
        scorer=lambda size: KeyPointScorer(size, width=16, clip=8.0, limit=None),
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
    together = BOTH(observations).points
    alone = torch.cat([BOTH(observations.rows(slice(i, i + 1))).points for i in range(30)])
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


def test_where_many_key_points_are_wrong_they_are_weighed_again_and_subsets_scored(labelled):
    observations = Outliers(0.2, 0.1, 0.5)(labelled.observations, 0)
    mean = {}
    for estimator in (ONCE, LEARNED, BOTH):
        errors, counted = joint_errors(estimator(observations), labelled.truth, "relative")
        mean[estimator] = errors[counted].mean().item()
    assert mean[LEARNED] < 0.97 * mean[ONCE]
    assert mean[BOTH] < 0.98 * mean[LEARNED]


def test_only_frames_that_moved_far_are_weighed_again(labelled):
    once, never = (ONCE(labelled.observations), replace(LEARNED, far=1e9)(labelled.observations))
    assert torch.equal(once.points, never.points)
    again = (LEARNED(labelled.observations).points != once.points).any(-1).any(-1)
    assert 0 < again.double().mean() < 0.9


def test_the_first_hypothesis_of_a_joint_is_the_context(joints):
    assert joints.points.shape[:2] == (40, 13)
    torch.testing.assert_close(joints.points[:, 0], joints.context.points)


def test_joints_are_scored_in_any_world_alike(joints):
    """The scorer sees people in 3D: where the world's zero and axes are is nothing to it."""
    angle = torch.tensor([0.3, -1.1, 0.4], dtype=torch.float64)
    R = vector_to_matrix(angle)
    shift = torch.tensor([3000.0, -500.0, 900.0], dtype=torch.float64)
    context = PoseEstimate(joints.context.points @ R.mT + shift, joints.context.estimated)
    trunk = joints.context.estimated.all(-1)
    here = featurize(joints.points, joints.context)[trunk]
    there = featurize(joints.points @ R.mT + shift, context)[trunk]
    assert trunk.sum() > 20
    torch.testing.assert_close(here, there, atol=0.02, rtol=0)


def test_a_joint_is_the_average_of_its_hypotheses_by_their_share(joints):
    problem = JointSubsets("key_points")
    shape = joints.points.shape[1:3]
    weights = torch.zeros(40, *shape)
    weights[:, 5] = 1e-3
    chosen = problem.aggregate(joints, weights.flatten(1))
    torch.testing.assert_close(chosen.points, joints.points[:, 5])
    equal = problem.aggregate(joints, torch.ones(40, *shape).flatten(1))
    torch.testing.assert_close(equal.points, joints.points.mean(1))
    none = problem.aggregate(joints, torch.zeros(40, *shape).flatten(1))
    torch.testing.assert_close(none.points, joints.context.points)


def test_a_joint_of_one_view_is_not_estimated(labelled):
    observations = labelled.observations
    only = observations.valid & (torch.arange(VIEWS) == 0)[:, None]
    assert not BOTH(replace(observations, valid=only)).estimated.any()


def test_no_frames_give_no_poses(labelled: Labelled):
    assert BOTH(labelled.observations.rows(slice(0, 0))).points.shape == (0, len(JOINTS), 3)


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
