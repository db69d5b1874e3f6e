import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.models.scorer import ROWS, Scorer, Standardise


def test_standardised_training_features_have_mean_0_and_deviation_1():
    features = 50 + 7 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(0))
    features[:, 2] = 5.0
    standardise = Standardise(3, clip=100.0)
    assert not standardise.fitted
    standardise.fit(features)
    result = standardise(features)
    torch.testing.assert_close(result.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(
        result.std(0, correction=0), torch.tensor([1.0, 1.0, 0.0]), atol=1e-4, rtol=0
    )
    assert torch.isfinite(standardise(torch.full((1, 3), 1e30))).all()
    assert standardise(torch.full((1, 3), 1e30)).max() == 100


def test_statistics_travel_in_the_state():
    a, b = (Scorer(3, [4], clip=5.0, bfloat16=False) for _ in range(2))
    a.standardise.fit(torch.randn(10, 3, generator=torch.Generator().manual_seed(0)))
    b.load_state_dict(a.state_dict())
    x = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(1))
    assert b.standardise.fitted
    assert torch.equal(a(x), b(x))
    assert a(x).shape == (2, 6)


def test_each_hypothesis_is_scored_alone():
    scorer = Scorer(3, [8, 8], clip=5.0, bfloat16=False).double()
    x = torch.randn(2, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    torch.testing.assert_close(scorer(x[:, order]), scorer(x)[:, order])


@pytest.mark.parametrize(
    ("settings", "key"),
    [({"layers": []}, "layers"), ({"layers": [0]}, "layers"), ({"clip": 0.0}, "clip")],
)
def test_out_of_range(settings, key):
    with pytest.raises(GhptConfigError, match=rf"model\.scorer\.{key}"):
        Scorer(**({"size": 3, "layers": [4], "clip": 5.0, "bfloat16": False} | settings))


def test_bfloat16_rounds_in_training_alone():
    exact = Scorer(3, [64, 64], clip=5.0, bfloat16=False)
    fast = Scorer(3, [64, 64], clip=5.0, bfloat16=True)
    fast.load_state_dict(exact.state_dict())
    x = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    assert fast(x).dtype == torch.float32
    assert not torch.equal(fast(x), exact(x))
    torch.testing.assert_close(fast(x), exact(x), atol=0.02, rtol=0.02)
    fast(x).sum().backward()
    assert fast.network[0].weight.grad.dtype == torch.float32
    assert torch.equal(fast.eval()(x), exact(x))


@pytest.mark.parametrize("shape", [(3,), (7, 3), (0, 5, 3), (3, 2 * ROWS + 1, 3)])
def test_in_parts_without_gradients_the_scores_are_the_same(shape):
    scorer = Scorer(3, [64, 64], clip=5.0, bfloat16=False)
    x = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        scores = scorer(x)
    assert scores.shape == shape[:-1]
    torch.testing.assert_close(scores, scorer(x), rtol=0, atol=1e-6)
