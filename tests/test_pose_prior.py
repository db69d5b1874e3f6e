import numpy as np
import torch

from ghpt.metrics.pose_prior import PARTS, PosePrior, length_ratios
from ghpt.observations import PoseEstimate
from ghpt.skeleton import JOINT, MIRROR, SYMMETRIC_BONES


def frames(count: int, seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    body = 300 * torch.randn(17, 3, generator=g)
    points = body + 20 * torch.randn(count, 17, 3, generator=g)
    return PoseEstimate(points, torch.rand(count, 17, generator=g) > 0.1), torch.randint(
        0, 2, (count,), generator=g
    )


def test_equals_numpy_variance():
    estimate, subject = frames(200)
    metric = PosePrior(subjects=3)
    metric.update(estimate, subject)
    result = metric.compute()
    points, estimated = estimate.points.double().numpy(), estimate.estimated.numpy()
    for s in (0, 1):
        for p, part in enumerate(PARTS):
            ratios = []
            for i in np.flatnonzero(subject.numpy() == s):
                (a, b), (c, d) = SYMMETRIC_BONES[part]
                if estimated[i, [a, b, c, d]].all():
                    left = np.linalg.norm(points[i, a] - points[i, b])
                    ratios.append(left / np.linalg.norm(points[i, c] - points[i, d]))
            np.testing.assert_allclose(result[s, p].item(), np.var(ratios, ddof=1), rtol=1e-9)
    assert result[2].isnan().all()


def test_left_is_the_numerator():
    pose = torch.zeros(1, 17, 3)
    pose[0, JOINT["left_wrist"], 0], pose[0, JOINT["right_wrist"], 0] = 300.0, 200.0
    ratios, defined = length_ratios(PoseEstimate(pose, torch.ones(1, 17, dtype=torch.bool)))
    assert defined[0].tolist() == [
        part == "lower_arm" for part in PARTS
    ]  # other right parts have no length
    assert ratios[0, PARTS.index("lower_arm")] == 1.5


def test_mirroring_inverts_the_ratio():
    estimate, _ = frames(50)
    ratios, defined = length_ratios(estimate)
    mirrored, mirrored_defined = length_ratios(
        PoseEstimate(estimate.points[:, MIRROR], estimate.estimated[:, MIRROR])
    )
    assert torch.equal(defined, mirrored_defined)
    torch.testing.assert_close(mirrored, 1 / ratios)


def test_a_constant_asymmetry_costs_nothing():
    pose = frames(1)[0].points.expand(100, 17, 3).contiguous()
    scale = torch.linspace(0.5, 2, 100)[:, None, None]
    metric = PosePrior(subjects=1)
    metric.update(
        PoseEstimate(pose * scale, torch.ones(100, 17, dtype=torch.bool)),
        torch.zeros(100, dtype=torch.int64),
    )
    assert metric.compute().max() < 1e-10


def test_uneven_processes_give_the_number_of_one():
    estimate, subject = frames(97)
    whole, shares = PosePrior(2), [PosePrior(2) for _ in range(3)]
    whole.update(estimate, subject)
    for share, rows in zip(shares, (slice(0, 95), slice(95, 95), slice(95, 97)), strict=True):
        share.update(PoseEstimate(estimate.points[rows], estimate.estimated[rows]), subject[rows])
    shares[0].merge_state(shares[1])
    shares[0].merge_state(shares[2])
    assert torch.equal(shares[0].count, whole.count)
    torch.testing.assert_close(shares[0].compute(), whole.compute(), rtol=1e-10, atol=0)


def test_one_frame_has_no_variance():
    metric = PosePrior(1)
    metric.update(
        PoseEstimate(frames(1)[0].points, torch.ones(1, 17, dtype=torch.bool)),
        torch.zeros(1, dtype=torch.int64),
    )
    assert metric.compute().isnan().all()
