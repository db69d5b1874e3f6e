"""Random subsets of the views that see a joint (paper, section 3.1)."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghpt.randomness import bits

_WORD = 62
"""Views that one random word decides on: ranks of subsets stay within int64."""


def random_subsets(
    valid: Bool[Tensor, "B V J"],
    count: int,
    keys: Int[Tensor, " B"],
) -> Bool[Tensor, "B H J V"]:
    """Return for each hypothesis and joint a subset of the valid views, of two or more.

    It is uniform over all such subsets. ``count`` is H. A frame's subsets depend on its key and its
    own ``valid`` alone. A joint with fewer than two valid views gets the empty subset.
    """
    valid = valid.transpose(1, 2)[:, None]
    views = valid.sum(-1, keepdim=True)
    position = (valid.cumsum(-1) - 1).clamp(min=0)
    _, _, joints, all_views = valid.shape
    words = -(-max(all_views, 1) // _WORD)
    word = bits(keys, (count, joints, words)) & torch.iinfo(torch.int64).max
    word[..., :1] = _subset_of_two_or_more(word[..., :1], views)
    if words == 1:
        return valid & _bit(word, position)
    position = position.expand(-1, count, -1, -1)
    own_word = word.gather(-1, position // _WORD)
    chosen = valid & _bit(own_word, position % _WORD)
    # for more views than a word holds the fair bits themselves are drawn: once in 1e17 draws
    # fewer than two
    too_few = (views > _WORD) & (chosen.sum(-1, keepdim=True) < 2)
    return chosen | (valid & too_few)


def _bit(word: Int[Tensor, "..."], position: Int[Tensor, "..."]) -> Bool[Tensor, "..."]:
    return ((word >> position) & 1) != 0


def _subset_of_two_or_more(
    word: Int[Tensor, "B H J 1"],
    views: Int[Tensor, "B 1 J 1"],
) -> Int[Tensor, "B H J 1"]:
    """Turn 63 random bits into a number with two bits or more set out of ``views``.

    Each is equally likely. Such numbers below 2^n are counted by 2^n - n - 1, and the one of rank r
    whose highest bit is p is r + p + 2. The remainder that gives r is uniform but for less than
    2e-9 of the probability (none to speak of below 30 views).
    """
    n = torch.arange(_WORD + 1, device=word.device)
    below = (1 << n) - n - 1
    total = below[views.clamp(max=_WORD)]
    rank = word % total.clamp(min=1)
    highest = torch.searchsorted(below[1:].contiguous(), rank, right=True)
    subset = torch.where(total > 0, rank + highest + 2, 0)
    return torch.where(views > _WORD, word, subset)
