import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghpt.metrics.pose_error import MPJPE, joint_errors
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import PELVIS, SIX_JOINTS

KINDS = ("absolute", "relative", "aligned")


def frames(count: int, seed: int = 0, missing: float = 0.2):
    """Noisy estimates of random truths, with joints missing on both sides; group 1 of 3 has no
    frame.
    """
    g = torch.Generator().manual_seed(seed)
    truth = 300 * torch.randn(count, 17, 3, generator=g) + torch.tensor([1000.0, -2000.0, 900.0])
    points = truth + 20 * torch.randn(count, 17, 3, generator=g)
    estimated = torch.rand(count, 17, generator=g) > missing
    truth_valid = torch.rand(count, 17, generator=g) > missing
    group = 2 * torch.randint(0, 2, (count,), generator=g)
    return PoseEstimate(points, estimated), Truth(truth, truth_valid), group


def similarity_residual(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances after the best similarity, by scipy's Kabsch and the scale of least squares."""
    a, b = points - points.mean(0), target - target.mean(0)
    rotation, _ = Rotation.align_vectors(b, a)
    turned = rotation.apply(a)
    scale = (turned * b).sum() / (turned**2).sum()
    return np.linalg.norm(scale * turned - b, axis=1)


def slow_errors(estimate: PoseEstimate, truth: Truth, kind: str) -> list[dict[int, float]]:
    """For each frame, joint -> error, one joint at a time in numpy."""
    result = []
    arrays = (estimate.points.double(), estimate.estimated, truth.points.double(), truth.valid)
    for p, e, t, s in zip(*(array.numpy() for array in arrays), strict=True):
        joints = [j for j in range(17) if e[j] and s[j]]
        if kind == "relative":
            joints = joints if PELVIS in joints else []
            result.append(
                {j: np.linalg.norm((p[j] - p[PELVIS]) - (t[j] - t[PELVIS])) for j in joints}
            )
        elif kind == "aligned":
            joints = joints if len(joints) >= 3 else []
            distances = similarity_residual(p[joints], t[joints]) if joints else []
            result.append(dict(zip(joints, distances, strict=True)))
        else:
            result.append({j: np.linalg.norm(p[j] - t[j]) for j in joints})
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_equals_a_slow_reference(kind):
    estimate, truth, group = frames(40)
    metric = MPJPE(kind, groups=3, joints=17)
    metric.update(estimate, truth, group)
    result, slow = metric.compute(), slow_errors(estimate, truth, kind)
    everything = [error for frame in slow for error in frame.values()]
    six = [error for frame in slow for joint, error in frame.items() if joint in SIX_JOINTS]
    assert result.mean.item() == pytest.approx(np.mean(everything), rel=1e-9)
    assert result.six_joints.item() == pytest.approx(np.mean(six), rel=1e-9)
    assert result.coverage.item() == len(everything) / truth.valid.sum().item()
    for joint in range(17):
        expected = np.mean([frame[joint] for frame in slow if joint in frame])
        assert result.per_joint[joint].item() == pytest.approx(expected, rel=1e-9)
    for g in (0, 2):
        expected = np.mean(
            [e for frame, k in zip(slow, group, strict=True) if k == g for e in frame.values()]
        )
        assert result.per_group[g].item() == pytest.approx(expected, rel=1e-9)
    assert result.per_group[1].isnan()


def test_zero_where_it_should_be():
    _, truth, _ = frames(8)
    everywhere = torch.ones_like(truth.valid)
    truth = Truth(truth.points, everywhere)
    turn = torch.from_numpy(Rotation.from_euler("xyz", [0.3, 2.0, -1.0]).as_matrix())
    moved = PoseEstimate(truth.points + torch.tensor([5.0, 7.0, -9.0]), everywhere)
    similar = PoseEstimate(0.5 * truth.points.double() @ turn.mT + 77, everywhere)
    assert joint_errors(moved, truth, "absolute")[0].min() > 12
    assert joint_errors(moved, truth, "relative")[0].max() < 1e-3  # the float32 of the input
    assert joint_errors(similar, truth, "relative")[0][:, SIX_JOINTS].mean() > 100
    assert joint_errors(similar, truth, "aligned")[0].max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_count_changes_nothing(kind):
    estimate, truth, _ = frames(20)
    counts = (estimate.estimated & truth.valid)[..., None]
    spoilt = PoseEstimate(torch.where(counts, estimate.points, 1e6), estimate.estimated)
    errors, counted = joint_errors(estimate, truth, kind)
    spoilt_errors, spoilt_counted = joint_errors(
        spoilt, Truth(torch.where(counts, truth.points, -1e6), truth.valid), kind
    )
    assert torch.equal(counted, spoilt_counted)
    torch.testing.assert_close(spoilt_errors, errors, rtol=1e-12, atol=1e-9)


def test_frames_that_fix_no_frame_do_not_count():
    estimate, truth, _ = frames(4, missing=0.0)
    no_pelvis = estimate.estimated.clone()
    no_pelvis[:, PELVIS] = False
    assert not joint_errors(PoseEstimate(estimate.points, no_pelvis), truth, "relative")[1].any()
    two = torch.zeros_like(truth.valid)
    two[:, :2] = True
    errors, counted = joint_errors(PoseEstimate(estimate.points, two), truth, "aligned")
    assert not counted.any()
    assert (errors == 0).all()


def test_three_joints_are_enough_to_align():
    estimate, truth, _ = frames(1, missing=0.0)
    three = torch.zeros_like(truth.valid)
    three[:, [2, 9, 16]] = True
    errors, counted = joint_errors(PoseEstimate(estimate.points, three), truth, "aligned")
    assert torch.equal(counted, three)
    assert errors[three].max() > 1  # the noise has changed the triangle's shape


@pytest.mark.parametrize("kind", KINDS)
def test_uneven_processes_give_the_number_of_one(kind):
    estimate, truth, group = frames(97)
    whole, shares = MPJPE(kind, 3, 17), [MPJPE(kind, 3, 17) for _ in range(3)]
    whole.update(estimate, truth, group)
    for share, rows in zip(shares, (slice(0, 90), slice(90, 90), slice(90, 97)), strict=True):
        part = PoseEstimate(estimate.points[rows], estimate.estimated[rows])
        share.update(part, truth.rows(rows), group[rows])
    shares[0].merge_state(shares[1])
    shares[0].merge_state(shares[2])
    assert torch.equal(shares[0].measured, whole.measured)
    assert torch.equal(shares[0].with_truth, whole.with_truth)
    torch.testing.assert_close(
        shares[0].compute(), whole.compute(), rtol=1e-12, atol=0, equal_nan=True
    )
    assert all(
        reduction is torch.sum or reduction.__name__ == "dim_zero_sum"
        for reduction in whole._reductions.values()
    )


def test_nothing_to_average_is_nan():
    metric = MPJPE("absolute", 1, 17)
    nowhere, no_points = torch.zeros(0, 17, dtype=torch.bool), torch.zeros(0, 17, 3)
    estimate = PoseEstimate(no_points, nowhere)
    metric.update(estimate, Truth(no_points, nowhere), torch.zeros(0, dtype=torch.int64))
    assert metric.compute().mean.isnan()
