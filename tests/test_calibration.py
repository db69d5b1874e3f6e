"""Calibration of a rig: exact on exact data, indifferent to order and resolution, honest about its
uncertainty.
"""

from dataclasses import replace

import pytest
import torch

import sizes
from ghpt.calibration.baseline import RigBaseline
from ghpt.calibration.moved import RigChange
from ghpt.calibration.normal_matrix import linearise
from ghpt.calibration.observations import choose_frames, observe, reweight
from ghpt.calibration.resection import PlacedRig
from ghpt.calibration.uncertainty import gauge
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.rotations import matrix_to_vector, nearest_rotation, vector_to_matrix
from ghpt.metrics.relative_pose import rotation_deg, translation_deg
from ghpt.models.estimators.classical import person_scale
from ghpt.models.relative_pose.scale import stature
from rigs_with_people import calibration, people, relative
from scenes import labelled_pairs

CALIBRATE = calibration()
PAIRS = [(a, b) for b in range(4) for a in range(b)]


def errors(estimate, cameras):
    """Largest angles (degrees) of relative rotations and translations."""
    found = [(relative(estimate.cameras, *pair), relative(cameras, *pair)) for pair in PAIRS]
    return (
        max(float(rotation_deg(a[0], b[0])) for a, b in found),
        max(float(translation_deg(a[1], b[1])) for a, b in found),
    )


@pytest.mark.parametrize("rig", ["h36m", "cmu3"])
def test_exact_key_points_give_the_exact_rig(rig):
    scene = people(rig, frames=20, noise=0.0)
    estimate = scene.calibrate(CALIBRATE)
    rotation, translation = errors(estimate, scene.cameras)
    assert estimate.calibrated.all()
    assert rotation < 1e-4
    assert translation < 1e-4
    baseline = [float(relative(c, 0, 1)[1].norm()) for c in (estimate.cameras, scene.cameras)]
    in_first = scene.points[estimate.frames] @ scene.cameras.R[0].T + scene.cameras.t[0]
    points = estimate.points * baseline[1] / baseline[0]
    assert (points - in_first)[estimate.estimated].norm(dim=-1).max() < 0.1


def test_order_of_cameras_and_resolution_change_nothing():
    scene = people(frames=40)
    plain = scene.calibrate(CALIBRATE)
    order = [2, 0, 3, 1]
    permuted = scene.views(order).calibrate(CALIBRATE)
    K = scene.K.clone()
    K[1, :2] *= 0.5
    key_points = scene.key_points.clone()
    key_points[:, 1] *= 0.5
    sizes = scene.sizes.clone()
    sizes[1] //= 2
    half = replace(scene, K=K, key_points=key_points, sizes=sizes).calibrate(CALIBRATE)
    for a, b in PAIRS:
        R, t = relative(plain.cameras, a, b)
        # another order starts elsewhere and keeps a few other borderline key points
        R2, t2 = relative(permuted.cameras, order.index(a), order.index(b))
        assert rotation_deg(R, R2) < 0.1
        assert translation_deg(t, t2) < 0.1
        R3, t3 = relative(half.cameras, a, b)
        assert rotation_deg(R, R3) < 0.02
        assert translation_deg(t, t3) < 0.02


def test_the_same_call_gives_the_same_rig():
    scene = people(frames=20)
    one, two = (scene.calibrate(CALIBRATE) for _ in range(2))
    assert torch.equal(one.cameras.t, two.cameras.t)
    assert torch.equal(one.covariance, two.covariance)


def test_all_pairs_are_better_than_pair_by_pair():
    rows = []
    for seed in range(3):
        scene = people(seed=seed)
        estimate = scene.calibrate(CALIBRATE)
        for p, (a, b) in enumerate(estimate.pairs.views.tolist()):
            R, _ = relative(scene.cameras, a, b)
            whole, _ = relative(estimate.cameras, a, b)
            rows.append([float(rotation_deg(x, R)) for x in (estimate.pairs.R[p], whole)])
    alone, whole = torch.tensor(rows).mean(0)
    assert whole < 0.6 * alone


def free_error(estimate, cameras):
    """The estimate's error in the gauge of the rig as a whole, [V, 6]."""
    found, true = estimate.cameras, cameras
    turn = nearest_rotation((found.R.mT @ true.R).sum(0))
    a, b = found.centre - found.centre.mean(0), (true.centre - true.centre.mean(0)) @ turn.T
    b = b * (a * b).sum() / b.square().sum()
    w = matrix_to_vector(found.R.mT @ true.R @ turn.T)
    G = gauge(found.R, found.centre)
    error = torch.cat((w, a - b), dim=-1).flatten()
    return (error - G @ torch.linalg.lstsq(G, error[:, None]).solution[:, 0]).view(-1, 6)


def test_uncertainty_is_the_size_of_the_error():
    z = []
    for seed in range(sizes.CALIBRATED_RIGS):
        scene = people(frames=30, seed=seed)
        estimate = scene.calibrate(CALIBRATE)
        z.append(
            free_error(estimate, scene.cameras)
            / estimate.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        )
    z = torch.stack(z)
    assert 0.7 < z.square().mean().sqrt() < 1.4
    assert (z.abs() < 2).double().mean() > 0.88


def test_errors_that_last_are_in_the_uncertainty():
    z = []
    for seed in range(3):
        scene = people(frames=30, noise=0.003, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        bias = torch.randn(scene.key_points.shape[1:], generator=generator, dtype=torch.float64)
        size = person_scale(scene.key_points, scene.valid)
        lasting = 0.02 * size[..., None, None] * bias
        estimate = replace(scene, key_points=scene.key_points + lasting).calibrate(CALIBRATE)
        variance = estimate.covariance.diagonal(dim1=-2, dim2=-1)
        z.append(free_error(estimate, scene.cameras) / variance.sqrt())
        assert estimate.evidence.lasting > 0.2
    assert 0.5 < torch.stack(z).square().mean().sqrt() < 1.8


def test_the_camera_that_moved_is_told_where_the_people_determine_it():
    scene = people(frames=40)
    estimate = scene.calibrate(CALIBRATE)
    turn = vector_to_matrix(torch.tensor([0.0, 0.03, 0.0], dtype=torch.float64))
    R = scene.cameras.R.clone()
    t = scene.cameras.t.clone()
    R[2] = turn @ R[2]
    t[2] = turn @ t[2]
    moved = Cameras(scene.cameras.K, R, t)
    change = RigChange.of(estimate, moved)
    assert change.suspects(2) == (2,)
    assert set(change.suspects(1)) == {1, 2}  # whoever is accused, the one that moved is named
    vague = replace(estimate, joint_covariance=1e6 * estimate.joint_covariance)
    assert set(RigChange.of(vague, moved).suspects(2)) == {0, 1, 2, 3}


def test_views_that_share_no_frame_are_not_linked():
    scene = people(frames=40)
    turns = torch.arange(40)[:, None] % 4 == torch.arange(4)
    apart = replace(scene, valid=scene.valid & turns[..., None])
    estimate = apart.calibrate(CALIBRATE)
    assert {"few_frames", "unlinked"} <= {found.code for found in estimate.findings}
    assert not estimate.calibrated.any()
    assert float(stature(estimate.points, estimate.estimated)) == 0


def problem(views=3, seed=0):
    scene = people(frames=3, seed=seed).views(list(range(views)))
    observed = observe(scene.K, scene.key_points, scene.valid, 0.01)
    cameras = scene.cameras
    points = scene.points.flatten(0, 1)
    rig = PlacedRig(
        cameras.R,
        cameras.t / 1000,
        torch.ones(views, dtype=torch.bool),
        points / 1000,
        observed.valid,
    )
    return observed, rig


def moved(rig, step):
    """After a step of the views' parameters: rotation vector about the world's axes, centre."""
    step = step.view(-1, 6)
    R = rig.R @ vector_to_matrix(step[:, :3]).mT
    centre = rig.centre + step[:, 3:]
    return replace(rig, R=R, t=-(R @ centre[..., None])[..., 0])


def test_gradient_is_that_of_the_cost():
    observed, rig = problem()
    state = linearise(observed, rig, rig.inlier, 3.0)
    h, count = 1e-6, 18
    # in the directions of the gauge, moved points included, the cost does not change
    G = gauge(rig.R, rig.centre)
    assert (state.matrix @ G).abs().max() < 1e-6 * state.matrix.abs().max()
    assert (state.scores.sum(0) @ G).abs().max() < 1e-6 * state.scores.abs().max()
    # with the points at their best place for the views, eliminating them leaves the plain gradient
    best = replace(rig, points=newton(observed, rig))
    after = linearise(observed, best, best.inlier, 3.0)
    plain = torch.tensor(
        [
            (
                linearise(observed, moved(best, d), best.inlier, 3.0).cost
                - linearise(observed, moved(best, -d), best.inlier, 3.0).cost
            )
            / (2 * h)
            for d in h * torch.eye(count, dtype=torch.float64)
        ],
        dtype=torch.float64,
    )
    torch.testing.assert_close(
        after.scores.sum(0), plain, rtol=1e-4, atol=1e-4 * float(plain.abs().max())
    )


def newton(observed, rig):
    """The points at their best place for the views as they are."""
    points = rig.points.clone().requires_grad_()
    optimiser = torch.optim.LBFGS(
        [points],
        max_iter=300,
        tolerance_grad=1e-10,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )

    def cost():
        optimiser.zero_grad()
        x = points @ rig.R.mT + rig.t[:, None]
        error = ((x[..., :2] / x[..., 2:] - observed.xy) / observed.noise[..., None])[rig.inlier]
        value = (4.5 * torch.log1p(error.square().sum(-1) / 9)).sum()
        value.backward()
        return value

    optimiser.step(cost)
    return points.detach()


def test_frames_cover_time_and_place():
    scene = people(frames=80, noise=0.0)
    still = scene.key_points[:1].expand(400, -1, -1, -1)
    key_points = torch.cat((still, scene.key_points))
    valid = torch.cat((scene.valid[:1].expand(400, -1, -1), scene.valid))
    confidence = torch.ones(valid.shape)
    chosen = choose_frames(key_points, confidence, valid, 40)
    assert len(chosen) == 40
    assert (chosen.diff() > 0).all()
    assert (chosen >= 400).sum() > 20  # a fifth of the time, most of the places
    assert torch.equal(choose_frames(key_points, confidence, valid, 1000), torch.arange(480))
    confidence[400:440] = 0.1
    assert (choose_frames(key_points, confidence, valid, 40) >= 440).sum() > (chosen >= 440).sum()


def test_noise_of_views_and_joints_is_found():
    generator = torch.Generator().manual_seed(0)
    scene = people(frames=80, noise=0.0)
    observed = observe(scene.K, scene.key_points, torch.ones_like(scene.valid), 0.01)
    view, joint = torch.tensor([1.0, 2.0, 0.5, 1.0]), torch.ones(17)
    joint[[0, 5]] = 1.7
    sigma = (view[:, None] * joint[observed.joint]).double()
    error = (
        sigma[..., None] * torch.randn(*sigma.shape, 2, generator=generator, dtype=torch.float64)
    ).norm(dim=-1)
    # of 2 x 4 numbers a point takes 3
    found = reweight(observed, error * (5 / 8) ** 0.5, observed.valid).noise / observed.noise
    assert (found / sigma - 1).abs().max() < 0.12


def batch_of_pairs():
    scenes = [people(frames=20, seed=seed) for seed in range(2)]
    pairs = [(0, (0, 1)), (0, (2, 0)), (1, (1, 3))]
    stack = lambda f: torch.stack([f(scenes[d]) for d, _ in pairs])  # noqa: E731
    cameras = Cameras(*(stack(lambda s, n=n: getattr(s.cameras, n)) for n in ("K", "R", "t")))
    valid = stack(lambda s: s.valid.transpose(0, 1))
    draw = torch.tensor([d for d, _ in pairs])
    labelled = labelled_pairs(
        cameras,
        torch.tensor([p for _, p in pairs]),
        stack(lambda s: s.key_points.transpose(0, 1)),
        valid,
        draw=draw,
    )
    one_rig = torch.zeros_like(draw)
    return replace(labelled, observations=replace(labelled.observations, rig=one_rig))


def test_baseline_calibrates_a_draw_once_and_gives_its_pairs():
    labelled, calls = batch_of_pairs(), []
    batch = labelled.observations

    class Counted:
        def __call__(self, *arguments):
            calls.append(1)
            return CALIBRATE(*arguments)

    baseline = RigBaseline.__new__(RigBaseline)
    RigBaseline.__init__(baseline, CALIBRATE, remembered=4, seed=0)
    baseline.calibration = Counted()
    found = baseline(batch)
    assert len(calls) == 2
    assert torch.equal(baseline(batch).R, found.R)
    assert len(calls) == 2
    R, t = labelled.truth.relative_pose()
    assert found.estimated.all()
    assert rotation_deg(found.R, R).max() < 1
    assert translation_deg(found.t, t).max() < 1
    torch.testing.assert_close(found.t.norm(dim=-1), torch.ones(3, dtype=torch.float64))


def test_baseline_masks_a_camera_that_sees_nobody():
    batch = batch_of_pairs().observations
    valid = batch.valid.clone()
    valid[:2, 1] = False  # of the first draw
    found = RigBaseline(CALIBRATE, remembered=4, seed=0)(replace(batch, valid=valid))
    assert found.estimated.tolist() == [False, True, True]
    assert torch.equal(found.R[0], torch.eye(3, dtype=torch.float64))
    assert not found.t[0].any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_broken_numbers_of_one_camera_leave_the_others(value):
    scene = people(frames=30)
    K = scene.K.clone()
    K[3, 0, 0] = value if value != 1e300 else -1.0
    estimate = replace(scene, K=K).calibrate(CALIBRATE)
    assert estimate.calibrated.tolist() == [True, True, True, False]
    key_points = scene.key_points.clone()
    key_points[:10, 2, 5] = value
    estimate = replace(scene, key_points=key_points).calibrate(CALIBRATE)
    assert estimate.calibrated.all()
    assert errors(estimate, scene.cameras)[0] < 1
    for part in (
        estimate.cameras.R,
        estimate.cameras.t,
        estimate.points,
        estimate.covariance,
        estimate.reprojection,
    ):
        assert torch.isfinite(part).all()


def test_nobody_seen_is_said():
    scene = people(frames=5)
    estimate = replace(scene, valid=torch.zeros_like(scene.valid)).calibrate(CALIBRATE)
    assert not estimate.calibrated.any()
    assert not estimate.converged
    assert {"few_frames", "unlinked"} <= {d.code for d in estimate.findings}


def test_arrays_that_do_not_belong_together_are_refused():
    scene = people(frames=5)
    with pytest.raises(GhptDataError, match="occurs twice"):
        replace(scene, names=("a", "a", "b", "c")).calibrate(CALIBRATE)
    with pytest.raises(GhptDataError, match="3 names"):
        replace(scene, names=("a", "b", "c")).calibrate(CALIBRATE)
    with pytest.raises(GhptDataError, match="two or more"):
        scene.views([0]).calibrate(CALIBRATE)
    with pytest.raises(GhptDataError, match="scale"):
        people(frames=20).calibrate(CALIBRATE).scale_by(0.0)
    with pytest.raises(GhptConfigError, match="frames"):
        calibration(frames=0)


def test_scaled_scales_lengths_alone():
    scene = people(frames=20)
    estimate = scene.calibrate(CALIBRATE)
    factor = float(
        relative(scene.cameras, 0, 1)[1].norm() / relative(estimate.cameras, 0, 1)[1].norm()
    )
    scaled = estimate.scale_by(factor)
    torch.testing.assert_close(scaled.cameras.R, estimate.cameras.R)
    torch.testing.assert_close(scaled.centre_std, factor * estimate.centre_std)
    torch.testing.assert_close(scaled.rotation_std_deg, estimate.rotation_std_deg)
    true = scene.cameras
    expected = (true.R[:1] @ (true.centre - true.centre[0])[..., None])[..., 0]
    assert (scaled.cameras.centre - expected).norm(dim=-1).max() < 60
    assert scaled.findings == estimate.findings
