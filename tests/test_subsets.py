from math import comb

import pytest
import torch

from ghpt.geometry.subsets import _subset_of_two_or_more, random_subsets
from ghpt.randomness import key


def valid(*rows):
    """One frame, one joint: [1, V, 1]."""
    return torch.tensor(rows, dtype=torch.bool)[None, :, None]


@pytest.mark.parametrize("visible", [(1, 1, 1, 1), (1, 0, 1, 1, 0), (1, 1), (1, 1, 1, 1, 1, 1)])
def test_every_subset_of_two_or_more_seen_views_is_equally_likely(visible):
    count, n = 100_000, sum(visible)
    subsets = random_subsets(valid(*visible), count, key(0, "test", torch.tensor([3])))[0, :, 0]
    assert not subsets[:, ~torch.tensor(visible, dtype=torch.bool)].any()
    codes, times = (subsets * (1 << torch.arange(len(visible)))).sum(-1).unique(return_counts=True)
    kinds = 2**n - n - 1
    assert len(codes) == kinds
    expected = count / kinds
    chi_square = ((times - expected) ** 2 / expected).sum()
    assert chi_square < kinds - 1 + 5 * (2 * kinds) ** 0.5


@pytest.mark.parametrize("views", [31, 100])
def test_the_sizes_of_many_views_subsets_are_binomial(views):
    count = 40_000
    subsets = random_subsets(valid(*[1] * views), count, key(1, "test", torch.tensor([0])))[0, :, 0]
    sizes = torch.bincount(subsets.sum(-1), minlength=views + 1) / count
    expected = torch.tensor([comb(views, k) / 2**views for k in range(views + 1)])
    assert (sizes - expected).abs().max() < 5 * (0.15 / count) ** 0.5
    assert (subsets.float().mean(0) - 0.5).abs().max() < 5 * 0.5 / count**0.5
    correlation = torch.corrcoef(subsets.T.float()).fill_diagonal_(0)
    assert correlation.abs().max() < 6 / count**0.5


@pytest.mark.parametrize("n", [2, 3, 10])
def test_unranking_meets_every_subset_once(n):
    ranks = torch.arange(2**n - n - 1)[None, :, None, None]
    numbers = _subset_of_two_or_more(ranks, torch.full((1, 1, 1, 1), n)).flatten()
    assert numbers.tolist() == [x for x in range(2**n) if x.bit_count() >= 2]


def test_unranking_does_not_overflow_at_the_word_s_end():
    last = 2**62 - 62 - 2
    ranks = torch.tensor([0, 1, last])[None, :, None, None]
    numbers = _subset_of_two_or_more(ranks, torch.full((1, 1, 1, 1), 62)).flatten()
    assert numbers.tolist() == [3, 5, 2**62 - 1]


def test_too_few_seen_views_give_the_empty_subset():
    views = torch.tensor(
        [[[0, 1, 1], [0, 0, 1], [0, 0, 1]]], dtype=torch.bool
    )  # 0, 1 and 3 of 3 views
    subsets = random_subsets(views, 500, key(2, "test", torch.tensor([0])))
    assert not subsets[:, :, :2].any()
    assert (subsets[:, :, 2].sum(-1) >= 2).all()


@pytest.mark.parametrize("count", [0, 1, 2, 5, 62, 63])
def test_few_seen_of_many_views_are_drawn_from_as_of_few(count):
    visible = torch.zeros(1, 130, 1, dtype=torch.bool)
    visible[0, torch.randperm(130, generator=torch.Generator().manual_seed(count))[:count]] = True
    subsets = random_subsets(visible, 300, key(4, "test", torch.tensor([0])))[0, :, 0]
    assert not subsets[:, ~visible[0, :, 0]].any()
    sizes = subsets.sum(-1)
    assert (sizes >= 2).all() if count >= 2 else (sizes == 0).all()
    assert subsets.any(0).sum() == (count if count >= 2 else 0)


@pytest.mark.parametrize("views", [4, 31, 100])
def test_a_frame_s_draw_depends_on_its_key_and_its_own_views_alone(views):
    visible = torch.rand((5, views, 17), generator=torch.Generator().manual_seed(0)) < 0.7
    keys = key(3, "test", torch.arange(5))
    together = random_subsets(visible, 50, keys)
    for b in range(5):
        assert torch.equal(random_subsets(visible[b : b + 1], 50, keys[b : b + 1])[0], together[b])
    turned = random_subsets(visible.flip(0), 50, keys.flip(0)).flip(0)
    assert torch.equal(turned, together)
    assert not torch.equal(together[0], random_subsets(visible, 50, keys + 1)[0])
    assert not (together & ~visible.mT[:, None]).any()
    enough = (visible.sum(1) >= 2)[:, None].expand(-1, 50, -1)
    assert torch.equal(together.sum(-1) >= 2, enough)


def test_nothing_in_gives_nothing_out():
    assert random_subsets(
        torch.ones(0, 4, 17, dtype=torch.bool), 9, key(0, "x", torch.arange(0))
    ).shape == (
        0,
        9,
        17,
        4,
    )
    assert random_subsets(
        torch.ones(2, 4, 17, dtype=torch.bool), 0, key(0, "x", torch.arange(2))
    ).shape == (
        2,
        0,
        17,
        4,
    )
    assert not random_subsets(
        torch.ones(2, 0, 17, dtype=torch.bool), 3, key(0, "x", torch.arange(2))
    ).any()
