"""The camera problem: hypotheses, features, averages and errors of relative poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.geometry.cameras import Cameras, project
from ghpt.metrics.relative_pose import error_3d, rotation_deg
from ghpt.models.aggregation import AGGREGATIONS, aggregation_weights
from ghpt.models.relative_pose.problem import (
    RelativePose,
    RelativePoseHypotheses,
    quantiles,
    random_subsets,
)
from ghpt.models.relative_pose.scale import KnownScale
from ghpt.observations import Labelled, RelativePoseEstimate
from scenes import labelled_pairs, random_scene

FRAMES = 20


def batch_of(seeds: list[int], noise: float = 0.0, views: int = 3) -> Labelled:
    """For each seed a rig before which 20 people stand; pairs (0, 1), (0, 2), (1, 2), ... in
    turn."""
    rng = np.random.default_rng(seeds)
    K, R, t, key_points, points = [], [], [], [], []
    for seed in seeds:
        scene = random_scene(seed, frames=FRAMES, views=views)
        rig = scene.cameras.index(0)
        pixels, _ = project(Cameras(rig.K[None], rig.R[None], rig.t[None]), scene.points)
        K, R, t = [*K, rig.K], [*R, rig.R], [*t, rig.t]
        key_points.append(
            pixels.transpose(0, 1)
            + torch.from_numpy(rng.normal(0, noise, tuple(pixels.mT.shape)))
            .mT.reshape(pixels.shape)
            .transpose(0, 1)
            if noise
            else pixels.transpose(0, 1)
        )
        points.append(scene.points.reshape(-1, 3)[:100])
    pair = torch.tensor([[0, 1], [0, 2], [1, 2]])[torch.arange(len(seeds)) % 3]
    rigs = Cameras(torch.stack(K), torch.stack(R), torch.stack(t))
    return labelled_pairs(rigs, pair, torch.stack(key_points).float(), points=torch.stack(points))


def problem(**changes) -> RelativePose:
    settings = {
        "frames": FRAMES,
        "draws": 1,
        "points": 100,
        "sample": 40,
        "refine": 1,
        "features": 16,
        "scale": KnownScale(),
        "largest_error": 1000.0,
    }
    return RelativePose(**(settings | changes))


def keys(batch: Labelled) -> torch.Tensor:
    return batch.observations.index + 1000


@pytest.mark.parametrize("refine", [0, 1, 2])
def test_exact_key_points_give_the_true_pose_in_every_hypothesis(refine):
    batch, cameras = batch_of([0, 1, 2]), problem(refine=refine)
    h = cameras.generate(batch.observations, 30, keys(batch))
    R, t = batch.truth.relative_pose()
    assert h.estimated.all()
    assert rotation_deg(h.R, R[:, None].expand_as(h.R)).max() < 0.02  # the key points are float32
    assert ((h.t - t[:, None]).norm(dim=-1) / t.norm(dim=-1)[:, None]).max() < 1e-3
    assert cameras.featurize(h).abs().max() < 1
    assert cameras.error(cameras.as_estimates(h), batch.truth)[0].max() < 2


def test_features_are_sorted_and_say_nothing_of_the_order_of_frames_and_joints():
    batch, cameras = batch_of([3, 4], noise=5.0), problem()
    h = cameras.generate(batch.observations, 10, keys(batch))
    features = cameras.featurize(h)
    assert (features.diff(dim=-1) >= 0).all()
    order = torch.randperm(h.a.shape[1], generator=torch.Generator().manual_seed(0))
    permuted = RelativePoseHypotheses(
        h.R, h.t, h.estimated, h.a[:, order], h.b[:, order], h.both[:, order]
    )
    torch.testing.assert_close(cameras.featurize(permuted), features)


def test_features_have_one_length_for_any_number_of_frames_and_ignore_what_is_not_seen():
    batch, cameras = batch_of([3], noise=5.0), problem()
    h = cameras.generate(batch.observations, 10, keys(batch))
    valid = batch.observations.valid.clone()
    valid[:, 1, ::3, 4:9] = False
    partly = replace(
        batch.observations,
        valid=valid,
        key_points=torch.where(valid[..., None], batch.observations.key_points, 1e6),
    )
    a, b, both = partly.correspondences()
    hidden = cameras.featurize(RelativePoseHypotheses(h.R, h.t, h.estimated, a, b, both))
    kept = RelativePoseHypotheses(
        h.R, h.t, h.estimated, a[:, both[0]], b[:, both[0]], both[:, both[0]]
    )
    torch.testing.assert_close(hidden, cameras.featurize(kept))
    assert hidden.shape == (1, 10, 16)


def test_quantiles_are_numpy_s():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 50))
    mask = rng.random((3, 50)) < 0.7
    found = quantiles(torch.from_numpy(values), torch.from_numpy(mask), 9).numpy()
    for row in range(3):
        np.testing.assert_allclose(
            found[row], np.quantile(values[row, mask[row]], np.linspace(0, 1, 9))
        )
    nothing = quantiles(torch.ones(1, 4), torch.zeros(1, 4, dtype=torch.bool), 5)
    assert (nothing == 0).all()


def test_one_correspondence_has_all_quantiles_alike():
    one = quantiles(torch.tensor([[3.0, 7.0]]), torch.tensor([[False, True]]), 4)
    assert (one == 7).all()


def test_subsets_hold_as_many_correspondences_as_asked_and_only_usable_ones():
    both = torch.rand(3, 101, generator=torch.Generator().manual_seed(0)) < 0.6
    both[1, 12:] = False
    both[2] = False
    subsets = random_subsets(both, 200, 20, torch.arange(3))
    assert (subsets[0].sum(-1) == 20).all()
    assert (subsets[1].sum(-1) == min(8, int(both[1].sum()))).all()
    assert not subsets[2].any()
    assert not (subsets & ~both[:, None]).any()
    share = subsets[0].double().mean(0)[both[0]]
    expected = 20 / both[0].sum()
    assert ((share - expected).abs() < 5 * (expected * (1 - expected) / 200).sqrt()).all()


def test_at_most_half_of_the_correspondences_make_a_hypothesis_or_all_would_be_alike():
    both = torch.ones(1, 60, dtype=torch.bool)
    assert (random_subsets(both, 10, 80, torch.arange(1)).sum(-1) == 30).all()


def test_a_pair_s_hypotheses_do_not_depend_on_its_batch():
    batch, cameras = batch_of([5, 6, 7], noise=5.0), problem()
    together = cameras.generate(batch.observations, 20, keys(batch))
    alone = batch.observations.rows(slice(1, 2))
    single = cameras.generate(alone, 20, keys(batch)[1:2])
    torch.testing.assert_close(together.R[1], single.R[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(together.t[1], single.t[0], rtol=0, atol=1e-6)


def test_what_determines_no_pose_is_said_and_does_not_spoil_its_neighbours():
    batch, cameras = batch_of([0, 1, 2], noise=3.0), problem()
    valid = batch.observations.valid.clone()
    valid[0, 1] = False  # all joints missing in a view
    valid[1, 0, :, 1:] = False
    valid[1, 0, 7:] = False  # 7 correspondences
    spoilt = replace(batch.observations, valid=valid)
    h, whole = (
        cameras.generate(spoilt, 20, keys(batch)),
        cameras.generate(batch.observations, 20, keys(batch)),
    )
    assert h.estimated.tolist() == [False, False, True]
    assert torch.equal(h.R[2], whole.R[2])
    error, counted = cameras.error(cameras.as_estimates(h), batch.truth)
    assert counted.tolist() == [False, False, True]
    assert torch.isfinite(error).all()
    assert torch.isfinite(cameras.featurize(h)).all()
    same = replace(
        batch.observations, pair=torch.tensor([[1, 1], [0, 2], [1, 2]])
    )  # identical cameras
    assert cameras.generate(same, 20, keys(batch)).estimated.tolist() == [False, True, True]


def test_an_empty_share_of_a_batch_goes_through():
    empty = batch_of([0, 1, 2]).rows(slice(0))
    cameras = problem()
    h = cameras.generate(empty.observations, 10, keys(empty))
    assert cameras.featurize(h).shape == (0, 10, 16)
    assert cameras.error(cameras.as_estimates(h), empty.truth)[0].shape == (0, 10)
    assert cameras.aggregate(h, torch.zeros(0, 10)).R.shape == (0, 3, 3)


def test_one_weight_selects_and_equal_weights_average_whatever_the_quaternions_signs():
    batch, cameras = batch_of([8], noise=5.0), problem()
    h = cameras.generate(batch.observations, 3, keys(batch))
    chosen = cameras.aggregate(h, torch.tensor([[0.0, 1.0, 0.0]]))
    torch.testing.assert_close(chosen.R[0], h.R[0, 1])
    torch.testing.assert_close(chosen.t[0], h.t[0, 1])
    # rotations by almost 180 degrees, on both sides of it: their quaternions with w >= 0 are nearly
    # opposite
    R = torch.from_numpy(
        Rotation.from_rotvec([[0, 0, np.pi - 0.02], [0, 0, -np.pi + 0.04]]).as_matrix()
    )[None]
    two = RelativePoseHypotheses(R, torch.ones(1, 2, 3).double(), h.estimated, h.a, h.b, h.both)
    mean = cameras.aggregate(two, torch.tensor([[0.5, 0.5]]))
    expected = torch.from_numpy(Rotation.from_rotvec([0, 0, np.pi + 0.01]).as_matrix())
    assert rotation_deg(mean.R[0], expected) < 1e-6


def test_the_average_translation_keeps_the_known_length():
    batch, cameras = batch_of([9, 10], noise=15.0), problem()
    h = cameras.generate(batch.observations, 50, keys(batch))
    estimate = cameras.aggregate(h, torch.full((2, 50), 1 / 50))
    torch.testing.assert_close(estimate.t.norm(dim=-1), batch.truth.relative_pose()[1].norm(dim=-1))


def test_the_average_is_differentiable_in_the_weights():
    batch, cameras = batch_of([8], noise=5.0), problem()
    h = cameras.generate(batch.observations, 5, keys(batch))
    weights = torch.full((1, 5), 0.2, requires_grad=True)
    error, _ = cameras.error(cameras.aggregate(h, weights), batch.truth)
    error.sum().backward()
    assert torch.isfinite(weights.grad).all()
    assert (weights.grad != 0).any()


def test_the_error_is_nearly_that_of_linear_triangulation():
    batch, cameras = batch_of([11, 12, 13]), problem(largest_error=1e6)
    R, t = batch.truth.relative_pose()
    turn = torch.from_numpy(
        Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.004, (3, 3))).as_matrix()
    )
    estimate = RelativePoseEstimate(
        turn @ R, t + torch.tensor([10.0, -20.0, 15.0]), torch.ones(3, dtype=torch.bool)
    )
    true = batch.truth.cameras
    target_t = (estimate.R @ true.t[:, 0, :, None])[..., 0] + estimate.t
    guess = Cameras(
        true.K,
        torch.stack((true.R[:, 0], estimate.R @ true.R[:, 0]), 1),
        torch.stack((true.t[:, 0], target_t), 1),
    )
    reference, counted = error_3d(guess, true, batch.truth.points)
    mean = (reference * counted).sum(-1) / counted.sum(-1)
    error, _ = cameras.error(estimate, batch.truth)
    torch.testing.assert_close(error, mean, rtol=0.05, atol=0.5)


def test_best_is_below_every_selection_and_worst_above():
    batch, cameras = batch_of([14, 15, 16], noise=8.0), problem()
    h = cameras.generate(batch.observations, 40, keys(batch))
    errors, _ = cameras.error(cameras.as_estimates(h), batch.truth)
    logits = -cameras.featurize(h)[..., 8]
    found = {
        name: cameras.error(
            cameras.aggregate(h, aggregation_weights(name, logits, errors, 1.2, keys(batch))),
            batch.truth,
        )[0]
        for name in AGGREGATIONS
    }
    for name in ("most", "least", "stochastic", "random"):
        assert (found["best"] <= found[name]).all()
        assert (found[name] <= found["worst"]).all()
