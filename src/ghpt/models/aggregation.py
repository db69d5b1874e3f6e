"""Hypothesis selection (paper, sections 3 and 4): every selection is a vector of weights over the
pool.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghpt import randomness
from ghpt.errors import GhptConfigError

AGGREGATIONS = ("weight", "average", "most", "least", "stochastic", "random", "best", "worst")
"""Names as in metrics.json; best and worst look at the truth and are not available in use."""


def cap_logit_std(
    logits: Float[Tensor, "B H"], logit_std_cap: float | None
) -> Float[Tensor, "B H"]:
    """Centre each pool's logits and shrink them where their standard deviation exceeds
    ``logit_std_cap`` (None: as they are).

    Not in the paper, whose scores lie between 0 and 1 and so cannot differ much either. Without a
    limit the weights collapse onto one or two hypotheses, and a scorer is surest of itself on poses
    unlike those that it was trained on.
    """
    if logit_std_cap is None:
        return logits
    centred = logits - logits.mean(dim=-1, keepdim=True)
    return centred * (
        logit_std_cap
        / centred.square().mean(dim=-1, keepdim=True).clamp_min(logit_std_cap**2).sqrt()
    )


def softmax_weights(
    logits: Float[Tensor, "B H"], temperature: float, noise: Float[Tensor, "B H"] | None = None
) -> Float[Tensor, "B H"]:
    """The (Gumbel-)softmax of eq:gumbel-softmax; with ``noise`` from Gumbel(0, 1) in training,
    without it at test.
    """
    return torch.softmax((logits if noise is None else logits + noise) / temperature, dim=-1)


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
    if name == "stochastic":  # the largest of logits plus Gumbel noise is a draw from their softmax
        noise = randomness.gumbel(randomness.key(0, "stochastic", keys), (count,))
        index = (logits / temperature + noise).argmax(dim=-1)
    elif name == "random":
        index = (randomness.uniform(randomness.key(0, "random", keys), (1,)) * count).long()[:, 0]
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
