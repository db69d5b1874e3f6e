import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ghpt.geometry.rotations import (
    average_rotation,
    is_rotation,
    matrix_to_quaternion,
    matrix_to_vector,
    nearest_rotation,
    procrustes,
    quaternion_to_matrix,
    rotation_between,
    vector_to_matrix,
)

SHAPES = [(), (1,), (3, 1, 2, 1)]


def random_rotations(shape, seed=0):
    count = int(np.prod(shape))
    return torch.from_numpy(
        Rotation.random(count, np.random.default_rng(seed)).as_matrix()
    ).reshape(*shape, 3, 3)


def special_rotations():
    """Angles about every kind of axis at 0, tiny, and around half turns."""
    axes = torch.tensor(
        [[1, 0, 0], [0, 1, 0], [0, 0, -1], [1, 1, 0], [-1, 2, 3]], dtype=torch.float64
    )
    axes = axes / axes.norm(dim=-1, keepdim=True)
    pi = torch.pi
    angles = [0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 1, pi / 2, pi - 1e-4, pi - 1e-8, pi - 1e-12, pi]
    return (axes[:, None] * torch.tensor(angles, dtype=torch.float64)[:, None]).flatten(0, 1)


@pytest.mark.parametrize("shape", SHAPES)
def test_quaternions_and_vectors_are_scipy_s(shape):
    R = random_rotations(shape)
    reference = Rotation.from_matrix(R.reshape(-1, 3, 3).numpy())
    q = matrix_to_quaternion(R)
    assert (q[..., 0] >= 0).all()
    expected = torch.from_numpy(np.roll(reference.as_quat(canonical=True), 1, axis=-1)).reshape(
        *shape, 4
    )
    torch.testing.assert_close(q, expected, rtol=0, atol=1e-12)
    v = torch.from_numpy(reference.as_rotvec()).reshape(*shape, 3)
    torch.testing.assert_close(matrix_to_vector(R), v, rtol=0, atol=1e-12)
    torch.testing.assert_close(vector_to_matrix(v), R, rtol=0, atol=1e-12)
    torch.testing.assert_close(quaternion_to_matrix(-3 * q), R, rtol=0, atol=1e-12)


def test_round_trips_hold_at_0_and_at_half_turns():
    v = special_rotations()
    R = vector_to_matrix(v)
    assert is_rotation(R, 1e-14).all()
    torch.testing.assert_close(
        R, torch.from_numpy(Rotation.from_rotvec(v).as_matrix()), rtol=0, atol=1e-14
    )
    torch.testing.assert_close(vector_to_matrix(matrix_to_vector(R)), R, rtol=0, atol=1e-14)
    torch.testing.assert_close(quaternion_to_matrix(matrix_to_quaternion(R)), R, rtol=0, atol=1e-14)
    small = v.norm(dim=-1) < 1e-3
    torch.testing.assert_close(matrix_to_vector(R)[small], v[small], rtol=1e-12, atol=1e-30)


def test_the_0_quaternion_is_the_identity():
    assert torch.equal(quaternion_to_matrix(torch.zeros(2, 4)), torch.eye(3).expand(2, 3, 3))


def test_is_rotation_refuses_what_is_none():
    R = random_rotations((4,))
    assert is_rotation(R, 1e-12).all()
    assert not is_rotation(-R, 1e-3).any()
    assert not is_rotation(1.01 * R, 1e-3).any()
    assert is_rotation(1.0001 * R, 1e-3).all()
    for value in (torch.nan, torch.inf, 1e300):
        broken = R.clone()
        broken[1, 2, 0] = value
        assert is_rotation(broken, 1e-3).tolist() == [True, False, True, True]


def test_the_nearest_rotation_is_the_polar_factor_and_never_a_reflection():
    R = random_rotations((50,))
    torch.testing.assert_close(nearest_rotation(R * 3), R, rtol=0, atol=1e-12)
    M = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 3, 3)))
    nearest = nearest_rotation(M)
    assert is_rotation(nearest, 1e-12).all()
    for wiggle in special_rotations():  # no other rotation is nearer
        other = vector_to_matrix(wiggle) @ nearest
        assert ((M - other).norm(dim=(-2, -1)) >= (M - nearest).norm(dim=(-2, -1)) - 1e-12).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 0.0])
def test_one_bad_matrix_does_not_spoil_the_batch(value):
    M = random_rotations((3,)) * 2
    M[1] = value
    nearest = nearest_rotation(M)
    assert is_rotation(nearest, 1e-12).all()
    torch.testing.assert_close(nearest[::2], M[::2] / 2, rtol=0, atol=1e-12)


direction = st.lists(
    st.one_of(st.floats(-1e3, 1e3), st.sampled_from([0.0, -0.0, 1e-300, 1.0, -1.0])),
    min_size=3,
    max_size=3,
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    direction,
    direction,
    st.sampled_from([1.0, -1.0]),
    st.sampled_from([0.0, 1e-16, 1e-12, 1e-8, 1e-4, 1.0]),
)
def test_rotation_between_takes_one_direction_to_the_other(a, b, sign, mix):
    a = torch.tensor(a, dtype=torch.float64)
    b = sign * a + mix * torch.tensor(
        b, dtype=torch.float64
    )  # from exactly on the line of a to anywhere
    R = rotation_between(a, b)
    assert is_rotation(R, 1e-13)
    lengths = a.abs().max(), b.abs().max()
    if min(lengths) == 0:
        assert torch.equal(R, torch.eye(3, dtype=torch.float64))
        return
    a, b = ((x / n) / (x / n).norm() for x, n in zip((a, b), lengths, strict=True))
    assert (R @ a - b).abs().max() < 1e-14
    # minimal: no turn about the directions themselves, so the angle of R is the one between them
    angle = 2 * torch.atan2((a - b).norm(), (a + b).norm())
    assert abs(matrix_to_vector(R).norm() - angle) < 1e-7


def test_rotations_between_a_batch_of_directions_are_those_between_each_pair():
    rng = torch.Generator().manual_seed(0)
    a, b = (torch.randn(4, 3, 3, generator=rng, dtype=torch.float64) for _ in range(2))
    b[0, 0], b[1, 1], a[2, 2] = -a[0, 0], a[1, 1], 0.0
    together = rotation_between(a, b)
    for i, j in np.ndindex(4, 3):
        torch.testing.assert_close(
            together[i, j], rotation_between(a[i, j], b[i, j]), rtol=0, atol=1e-15
        )


def test_rotation_between_is_the_identity_where_a_direction_is_none():
    good = torch.tensor([1.0, 2.0, 3.0])
    bad = torch.tensor([[0.0, 0, 0], [torch.nan, 0, 1], [torch.inf, 0, 0]])
    identity = torch.eye(3).expand(3, 3, 3)
    assert torch.equal(rotation_between(bad, good.expand(3, 3)), identity)
    assert torch.equal(rotation_between(good.expand(3, 3), bad), identity)


@pytest.mark.parametrize(
    "degrees", [0, 90, 179.9]
)  # the quaternions of half turns have either sign
def test_an_average_rotation_is_that_of_the_aligned_quaternions(degrees):
    rng = np.random.default_rng(0)
    base = Rotation.from_rotvec([0, np.deg2rad(degrees), 0])
    turned = Rotation.from_rotvec(rng.normal(0, 0.3, (20, 3))) * base
    R = torch.from_numpy(turned.as_matrix())
    weights = torch.from_numpy(rng.uniform(0.1, 1, 20))
    q = turned.as_quat()
    q = q * np.sign(q @ base.as_quat())[:, None]
    expected = Rotation.from_quat(weights.numpy() @ q).as_matrix()
    found = average_rotation(R[None], weights[None])[0]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    both = average_rotation(R.expand(2, -1, -1, -1), torch.stack((weights, weights.flip(0))))
    torch.testing.assert_close(both[0], found)
    assert (both[1] - found).abs().max() > 1e-3


def random_poses(frames=6, joints=17, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(0, 300, (frames, joints, 3))), rng


def test_procrustes_undoes_any_similarity_and_no_reflection():
    target, rng = random_poses()
    mask = torch.from_numpy(rng.random((6, 17)) < 0.7)
    R, scale = random_rotations((6,)), torch.from_numpy(rng.uniform(0.1, 10, (6, 1, 1)))
    points = scale * target @ R.mT + torch.from_numpy(rng.normal(0, 1e4, (6, 1, 3)))
    torch.testing.assert_close(procrustes(points, target, mask), target, rtol=0, atol=1e-8)
    mirrored = points * torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    assert (procrustes(mirrored, target, mask) - target).abs().amax((-2, -1)).min() > 10


def test_three_joints_fix_a_similarity():
    target = random_poses(frames=3)[0]
    mask = torch.zeros(3, 17, dtype=torch.bool)
    mask[:, [1, 8, 13]] = True
    points = 0.5 * target @ random_rotations((3,)).mT + 100
    torch.testing.assert_close(procrustes(points, target, mask), target, rtol=0, atol=1e-8)


def test_procrustes_is_the_best_similarity():
    target, rng = random_poses()
    points = target + torch.from_numpy(rng.normal(0, 100, target.shape))
    mask = torch.ones(6, 17, dtype=torch.bool)
    aligned = procrustes(points, target, mask)
    for b in range(6):  # slowly: scipy's rotation, then the closed form of the scale
        p, q = ((x[b] - x[b].mean(0)).numpy() for x in (points, target))
        turned = Rotation.align_vectors(q, p)[0].apply(p)
        expected = turned * (turned * q).sum() / (p * p).sum() + target[b].mean(0).numpy()
        np.testing.assert_allclose(aligned[b], expected, atol=1e-6)


def test_procrustes_fits_the_masked_joints_only_and_moves_them_all():
    target, rng = random_poses()
    points = target + torch.from_numpy(rng.normal(0, 100, target.shape))
    mask = torch.from_numpy(rng.random((6, 17)) < 0.7)
    part = [
        procrustes(p[m][None], t[m][None], m[m][None])[0]
        for p, t, m in zip(points, target, mask, strict=True)
    ]
    whole = procrustes(points, target, mask)
    for b in range(6):
        torch.testing.assert_close(whole[b, mask[b]], part[b])
    wild = torch.where(mask[..., None], points, torch.nan)
    torch.testing.assert_close(procrustes(wild, target, mask)[mask], whole[mask])


def test_procrustes_of_few_or_equal_joints_only_moves_them():
    target, rng = random_poses(frames=4)
    points = torch.from_numpy(rng.normal(0, 300, target.shape))
    points[3] = 5.0
    mask = torch.zeros(4, 17, dtype=torch.bool)
    mask[1, :1] = mask[2, :2] = mask[3] = True
    aligned = procrustes(points, target, mask)
    assert torch.equal(aligned[0], points[0])
    for b in (1, 2, 3):
        shift = (target[b] - points[b])[mask[b]].mean(0)
        torch.testing.assert_close(aligned[b], points[b] + shift)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e300])
def test_one_bad_pose_does_not_spoil_the_others(value):
    target, rng = random_poses()
    points = target + torch.from_numpy(rng.normal(0, 100, target.shape))
    mask = torch.ones(6, 17, dtype=torch.bool)
    before = procrustes(points, target, mask)
    points[2, 4, 1] = value
    after = procrustes(points, target, mask)
    others = [0, 1, 3, 4, 5]
    assert torch.equal(before[others], after[others])
    assert torch.isfinite(after).all()
