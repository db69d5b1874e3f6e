"""The three losses of section 3: expected error, entropy, and the error of the estimate."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghpt.errors import check


class LossTerms(NamedTuple):
    """Per item, before averaging."""

    total: Float[Tensor, " B"]
    stochastic: Float[Tensor, " B"]
    entropy: Float[Tensor, " B"]
    estimation: Float[Tensor, " B"]


class StochasticLoss(nn.Module):
    """``alpha l_stoch + beta l_entropy + gamma l_est`` for each item.

    ``relative_errors``: divide each pool's errors by the largest before taking the expectation, as
    the authors' code does though the paper does not say so; pools of easy and of hard frames then
    weigh the same.
    """

    def __init__(self, alpha: float, beta: float, gamma: float, relative_errors: bool) -> None:
        super().__init__()
        for name, value in {"alpha": alpha, "beta": beta, "gamma": gamma}.items():
            check(value >= 0, f"model.loss.{name}", f"is {value}", "It must be >= 0.")
        self.alpha = alpha
        self.beta = beta
        self.gamma = gamma
        self.relative_errors = relative_errors

    def forward(
        self,
        weights: Float[Tensor, "B H"],
        errors: Float[Tensor, "B H"],
        estimate_error: Float[Tensor, " B"],
    ) -> LossTerms:
        """Return the loss of each item.

        ``weights`` sum to 1; ``errors`` (mm) are those of the hypotheses, ``estimate_error`` that
        of the estimate.
        """
        if self.relative_errors:
            largest = errors.amax(dim=-1, keepdim=True)
            errors = errors / largest.clamp_min(torch.finfo(errors.dtype).tiny)
        stochastic = (weights * errors).sum(dim=-1)
        # entr(0) is 0 but its gradient is infinite, and softmax turns that into NaN where a weight
        # underflows.
        positive = weights.clamp_min(torch.finfo(weights.dtype).tiny)
        entropy = torch.special.entr(positive).sum(dim=-1)
        total = self.alpha * stochastic + self.beta * entropy + self.gamma * estimate_error
        return LossTerms(total, stochastic, entropy, estimate_error)


class PrecisionLoss(nn.Module):
    """``alpha (l_error + l_spread) + gamma l_est`` for each item: of weights that are precisions.

    ``l_error``, the logarithm of the mean weighted squared error, and ``l_spread``, minus the mean
    logarithm of the weights, are together the negative logarithm of the likelihood of Gaussian
    errors whose precisions the weights are, but for a factor that is all's, under the best such
    factor. Hypotheses without a weight do not count.
    """

    def __init__(self, alpha: float, gamma: float) -> None:
        super().__init__()
        for name, value in {"alpha": alpha, "gamma": gamma}.items():
            check(value >= 0, f"model.loss.{name}", f"is {value}", "It must be >= 0.")
        self.alpha = alpha
        self.gamma = gamma

    def forward(
        self,
        weights: Float[Tensor, "B H"],
        errors: Float[Tensor, "B H"],
        estimate_error: Float[Tensor, " B"],
    ) -> LossTerms:
        """Return the loss of each item; the arguments are those of ``StochasticLoss``."""
        tiny = torch.finfo(weights.dtype).tiny
        counts = weights > 0
        number = counts.sum(dim=-1).clamp_min(1)
        square = (weights * errors.square()).sum(dim=-1) / number
        likelihood = square.clamp_min(tiny).log()
        logarithm = torch.where(counts, weights.clamp_min(tiny).log(), 0.0)
        spread = -logarithm.sum(dim=-1) / number
        total = self.alpha * (likelihood + spread) + self.gamma * estimate_error
        return LossTerms(total, likelihood, spread, estimate_error)


def mean_over_all(
    values: Float[Tensor, " B"], has_truth: Bool[Tensor, " B"], total: Tensor, world: int
) -> Tensor:
    """Return this process's part of the mean over the items with a truth of all processes.

    It is so scaled that averaging gradients over ``world`` processes gives the mean's gradient;
    ``total`` is the number of items over all processes.
    """
    return torch.where(has_truth, values, 0.0).sum() * world / total.clamp_min(1)
