"""The network that scores each key point beside the others of its joint and of its view.

It serves the hypotheses of joints as well: a row is a view, or what one subset of views gives.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghpt.errors import check
from ghpt.models.body import KINDS, kind
from ghpt.models.scorer import Standardise
from ghpt.skeleton import JOINTS

_NOT_VALID = -1e4
"""Logit of a key point that is none: its weight is 0."""
_LARGEST_WIDTH = 1000


class KeyPointScorer(nn.Module):
    """One logit for each key point, whatever the number and the order of the views.

    Each key point is seen alone, then beside the mean and the largest of what was made of the
    other views' and the mean of its own view's. ``width``: of all layers. ``clip``: features beyond
    it say no more. ``limit``: the largest size of a logit, None for none; without one the weights
    of averages collapse onto one hypothesis before anything is learned.
    """

    kinds: Tensor

    def __init__(self, size: int, width: int, clip: float, limit: float | None = None) -> None:
        super().__init__()
        hint = f"It must be 1 to {_LARGEST_WIDTH}."
        check(1 <= width <= _LARGEST_WIDTH, "model.scorer.width", f"is {width}", hint)
        hint = "It must be > 0, or null for no limit."
        check(limit is None or limit > 0, "model.scorer.limit", f"is {limit}", hint)
        self.limit = limit
        self.standardise = Standardise(size, clip)
        self.standardise.fitted.fill_(True)  # the features are of order one as they are
        self.register_buffer("kinds", torch.tensor([KINDS.index(kind(j)) for j in JOINTS]), False)
        self.kind = nn.Embedding(len(KINDS), width)
        self.alone = nn.Linear(size, width)
        self.alone_too = nn.Linear(width, width)
        self.beside = nn.Linear(width, width)
        self.of_joint = nn.Linear(2 * width, width, bias=False)
        self.of_view = nn.Linear(width, width, bias=False)
        self.together = nn.Linear(width, width)
        self.logit = nn.Linear(width, 1)
        nn.init.zeros_(self.logit.weight)

    def forward(self, features: Float[Tensor, "B H D"]) -> Float[Tensor, "B H"]:
        """Return a logit for each key point: of H = V x J, joints of a view together."""
        tokens = features.unflatten(1, (-1, len(JOINTS)))
        valid = tokens[..., :1] > 0.5
        hidden = self.alone(self.standardise(tokens)) + self.kind(self.kinds)
        hidden = torch.relu(self.alone_too(torch.relu(hidden)))
        hidden = torch.where(valid, hidden, 0.0)
        joint = torch.cat((_mean(hidden, valid, 1), hidden.amax(1, keepdim=True)), dim=-1)
        context = self.of_joint(joint) + self.of_view(_mean(hidden, valid, 2))
        hidden = torch.relu(self.beside(hidden) + context)
        hidden = torch.relu(self.together(hidden))
        logits = self.logit(hidden)
        if self.limit is not None:
            logits = self.limit * torch.tanh(logits / self.limit)
        return torch.where(valid, logits, _NOT_VALID).flatten(1)


def _mean(
    values: Float[Tensor, "B V J C"], valid: Bool[Tensor, "B V J 1"], dim: int
) -> Float[Tensor, "B V J C"]:
    return values.sum(dim, keepdim=True) / valid.sum(dim, keepdim=True).clamp(min=1)
