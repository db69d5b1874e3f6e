import numpy as np
import pytest
import torch

from ghpt import randomness
from ghpt.errors import GhptConfigError
from ghpt.models.aggregation import (
    AGGREGATIONS,
    aggregation_weights,
    cap_logit_std,
    softmax_weights,
)


def pool(items=50, count=40):
    logits = 3 * torch.randn(items, count, generator=torch.Generator().manual_seed(0))
    errors = torch.rand(items, count, generator=torch.Generator().manual_seed(1)) + 0.1
    return logits, errors, randomness.key(0, "pool", torch.arange(items))


@pytest.mark.parametrize("name", AGGREGATIONS)
def test_weights_sum_to_one_and_do_not_depend_on_batch_mates(name):
    logits, errors, keys = pool()
    weights = aggregation_weights(name, logits, errors, 1.5, keys)
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(logits)))
    for i in (0, 7):
        one = slice(i, i + 1)
        assert torch.equal(
            aggregation_weights(name, logits[one], errors[one], 1.5, keys[one]), weights[one]
        )


@pytest.mark.parametrize("name", AGGREGATIONS)
def test_selected_error_lies_between_best_and_worst(name):
    logits, errors, keys = pool()
    expected = {
        n: (aggregation_weights(n, logits, errors, 1.5, keys) * errors).sum(-1)
        for n in (name, "best", "worst")
    }
    torch.testing.assert_close(expected["best"], errors.amin(-1))
    torch.testing.assert_close(expected["worst"], errors.amax(-1))
    assert (expected["best"] <= expected[name] + 1e-6).all()
    assert (expected[name] <= expected["worst"] + 1e-6).all()


def test_most_and_least_are_the_extreme_logits():
    logits, errors, keys = pool()
    most, least = (aggregation_weights(n, logits, errors, 1.0, keys) for n in ("most", "least"))
    assert torch.equal(most.argmax(-1), logits.argmax(-1))
    assert torch.equal(least.argmax(-1), logits.argmin(-1))


def test_temperature_limits():
    logits, errors, keys = pool()
    cold, hot = softmax_weights(logits, 1e-4), softmax_weights(logits, 1e6)
    torch.testing.assert_close(
        cold, aggregation_weights("most", logits, errors, 1.0, keys), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(
        hot, aggregation_weights("average", logits, errors, 1.0, keys), atol=1e-5, rtol=0
    )


def test_stochastic_follows_the_weights_and_random_is_uniform():
    count, draws = 4, 40_000
    logits = torch.tensor([0.0, 1.0, 2.0, -1.0]).expand(draws, count)
    keys = randomness.key(0, "draws", torch.arange(draws))
    for name, expected in (
        ("stochastic", torch.softmax(logits[0] / 1.5, -1)),
        ("random", torch.full((count,), 0.25)),
    ):
        share = aggregation_weights(name, logits, -logits, 1.5, keys).mean(0)
        assert (share - expected).abs().max() < 4 * np.sqrt(0.25 / draws)


def test_gumbel_noise_draws_from_the_softmax():
    logits = torch.tensor([0.0, 1.0, 2.0]).expand(30_000, 3)
    noise = randomness.gumbel(randomness.key(0, "g", torch.arange(30_000)), (3,)).float()
    share = (
        torch.nn.functional.one_hot(softmax_weights(logits, 1e-3, noise).argmax(-1), 3)
        .float()
        .mean(0)
    )
    assert (share - torch.softmax(logits[0], -1)).abs().max() < 0.015


def test_unknown_selection_says_what_exists():
    logits, errors, keys = pool(2, 3)
    with pytest.raises(GhptConfigError, match="weight, average"):
        aggregation_weights("mean", logits, errors, 1.0, keys)


def test_a_limited_spread_keeps_the_order_and_small_differences():
    logits, _, _ = pool()
    wide, narrow = cap_logit_std(100 * logits, 1.0), cap_logit_std(0.01 * logits, 1.0)
    torch.testing.assert_close(wide.std(-1, correction=0), torch.ones(len(logits)))
    assert torch.equal(wide.argsort(-1), logits.argsort(-1))
    torch.testing.assert_close(
        narrow.diff(dim=-1), 0.01 * logits.diff(dim=-1), atol=1e-6, rtol=1e-4
    )
    assert torch.equal(cap_logit_std(logits, None), logits)
    one = torch.zeros(3, 1, requires_grad=True)
    cap_logit_std(one, 1.0).sum().backward()
    assert torch.isfinite(one.grad).all()
