"""The three losses of section 3: expected error, entropy, and the error of the selected hypothesis."""

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
        for name, value in (("alpha", alpha), ("beta", beta), ("gamma", gamma)):
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
        """``weights`` sum to 1; ``errors`` of each hypothesis, ``estimate_error`` of the selected
        one (mm).
        """
        if self.relative_errors:
            errors = errors / errors.amax(dim=-1, keepdim=True).clamp_min(
                torch.finfo(errors.dtype).tiny
            )
        stochastic = (weights * errors).sum(dim=-1)
        # entr(0) is 0 but its gradient is infinite, and softmax turns that into NaN where a weight
        # underflows.
        entropy = torch.special.entr(weights.clamp_min(torch.finfo(weights.dtype).tiny)).sum(dim=-1)
        total = self.alpha * stochastic + self.beta * entropy + self.gamma * estimate_error
        return LossTerms(total, stochastic, entropy, estimate_error)


def mean_over_all(
    values: Float[Tensor, " B"], counted: Bool[Tensor, " B"], total: Tensor, world: int
) -> Tensor:
    """The mean over the counted items of all processes, so scaled that averaging gradients over
    ``world`` processes gives its gradient; ``total`` is the count over all processes.
    """
    return torch.where(counted, values, 0.0).sum() * world / total.clamp_min(1)
