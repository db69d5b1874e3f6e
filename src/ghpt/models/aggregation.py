"""Aggregation of hypotheses (paper, sections 3 and 4): each one is weights over the pool."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghpt import randomness
from ghpt.errors import GhptConfigError
from ghpt.observations import Batch

AGGREGATIONS = ("weight", "average", "most", "least", "stochastic", "random", "best", "worst")
"""Names as in metrics.json; best and worst look at the truth and are not available in use."""


def cap_logit_std(
    logits: Float[Tensor, "B H"], logit_std_cap: float | None
) -> Float[Tensor, "B H"]:
    """Centre each pool's logits and limit their standard deviation (None: return them as they are).

    Not in the paper, whose scores lie between 0 and 1 and so cannot differ much either. Without a
    limit the weights collapse onto one or two hypotheses, and a scorer is surest of itself on poses
    unlike those that it was trained on.
    """
    if logit_std_cap is None:
        return logits
    centred = logits - logits.mean(dim=-1, keepdim=True)
    variance = centred.square().mean(dim=-1, keepdim=True)
    std = variance.clamp_min(logit_std_cap**2).sqrt()
    return centred * (logit_std_cap / std)


def softmax_weights(
    logits: Float[Tensor, "B H"], temperature: float, noise: Float[Tensor, "B H"] | None = None
) -> Float[Tensor, "B H"]:
    """Return the (Gumbel-)softmax of eq:gumbel-softmax.

    ``noise`` is from Gumbel(0, 1) in training, None at test.
    """
    noisy = logits if noise is None else logits + noise
    return torch.softmax(noisy / temperature, dim=-1)


def aggregation_weights(
    name: str,
    logits: Float[Tensor, "B H"],
    errors: Float[Tensor, "B H"] | None,
    temperature: float,
    keys: Int[Tensor, " B"],
) -> Float[Tensor, "B H"]:
    """Return weights that sum to 1 over the pool: the named aggregation is the estimate under them.

    ``errors`` are needed by best and worst alone, ``keys`` by stochastic and random. Raises
    GhptConfigError for a name that does not exist.
    """
    count = logits.shape[-1]
    if name == "weight":
        return softmax_weights(logits, temperature)
    if name == "average":
        return torch.full_like(logits, 1 / count)
    own_keys = randomness.key(0, name, keys)
    if name == "stochastic":  # the largest of logits plus Gumbel noise is a draw from their softmax
        noise = randomness.gumbel(own_keys, (count,))
        index = (logits / temperature + noise).argmax(dim=-1)
    elif name == "random":
        uniform = randomness.uniform(own_keys, (1,))
        index = (uniform * count).long()[:, 0]
    elif name == "most":
        index = logits.argmax(dim=-1)
    elif name == "least":
        index = logits.argmin(dim=-1)
    elif name in ("best", "worst"):
        if errors is None:
            raise ValueError(f"{name} needs the errors")
        index = (-errors).argmax(dim=-1) if name == "best" else (-errors).argmin(dim=-1)
    else:
        raise GhptConfigError(
            "selection", f"{name!r} is unknown", f"Existing: {', '.join(AGGREGATIONS)}."
        )
    return F.one_hot(index, count).to(logits.dtype)


@dataclass(frozen=True)
class WeightSummary(Batch):
    """How concentrated the weights over each pool are."""

    entropy: Float[Tensor, " B"]
    """Nats."""
    max: Float[Tensor, " B"]
    """The largest weight."""
    effective: Float[Tensor, " B"]
    """1 / sum of squares: the hypotheses in effect."""


def summarize(weights: Float[Tensor, "B H"]) -> WeightSummary:
    """Return how concentrated weights are that sum to 1."""
    return WeightSummary(
        entropy=torch.special.entr(weights).sum(dim=-1),
        max=weights.amax(dim=-1),
        effective=1 / weights.square().sum(dim=-1),
    )
