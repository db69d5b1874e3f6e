from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
import yaml

from ghpt.config import build
from ghpt.geometry.cameras import Cameras
from ghpt.models.estimators.classical import Linear, MEstimator, WeightedLinear, person_scale
from ghpt.models.estimators.lo_ransac import LoRansac
from ghpt.models.estimators.pool_average import PoolAverage
from ghpt.models.estimators.predictors import Classical, Learned, observe_joints
from ghpt.models.estimators.ransac import AdaptiveRansac, Ransac
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.uncertainty import UncertaintyModel
from ghpt.models.loss import StochasticLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.models.scorer import Scorer
from ghpt.paper.robustness.perturbation import Outliers
from ghpt.reconstruction import Reconstruction, State
from ghpt.skeleton import JOINT, JOINTS, make_skeleton
from scenes import random_scene

QUALITY = UncertaintyModel(noise=0.003, prior=4.0, shared=0.0)
ESTIMATORS = {
    "linear": Linear(),
    "weighted_linear": WeightedLinear(power=0.5),
    "ransac": Ransac(threshold=0.02, pairs=64, seed=0),
    "m_estimator": MEstimator(loss="geman_mcclure", scale=0.02, iterations=10, tolerance=1.0),
    "lo_ransac": LoRansac(threshold=0.02, seed=0),
}
M = ESTIMATORS["m_estimator"]


def classical(estimator=M, reject=None):
    return Classical(estimator, QUALITY, None, reject)


def learned(reject=None):
    config = yaml.safe_load((Path(__file__).parents[1] / "conf/scorer/pose.yaml").read_text())
    scorer = partial(Scorer, **{k: v for k, v in config.items() if not k.startswith("_")})
    loss = StochasticLoss(alpha=1.0, beta=0.0, gamma=0.0, relative_errors=True)
    model = StochasticEstimator(
        PoseTriangulation(True, True),
        scorer,
        loss,
        torch.optim.Adam,
        50,
        1.5,
        False,
        1.5,
        "weight",
        0,
    )
    model.fit_statistics(iter([random_scene(0, frames=20).batch()]))
    consensus = AdaptiveRansac(threshold=0.02, pairs=64, seed=0, adapt=5.0, quantile=0.55, rounds=4)
    return Learned(PoolAverage(model, consensus), QUALITY, None, reject)


def single(batch):
    return replace(batch, key_points=batch.key_points.float(), confidence=batch.confidence.float())


def sound(result, batch):
    """What any reconstruction keeps to."""
    frames, _, joints = batch.valid.shape
    assert result.points.shape == (frames, joints, 3)
    for field in ("points", "error", "covariance", "score"):
        assert torch.isfinite(getattr(result, field)).all(), field
        expected = torch.float64 if field == "points" else torch.float32
        assert getattr(result, field).dtype == expected
    assert torch.equal(result.frame, batch.index)
    missing = ~result.has_position
    for field in ("points", "error", "covariance"):
        assert (getattr(result, field)[missing] == 0).all()
    assert not result.views.mT[missing].any()
    assert (result.views.sum(1)[result.has_position] >= 2).all()
    assert not (result.views & ~batch.valid).any()
    return result


@pytest.mark.parametrize("name", ESTIMATORS)
def test_exact_key_points_give_the_truth_and_all_views(name):
    scene = random_scene(0, frames=3, views=5)
    result = sound(classical(ESTIMATORS[name])(scene.batch()), scene.batch())
    assert (result.state == State.OBSERVED).all()
    assert result.views.all()
    assert result.error.max() < 1e-3
    torch.testing.assert_close(result.points.double(), scene.points, rtol=0, atol=1e-2)


def test_the_learned_model_gives_the_truth_of_exact_key_points_and_its_score():
    scene = random_scene(1, frames=3, views=5)
    result = sound(learned()(scene.batch()), scene.batch())
    torch.testing.assert_close(result.points.double(), scene.points, rtol=0, atol=1e-1)
    assert result.views.all()
    assert (result.score != 0).all()


def test_the_learned_prediction_is_the_average_of_the_pool():
    batch = random_scene(2, frames=3, views=5).noisy(4, 0).batch()
    predictor = learned()
    averaged, result = predictor.average.estimate(batch), predictor(batch)
    expected = averaged.pool.estimate().points.double()
    torch.testing.assert_close(result.points, expected, rtol=0, atol=1e-3)
    assert torch.equal(result.views, averaged.views)
    torch.testing.assert_close(
        result.score, (averaged.pool.weights() * averaged.pool.logits).sum(-1), rtol=0, atol=1e-6
    )
    found = QUALITY(batch, averaged.triangulation.points, averaged.views)
    torch.testing.assert_close(result.covariance, found.covariance.float())


def test_displaced_key_points_spoil_the_average_of_the_hypotheses_and_not_the_learned_prediction():
    scene = random_scene(10, frames=40, views=5).noisy(2, 0)
    batch = Outliers(0.05, 0.1, 0.5)(scene.batch(), 0)
    predictor = learned()
    model = predictor.average.model
    pool = model.sample(batch, "average")
    result = sound(predictor(batch), batch)
    ours, average = (
        (points - scene.points).norm(dim=-1).mean()
        for points in (result.points, pool.hypotheses.points.mean(1))
    )
    assert result.has_position.all()
    assert ours < 0.3 * average
    moved = (batch.key_points - scene.key_points).norm(dim=-1) > 0
    assert result.views[moved].double().mean() < 0.2
    assert result.views[~moved].double().mean() > 0.95


def test_no_joint_is_lost_that_two_seen_views_determine():
    scene = random_scene(11, frames=20, views=4).noisy(3, 0)
    valid = (
        torch.rand(scene.key_points.shape[:-1], generator=torch.Generator().manual_seed(0)) < 0.6
    )
    batch = Outliers(0.3, 0.1, 0.5)(scene.batch(valid), 0)
    result = sound(learned()(batch), batch)
    placed = Linear()(batch).estimated
    assert not placed.all()
    assert result.has_position[placed].all()


@pytest.mark.parametrize("make", [classical, learned])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e6, -1e6, 1e30])
def test_a_value_that_no_detector_means_costs_its_own_view_alone(make, value):
    scene = random_scene(3, frames=2, views=4).noisy(1, 0)
    batch = scene.batch()
    key_points = batch.key_points.clone()
    key_points[0, 1, 4] = value  # one of four views
    key_points[1, :3, 7] = value  # three of four
    broken = replace(batch, key_points=key_points)
    result, good = (sound(make()(b), b) for b in (broken, batch))
    assert result.state[0, 4] == State.OBSERVED
    assert result.views[0, :, 4].tolist() == [True, False, True, True]
    assert (result.points[0, 4].double() - scene.points[0, 4]).norm() < 30
    assert result.state[1, 7] == State.BAD_INPUT
    others = torch.ones_like(result.state, dtype=torch.bool)
    others[0, 4] = others[1, 7] = False
    assert torch.equal(result.state[others], good.state[others])
    torch.testing.assert_close(result.points[others], good.points[others], rtol=0, atol=20)


@pytest.mark.parametrize("make", [classical, learned])
def test_each_reason_for_a_missing_joint_is_said(make):
    scene = random_scene(4, frames=3, views=3).noisy(1, 0)
    valid = torch.ones(scene.key_points.shape[:-1], dtype=torch.bool)
    valid[0, 1:, 2] = False
    cameras = scene.cameras
    K, R, t = (x.clone() for x in (cameras.K, cameras.R, cameras.t))
    for x in (K, R, t):
        x[1, 1:] = x[1, :1]  # one camera three times
    K[2, 0] = torch.nan
    key_points = scene.key_points.clone()
    key_points[1, 1:] = key_points[1, :1]
    batch = replace(scene, cameras=Cameras(K, R, t), key_points=key_points).batch(valid)
    result = sound(make()(single(batch)), batch)
    assert result.state[0, 2] == State.FEW_VIEWS
    assert (result.state[1] == State.PARALLEL).all()
    assert (result.state[2] == State.OBSERVED).all()
    assert not result.views[2, 0].any()


def spoilt(seed, offsets, joint=3):
    """A scene whose first frame has one joint's key points elsewhere in each view."""
    offsets = torch.tensor(offsets, dtype=torch.float64)
    scene = random_scene(seed, frames=8, views=len(offsets)).noisy(1, 0)
    key_points = scene.key_points.clone()
    key_points[0, :, joint] += offsets
    return replace(scene, key_points=key_points).batch()


def test_a_joint_that_no_two_views_explain_is_rejected():
    batch = spoilt(5, [[400.0, 0], [0, -400], [-300, 300]])
    result = sound(classical(reject=Rejection(0.1))(batch), batch)
    assert result.state[0, 3] == State.REJECTED
    assert (result.state != State.OBSERVED).sum() == 1


def test_the_learned_model_rejects_too():
    batch = spoilt(5, [[400.0, 0], [0, -400], [-300, 300], [-250, -250]])
    result = sound(learned(Rejection(0.1))(single(batch)), batch)
    assert result.state[0, 3] == State.REJECTED


def test_without_rejection_a_joint_is_kept_with_what_speaks_against_it():
    batch = spoilt(5, [[400.0, 0], [0, -400], [-300, 300]])
    kept = sound(classical()(batch), batch)
    assert kept.state[0, 3] == State.OBSERVED
    assert kept.error[0, 3] > 50
    assert kept.covariance[0, 3, [0, 3, 5]].min() > 100 * kept.covariance[1, 3, [0, 3, 5]].max()


def test_a_joint_of_two_noisy_views_stays_observed_though_little_else_is_seen():
    # nothing but one arm: the box around it is a fifth of the person's
    scene = random_scene(7, frames=8, views=4)
    size = person_scale(scene.key_points, torch.ones(scene.key_points.shape[:-1], dtype=torch.bool))
    key_points = scene.key_points.clone()
    key_points[0, 0, 10] += 0.06 * size[0, 0]
    valid = torch.ones(key_points.shape[:-1], dtype=torch.bool)
    valid[0, 2:] = False
    valid[0, :2, :10] = False
    valid[0, :2, 12:] = False
    batch = replace(scene, key_points=key_points).batch(valid)
    result = classical(reject=Rejection(0.1)).fit_to(batch)(batch)
    assert result.state[0, 10] == State.OBSERVED


def test_two_views_that_disagree_by_much_make_no_joint():
    scene = random_scene(8, frames=8, views=2)
    key_points = scene.key_points.clone()
    size = person_scale(key_points, torch.ones(key_points.shape[:-1], dtype=torch.bool))
    line = key_points[0, 0, 5] - key_points[0, 0].mean(0)
    across = torch.stack((-line[1], line[0])) / line.norm()
    for sign in (-1, 1):
        moved = key_points.clone()
        moved[0, 0, 5] += sign * 0.9 * size[0, 0] * across
        batch = replace(scene, key_points=moved).batch()
        result = classical(Linear(), Rejection(0.1)).fit_to(batch)(batch)
        assert result.state[0, 5] != State.OBSERVED


def test_a_view_that_is_off_is_not_among_those_that_made_the_joint():
    scene = random_scene(6, frames=2, views=6).noisy(1, 0)
    key_points = scene.key_points.clone()
    key_points[:, 2, 5] += 200
    batch = replace(scene, key_points=key_points).batch()
    for name in ("ransac", "m_estimator", "lo_ransac"):
        result = classical(ESTIMATORS[name])(batch)
        assert not result.views[:, 2, 5].any()
        assert result.views.sum() == result.views.numel() - 2
    assert classical(Linear())(batch).views.all()


@pytest.mark.parametrize("make", [classical, learned])
def test_a_frame_is_the_same_in_any_batch(make):
    batch = random_scene(7, frames=4, views=4).noisy(3, 0).batch()
    whole, one = make()(batch), make()(part(batch, slice(2, 3)))
    for field in ("points", "covariance", "error"):
        torch.testing.assert_close(
            getattr(one, field)[0], getattr(whole, field)[2], rtol=1e-5, atol=1e-4
        )
    assert torch.equal(one.views[0], whole.views[2])


def part(batch, rows):
    return type(batch)(
        **{k: v.index(rows) if isinstance(v, Cameras) else v[rows] for k, v in vars(batch).items()}
    )


@pytest.mark.parametrize("make", [classical, learned])
def test_no_frames_and_no_seen_joints_are_no_error(make):
    batch = random_scene(8, frames=2).batch()
    assert len(make()(part(batch, slice(0, 0)))) == 0
    result = make()(replace(batch, valid=torch.zeros_like(batch.valid)))
    assert isinstance(result, Reconstruction)
    assert (result.state == State.FEW_VIEWS).all()


def test_the_configuration_builds_both_and_each_finds_the_recordings_noise():
    conf = Path(__file__).parents[1] / "conf"
    config, baselines = (
        yaml.safe_load((conf / name / "default.yaml").read_text())
        for name in ("predictor", "baselines")
    )
    estimator = build(baselines["adaptive_ransac"], "baselines.adaptive_ransac")
    scene = random_scene(9, frames=30, views=5).noisy(2, 0)
    off = scene.key_points.clone()
    off[:, 2, ::2] += 200  # a view that agrees with no other is no noise
    batch = replace(scene, key_points=off).batch()
    size = person_scale(scene.key_points, batch.valid).mean()
    for made in (
        build(config["classical"], "predictor.classical")(estimator=estimator),
        build(config["learned"], "predictor.learned")(average=learned().average),
    ):
        assert made(batch).has_position.all()
        assert made.fit_to(batch).uncertainty.noise == pytest.approx(float(2 / size), rel=0.3)


MIXED = make_skeleton("x", "mixed", ("left_eye", *reversed(JOINTS)))
"""The 17 in another order, behind one more."""


def mixed(batch):
    """The batch with the nose as the eye, too."""
    order = [JOINT["nose"], *(JOINT[name] for name in MIXED.key_points[1:])]
    changed = {name: getattr(batch, name)[:, :, order] for name in ("key_points", "confidence")}
    return replace(batch, valid=batch.valid[:, :, order], **changed), order


def test_the_learned_model_sees_the_17_of_any_skeleton():
    batch = random_scene(2, frames=3, views=5).noisy(4, 0).batch()
    other, order = mixed(batch)
    expected = learned()(batch)
    found = sound(learned().for_skeleton(MIXED)(other), other)
    torch.testing.assert_close(found.points[:, 1:], expected.points[:, order[1:]])
    torch.testing.assert_close(found.score, expected.score)
    eye = random_scene(2, frames=3, views=5).points[:, JOINT["nose"]]
    assert float((found.points[:, 0] - eye).norm(dim=-1).max()) < 100


def test_observed_joints_are_means_in_the_images_where_all_parts_are_seen():
    batch = random_scene(3, frames=4, views=3).batch()
    at = [JOINT[name] for name in ("left_hip", "right_hip", "nose")]
    hips = make_skeleton("x", "hips", ("left_hip", "right_hip", "nose"))
    valid = batch.valid[:, :, at].clone()
    valid[0, 0, 1] = False
    confidence = torch.rand(valid.shape, dtype=torch.float64)
    part = replace(batch, key_points=batch.key_points[:, :, at], valid=valid, confidence=confidence)
    joints = observe_joints(part, hips)
    pelvis = JOINT["pelvis"]
    assert torch.equal(joints.valid[:, :, pelvis], valid[:, :, :2].all(-1))
    assert not joints.valid[:, :, JOINT["head_top"]].any()
    mean = part.key_points[:, :, :2].mean(2)
    torch.testing.assert_close(joints.key_points[1:, :, pelvis], mean[1:])
    torch.testing.assert_close(joints.confidence[1:, :, pelvis], confidence[1:, :, :2].amin(-1))
