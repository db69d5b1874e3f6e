from dataclasses import fields, replace

import cv2
import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.metrics.relative_pose import rotation_deg, translation_deg
from ghpt.models.relative_pose.baselines import (
    EightPoint,
    FivePoint,
    PoseLib,
    Ransac,
    Refined,
    Usac,
    _distinct,
    size_in_image,
)
from ghpt.models.relative_pose.refinement import PoseRefinement
from ghpt.observations import Labelled, PairObservations, RelativePoseEstimate
from ghpt.randomness import key, uniform
from scenes import labelled_pairs, random_scene

ROBUST = {
    "ransac": Ransac(samples=200, threshold=0.02, seed=0),
    "usac_magsac": Usac(
        method="USAC_MAGSAC", threshold=0.02, pixels=200.0, confidence=0.999, iterations=1000
    ),
    "usac_accurate": Usac(
        method="USAC_ACCURATE", threshold=0.02, pixels=200.0, confidence=0.999, iterations=1000
    ),
    "poselib": PoseLib(threshold=0.02, loss="CAUCHY", scale=0.01, iterations=1000, seed=0),
    "five_point": Refined(
        FivePoint(samples=100, threshold=0.02, seed=0),
        PoseRefinement(kernel=4.0, trim=4.0, rounds=12),
    ),
}
ALL = {"eight_point": EightPoint(), **ROBUST}
each = pytest.mark.parametrize("baseline", ALL.values(), ids=ALL.keys())
each_robust = pytest.mark.parametrize("baseline", ROBUST.values(), ids=ROBUST.keys())
EYE = torch.eye(3, dtype=torch.float64)


def labelled(
    seeds=range(3), frames=20, sigma=0.0, views=3, change=lambda rig, points: (rig, points)
) -> Labelled:
    """One pair of views (2, 0) of one rig for each seed, before it a person who walks about."""
    rigs, key_points = [], []
    for seed in seeds:
        scene = random_scene(seed, frames, views)
        place = torch.rand(
            frames, 1, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        rig, points = change(scene.cameras.index(0), scene.points + 2000 * (place - 0.5))
        noise = torch.randn(
            frames, views, 17, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        as_people = Cameras(*(x.expand(frames, *x.shape) for x in (rig.K, rig.R, rig.t)))
        rigs.append(rig)
        key_points.append((project(as_people, points)[0] + sigma * noise).transpose(0, 1))
    cameras = Cameras(*(torch.stack([getattr(r, n) for r in rigs]) for n in ("K", "R", "t")))
    pair = torch.tensor([[2, 0]]).expand(len(rigs), 2)
    return labelled_pairs(cameras, pair, torch.stack(key_points))


def pairs(*args, **kwargs) -> PairObservations:
    """What is seen of ``labelled``'s pairs."""
    return labelled(*args, **kwargs).observations


def with_outliers(batch: PairObservations, share=0.2) -> PairObservations:
    """That share of the joints of the reference view is far off."""
    generator = torch.Generator().manual_seed(1)
    wrong = torch.rand(batch.valid.shape, generator=generator) < share
    wrong[:, [0, 1]] = False
    shift = 300 * torch.randn(batch.key_points.shape, generator=generator, dtype=torch.float64)
    return replace(batch, key_points=batch.key_points + wrong[..., None] * shift)


def degrees(estimate: RelativePoseEstimate):
    """The errors of R and of the direction of t of the poses of ``pairs()``, whatever the noise."""
    R, t = labelled().truth.relative_pose()
    return rotation_deg(estimate.R, R), translation_deg(estimate.t, t)


def equal(one: RelativePoseEstimate, other: RelativePoseEstimate) -> bool:
    return all(
        torch.equal(getattr(one, f.name), getattr(other, f.name))
        for f in fields(RelativePoseEstimate)
    )


@each
def test_exact_key_points_give_the_true_pose_with_t_of_length_1(baseline):
    batch = pairs()
    estimate = baseline(batch)
    assert estimate.estimated.all()
    # OpenCV reads its points in float32
    limit = 0.02 if isinstance(baseline, Usac) else 1e-5
    assert all((error < limit).all() for error in degrees(estimate))
    torch.testing.assert_close(estimate.t.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(estimate.R @ estimate.R.mT, EYE.expand(3, 3, 3), rtol=0, atol=1e-9)
    assert estimate.R.dtype == torch.float64


@each_robust
def test_outliers_move_a_robust_estimate_little(baseline):
    batch = with_outliers(pairs(sigma=1))
    linear = EightPoint()(batch)
    assert linear.estimated.all()
    assert degrees(linear)[0].min() > 3
    estimate = baseline(batch)
    assert estimate.estimated.all()
    rotation, translation = degrees(estimate)
    assert rotation.max() < 1
    assert translation.max() < 1


@each
def test_a_pair_s_estimate_depends_on_no_other_pair_and_is_the_same_again(baseline):
    batch = with_outliers(pairs(range(4), sigma=2), share=0.05)
    together = baseline(batch)
    assert equal(baseline(batch), together)
    cv2.setRNGSeed(5)
    torch.manual_seed(5)
    for index in (torch.tensor([2]), torch.tensor([3, 2, 0])):
        some = baseline(batch.rows(index))
        for name in ("R", "t"):
            torch.testing.assert_close(
                getattr(some, name), getattr(together, name)[index], rtol=0, atol=1e-12
            )


@each
def test_joints_that_a_view_does_not_see_are_not_used(baseline):
    batch = pairs(sigma=1)
    valid = torch.rand(batch.valid.shape, generator=torch.Generator().manual_seed(0)) < 0.7
    expected = baseline(replace(batch, valid=valid))
    moved = torch.where(
        valid[..., None], batch.key_points, torch.tensor([torch.nan, 1e6], dtype=torch.float64)
    )
    assert equal(baseline(replace(batch, key_points=moved, valid=valid)), expected)
    assert all((error < 3).all() for error in degrees(expected))


@each
def test_other_views_are_nothing(baseline):
    batch = pairs(sigma=1)
    key_points = batch.key_points.clone()
    key_points[:, 1] += 1000
    assert equal(baseline(replace(batch, key_points=key_points)), baseline(batch))


@each
def test_the_resolution_is_nothing(baseline):
    batch = with_outliers(pairs(sigma=1), share=0.05)
    zoom = torch.tensor([4.0, 4.0, 1.0], dtype=torch.float64).diag()
    large = baseline(replace(batch, K=zoom @ batch.K, key_points=batch.key_points * 4))
    estimate = baseline(batch)
    torch.testing.assert_close(large.R, estimate.R, rtol=0, atol=1e-6)
    torch.testing.assert_close(large.t, estimate.t, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "baseline",
    [
        Ransac(samples=50, threshold=1e-12, seed=0),
        Usac(method="USAC_ACCURATE", threshold=1e-7, pixels=200.0, confidence=0.9, iterations=50),
        PoseLib(threshold=1e-7, loss="CAUCHY", scale=0.01, iterations=100, seed=0),
    ],
    ids=lambda baseline: type(baseline).__name__,
)
def test_a_robust_estimator_without_8_inliers_falls_back_to_all_correspondences(baseline):
    batch = pairs(sigma=10)
    linear = EightPoint()(batch)
    assert linear.estimated.all()
    assert equal(baseline(batch), linear)


def pure_rotation(rig: Cameras, points):
    turn = vector_to_matrix(torch.tensor([0.1, 0.2, 0.0], dtype=torch.float64))
    R, t = rig.R.clone(), rig.t.clone()
    R[0], t[0] = turn @ R[2], turn @ t[2]
    return Cameras(rig.K, R, t), points


DEGENERATE = {
    "rotation": lambda: pairs([0, 1], change=pure_rotation),
    "identical cameras": lambda: pairs(
        [0, 1], change=lambda rig, points: (rig.index([2, 1, 2]), points)
    ),
    "a line": lambda: pairs(
        [0, 1],
        change=lambda rig, p: (
            rig,
            p[..., :1] * torch.tensor([0.3, 0.6, 0.9], dtype=torch.float64),
        ),
    ),
    "a plane": lambda: pairs(
        [0, 1], change=lambda rig, p: (rig, p * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    ),
    "one joint": lambda: replace(
        pairs([0, 1]), key_points=torch.full((2, 3, 20, 17, 2), 7.0, dtype=torch.float64)
    ),
    "all NaN": lambda: replace(
        pairs([0, 1]), key_points=torch.full((2, 3, 20, 17, 2), torch.nan).double()
    ),
    "not seen": lambda: replace(pairs([0, 1]), valid=torch.zeros(2, 3, 20, 17, dtype=torch.bool)),
    "never together": lambda: replace(
        pairs([0, 1]),
        valid=torch.tensor([True, True, False])[None, :, None, None].expand(2, 3, 20, 17),
    ),
    "seven": lambda: replace(
        pairs([0, 1]), valid=(torch.arange(340) < 7).reshape(20, 17).expand(2, 3, 20, 17)
    ),
    "no frames": lambda: replace(
        pairs([0, 1]),
        valid=torch.zeros(2, 3, 0, 17, dtype=torch.bool),
        key_points=torch.zeros(2, 3, 0, 17, 2, dtype=torch.float64),
        confidence=torch.zeros(2, 3, 0, 17).double(),
    ),
}


@each
@pytest.mark.parametrize("name", DEGENERATE)
def test_what_determines_no_pose_is_said_and_never_raises(baseline, name):
    estimate = baseline(DEGENERATE[name]())
    assert not estimate.estimated.any()
    assert torch.equal(estimate.R, EYE.expand(2, 3, 3))
    assert torch.equal(estimate.t, torch.zeros(2, 3, dtype=torch.float64))


@each
def test_few_correspondences_are_enough(baseline):
    batch = pairs()
    batch = replace(batch, valid=(torch.arange(340) % 20 == 0).reshape(20, 17).expand(3, 3, 20, 17))
    estimate = baseline(batch)
    assert estimate.estimated.all()
    assert degrees(estimate)[0].max() < 0.5


@each
def test_a_batch_of_no_pairs_gives_no_poses(baseline):
    estimate = baseline(pairs([0]).rows(slice(0, 0)))
    assert estimate.R.shape == (0, 3, 3)
    assert estimate.t.shape == (0, 3)


@each
def test_key_points_in_float32_are_enough(baseline):
    batch = pairs(sigma=1)
    single = replace(
        batch, key_points=batch.key_points.float(), confidence=batch.confidence.float()
    )
    assert all((error < 3).all() for error in degrees(baseline(single)))


def test_the_size_in_the_image_is_the_median_over_frames_and_views():
    batch = pairs(frames=3)
    scale = torch.tensor([1.0, 2.0, 10.0], dtype=torch.float64)
    box = torch.zeros(17, 2, dtype=torch.float64)
    box[1] = torch.tensor([3.0, 4.0])
    key_points = (scale[:, None, None] * box).expand(3, 3, 3, 17, 2)
    K = torch.tensor([200.0, 200.0, 1.0], dtype=torch.float64).diag().expand(3, 3, 3, 3)
    same = replace(batch, key_points=key_points, K=K)
    torch.testing.assert_close(size_in_image(same), torch.full((3,), 10 / 200, dtype=torch.float64))
    unseen = same.valid.clone()
    unseen[1] = False
    assert size_in_image(replace(same, valid=unseen)).tolist() == pytest.approx([0.05, 0, 0.05])


def test_minimal_samples_are_distinct_and_fair():
    chosen = _distinct(uniform(key(0, "test"), (20000, 4)), 6)
    assert chosen.sort(dim=-1).values.diff(dim=-1).min() > 0
    subset = (1 << chosen).sum(-1)
    frequency = torch.bincount(subset).double()
    frequency = frequency[frequency > 0] / len(chosen)
    assert len(frequency) == 15
    assert (frequency - 1 / 15).abs().max() < 0.01


@pytest.mark.parametrize(
    "build",
    [
        lambda: Ransac(samples=0, threshold=0.1, seed=0),
        lambda: Ransac(samples=10, threshold=float("nan"), seed=0),
        lambda: Usac(method="LMEDS", threshold=0.1, pixels=100.0, confidence=0.9, iterations=10),
        lambda: Usac(
            method="USAC_MAGSAC", threshold=0.1, pixels=100.0, confidence=1.0, iterations=10
        ),
        lambda: Usac(
            method="USAC_MAGSAC", threshold=0.1, pixels=0.0, confidence=0.9, iterations=10
        ),
        lambda: PoseLib(threshold=0.1, loss="L2", scale=1.0, iterations=10, seed=0),
        lambda: PoseLib(threshold=0.1, loss="CAUCHY", scale=-1.0, iterations=10, seed=0),
    ],
)
def test_impossible_settings_are_refused(build):
    with pytest.raises(GhptConfigError):
        build()
