import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.models.loss import PrecisionLoss, StochasticLoss, mean_over_all


def weights_and_errors(items=6, count=9):
    generator = torch.Generator().manual_seed(0)
    weights = torch.softmax(torch.randn(items, count, generator=generator, dtype=torch.float64), -1)
    return weights, 10 + 90 * torch.rand(items, count, generator=generator, dtype=torch.float64)


def test_terms_against_a_loop():
    weights, errors = weights_and_errors()
    estimate = errors.mean(-1)
    terms = StochasticLoss(alpha=1.0, beta=0.5, gamma=0.25, relative_errors=True)(
        weights, errors, estimate
    )
    for i in range(len(weights)):
        expected = sum(w * e / max(errors[i]) for w, e in zip(weights[i], errors[i], strict=True))
        entropy = -sum(w * torch.log(w) for w in weights[i])
        assert terms.stochastic[i] == pytest.approx(expected.item())
        assert terms.entropy[i] == pytest.approx(entropy.item())
        assert terms.total[i] == pytest.approx(
            (expected + 0.5 * entropy + 0.25 * estimate[i]).item()
        )


def test_absolute_errors_keep_their_unit_and_relative_ones_do_not():
    weights, errors = weights_and_errors()
    for relative, factor in ((False, 1000.0), (True, 1.0)):
        loss = StochasticLoss(alpha=1.0, beta=0.0, gamma=0.0, relative_errors=relative)
        torch.testing.assert_close(
            loss(weights, 1000 * errors, errors[:, 0]).total,
            factor * loss(weights, errors, errors[:, 0]).total,
        )


def test_entropy_is_between_zero_and_log_h_and_safe_where_a_weight_underflows():
    count = 200
    uniform = torch.full((1, count), 1 / count)
    one_hot = torch.zeros(1, count)
    one_hot[0, 3] = 1
    one_hot.requires_grad_()
    loss = StochasticLoss(alpha=0.0, beta=1.0, gamma=0.0, relative_errors=True)
    zeros = torch.zeros(1)
    entropy = {
        name: loss(w, torch.ones(1, count), zeros).entropy
        for name, w in (("u", uniform), ("o", one_hot))
    }
    assert entropy["u"].item() == pytest.approx(
        torch.log(torch.tensor(float(count))).item(), rel=1e-5
    )
    assert entropy["o"].item() < 1e-30
    logits = torch.tensor([[0.0, -1e4, 50.0]], requires_grad=True)
    loss(torch.softmax(logits, -1), torch.ones(1, 3), zeros).total.sum().backward()
    assert torch.isfinite(logits.grad).all()


def test_gradients_are_right():
    _, errors = weights_and_errors(3, 5)
    logits = torch.randn(
        3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2), requires_grad=True
    )
    loss = StochasticLoss(alpha=1.0, beta=0.01, gamma=0.02, relative_errors=True)

    def total(values):
        weights = torch.softmax(values, -1)
        return loss(weights, errors, (weights * errors).sum(-1)).total

    assert torch.autograd.gradcheck(total, logits)


def test_all_errors_zero_is_finite():
    weights, errors = weights_and_errors(2, 3)
    loss = StochasticLoss(alpha=1.0, beta=0.0, gamma=0.0, relative_errors=True)
    assert torch.equal(
        loss(weights, 0 * errors, 0 * errors[:, 0]).total, torch.zeros(2, dtype=torch.float64)
    )


def test_uneven_shares_average_to_the_whole():
    """What each process returns, averaged as DDP averages gradients, is the mean over all counted
    items.
    """
    values = torch.arange(10.0, dtype=torch.float64)
    counted = torch.tensor([1, 1, 0, 1, 1, 1, 0, 0, 1, 1], dtype=torch.bool)
    whole = values[counted].mean()
    for cut in (0, 1, 5, 10):
        shares = [(values[:cut], counted[:cut]), (values[cut:], counted[cut:])]
        parts = [mean_over_all(v, c, counted.sum(), 2) for v, c in shares]
        assert (sum(parts) / 2).item() == pytest.approx(whole.item(), rel=1e-12)


def test_what_is_not_counted_is_not_there_whatever_it_is():
    values = torch.tensor([1.0, torch.nan, 3.0, torch.inf], dtype=torch.float64, requires_grad=True)
    counted = torch.tensor([True, False, True, False])
    mean = mean_over_all(values, counted, counted.sum(), 1)
    assert mean == 2
    mean.backward()
    assert values.grad.tolist() == [0.5, 0, 0.5, 0]


@pytest.mark.parametrize(("counted", "expected"), [([False, False], 0.0), ([True, False], 7.0)])
def test_the_mean_of_none_is_0_and_of_one_is_it(counted, expected):
    counted = torch.tensor(counted)
    assert mean_over_all(torch.tensor([7.0, 9.0]), counted, counted.sum(), 1) == expected


@pytest.mark.parametrize("name", ["alpha", "beta", "gamma"])
def test_negative_weights_are_refused(name):
    settings = {"alpha": 1.0, "beta": 1.0, "gamma": 1.0} | {name: -0.1}
    with pytest.raises(GhptConfigError, match=rf"^model\.loss\.{name}: "):
        StochasticLoss(**settings, relative_errors=True)


def test_precisions_of_the_errors_are_the_best_weights():
    errors = torch.tensor([[1.0, 2.0, 4.0, 0.0]])
    loss = PrecisionLoss(alpha=1.0, gamma=0.0)

    def value(weights):
        weights = torch.tensor([weights]) / sum(weights)
        return loss(weights, errors, torch.zeros(1)).total.item()

    best = value([1.0, 1 / 4, 1 / 16, 0.0])
    assert best < value([1.0, 1.0, 1.0, 0.0])
    assert best < value([1.0, 1 / 8, 1 / 64, 0.0])
    assert best < value([1.0, 1 / 3, 1 / 12, 0.0])
