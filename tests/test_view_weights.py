"""The scorer's weights as view weights. Scorers are put in the place of a trained one, so that what
is due is known.
"""

from dataclasses import replace

import pytest
import torch
from torch import nn

from ghpt.errors import GhptConfigError
from ghpt.models.estimators.classical import Linear, person_scale
from ghpt.models.estimators.ransac import AdaptiveRansac, Ransac
from ghpt.models.estimators.view_weights import ViewWeights
from ghpt.models.loss import StochasticLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.paper.robustness.perturbation import RotatedCameras
from scenes import random_scene

CONSENSUS = Ransac(threshold=0.03, pairs=64, seed=0)


class Scores(nn.Module):
    """Minus the difference of a pose's features from ``wanted`` ones, or all the same without."""

    def __init__(self):
        super().__init__()
        self.wanted = None

    def forward(self, features):
        if self.wanted is None:
            return features.new_zeros(features.shape[:-1])
        return -(features - self.wanted[:, None]).norm(dim=-1)


def view_weights(power=2.0, hypotheses=300, consensus=CONSENSUS):
    loss = StochasticLoss(alpha=1.0, beta=0.01, gamma=0.02, relative_errors=True)
    model = StochasticEstimator(
        PoseTriangulation(coordinates=True, lengths=True),
        lambda size: Scores(),
        loss,
        torch.optim.Adam,
        hypotheses,
        temperature=1.5,
        gumbel=True,
        logit_std_cap=None,
        selection="weight",
        seed=0,
    )
    return ViewWeights(model, consensus, power)


def knowing(estimator, scene):
    """Let the scorer know the true poses' features."""
    problem = estimator.model.problem
    truth = problem.generate(scene.batch(), 1, torch.zeros(len(scene.points), dtype=torch.int64))
    estimator.model.scorer.wanted = problem.featurize(
        replace(truth, points=scene.points[:, None].float())
    )[:, 0]
    return estimator


def error(points, scene):
    return (points - scene.points).norm(dim=-1).mean()


def test_exact_key_points_give_the_truth():
    scene = random_scene(0, frames=3, views=5)
    estimate = view_weights()(scene.batch())
    assert estimate.estimated.all()
    assert (estimate.points - scene.points).abs().max() < 1e-4


def test_a_scorer_that_says_nothing_gives_nearly_the_linear_estimate():
    scene = random_scene(0, frames=8, views=4).noisy(4, 0)
    batch, all_agree = scene.batch(), Ransac(threshold=10.0, pairs=64, seed=0)
    blind = view_weights(1.0, hypotheses=2000, consensus=all_agree)(batch)
    apart = (blind.points - Linear()(batch).points).norm(dim=-1).mean()
    assert 0 < apart < 0.1 * error(blind.points, scene)


def test_a_scorer_that_knows_poses_finds_the_view_that_is_off():
    scene = random_scene(3, frames=8, views=4).noisy(1, 0)
    size = person_scale(scene.key_points, torch.ones(scene.key_points.shape[:-1], dtype=torch.bool))
    offset = torch.zeros_like(scene.key_points)
    offset[:, 2, 15, 0] = 0.02 * size[:, 2]  # a wrist, within what the consensus takes for noise
    scene = replace(scene, key_points=scene.key_points + offset)
    batch = scene.batch()
    knows, blind = knowing(view_weights(), scene).weigh(batch), view_weights().weigh(batch)
    assert knows.views[:, 2, 15].any()

    def of_wrist(found):
        return (found.triangulation.points - scene.points)[:, 15].norm(dim=-1).mean()

    assert of_wrist(knows) < 0.5 * of_wrist(blind)
    assert error(knows.triangulation.points, scene) < error(blind.triangulation.points, scene)


def test_hypotheses_are_made_of_views_that_agree():
    scene = random_scene(4, frames=3, views=6).noisy(0.5, 0)
    wrong = torch.zeros(scene.key_points.shape[:-1], dtype=torch.bool)
    wrong[:, 1, ::3] = True
    far = replace(scene, key_points=scene.key_points + 150.0 * wrong[..., None])
    found = view_weights().weigh(far.batch())
    assert torch.equal(found.views, ~wrong)
    assert not (found.pool.hypotheses.views & ~found.views.mT[:, None]).any()
    assert error(found.triangulation.points, scene) < 0.2 * error(
        Linear()(far.batch()).points, scene
    )
    torch.testing.assert_close(found.pool.weights().sum(-1), torch.ones(3))


def test_where_the_views_disagree_as_a_whole_a_scorer_that_is_wrong_harms_less():
    scene = random_scene(7, frames=20, views=4).noisy(1, 0)
    batch = RotatedCameras(2.0)(scene.batch(), 0)
    adaptive = AdaptiveRansac(
        threshold=0.005, pairs=64, seed=0, adapt=100.0, quantile=0.6, rounds=4
    )
    wrong = replace(scene, points=scene.points.roll(1, 0))
    points = {}
    for name, consensus in {
        "adaptive": adaptive,
        "fixed": Ransac(threshold=10.0, pairs=64, seed=0),
    }.items():
        found = knowing(view_weights(consensus=consensus), wrong).weigh(batch)
        assert found.views.all()  # the same pool
        points[name] = found.triangulation.points
    linear = error(Linear()(batch).points, scene)
    assert error(points["adaptive"], scene) - linear < 0.5 * (
        error(points["fixed"], scene) - linear
    )


def test_what_linear_determines_is_estimated_and_nothing_else():
    scene = random_scene(5, frames=6, views=4).noisy(3, 0)
    valid = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(1)) < 0.5
    )
    estimate = view_weights(hypotheses=20)(scene.batch(valid))
    assert torch.equal(estimate.estimated, Linear()(scene.batch(valid)).estimated)
    assert torch.isfinite(estimate.points).all()


def test_a_frame_s_estimate_depends_on_no_other_frame():
    scene = random_scene(6, frames=5, views=4).noisy(3, 0)
    batch, estimator = scene.batch(), view_weights(hypotheses=20)
    alone = estimator(batch.rows(torch.tensor([3])))
    torch.testing.assert_close(alone.points[0], estimator(batch).points[3], rtol=0, atol=1e-9)


def test_an_impossible_power_is_refused():
    with pytest.raises(GhptConfigError, match=r"view_weights\.power"):
        view_weights(power=0.0)
