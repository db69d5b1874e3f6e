import numpy as np
import pytest
import torch
from scipy import stats

from ghpt import randomness


def test_a_draw_depends_on_its_own_key_alone():
    keys = randomness.key(3, "x", torch.arange(5))
    together = randomness.uniform(keys, (7, 2))
    alone = torch.cat([randomness.uniform(k[None], (7, 2)) for k in keys])
    assert torch.equal(together, alone)


def test_keys_differ_by_seed_purpose_and_every_index():
    keys = [
        randomness.key(seed, purpose, a, b).item()
        for seed in (0, 1, -1, 2**63)
        for purpose in ("x", "y")
        for a in range(4)
        for b in range(4)
    ]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_uniform_is_uniform_and_open(dtype):
    u = randomness.uniform(randomness.key(0, "u", torch.arange(20)), (20_000,), dtype)
    assert u.dtype == dtype
    assert u.min() > 0
    assert u.max() < 1
    assert stats.kstest(u.flatten().double().numpy(), "uniform").pvalue > 1e-3
    correlation = np.corrcoef(u.double().numpy()) - np.eye(20)
    assert np.abs(correlation).max() < 5 / np.sqrt(20_000)


def test_consecutive_numbers_are_independent():
    u = randomness.uniform(randomness.key(1, "u"), (200_000,)).numpy()
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 4 / np.sqrt(len(u))
    bits = randomness.bits(randomness.key(2, "b"), (50_000,)).numpy().view(np.uint64)
    ones = np.array([((bits >> np.uint64(i)) & np.uint64(1)).mean() for i in range(64)])
    assert np.abs(ones - 0.5).max() < 5 * 0.5 / np.sqrt(len(bits))


def test_gumbel_has_the_right_mean_and_variance():
    g = randomness.gumbel(randomness.key(0, "g"), (400_000,))
    assert abs(g.mean() - np.euler_gamma) < 0.01
    assert abs(g.var() - np.pi**2 / 6) < 0.03


def test_permutation_is_one_and_changes_with_the_epoch():
    first, second = (randomness.permutation(0, "order", epoch, 100) for epoch in (0, 1))
    assert torch.equal(first.sort().values, torch.arange(100))
    assert not torch.equal(first, second)
    assert torch.equal(first, randomness.permutation(0, "order", 0, 100))


def test_known_values():
    """A change of the generator changes every published number: it must be on purpose."""
    assert randomness.bits(randomness.key(7, "golden", 1), (3,)).tolist() == GOLDEN


GOLDEN = [-4442047307695629999, 7457900186799829374, -8529891009526558085]
