"""A batch's scored hypotheses, and the estimates that can be made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.models.aggregation import (
    WeightSummary,
    aggregation_weights,
    cap_logit_std,
    summarize,
)
from ghpt.models.problem import Hypotheses, Problem
from ghpt.observations import Batch


@dataclass(frozen=True)
class Pool:
    """H hypotheses for each of B items with the scorer's logits.

    Nothing is computed before it is asked for. ``truth`` is None in use, where nobody knows it.
    """

    problem: Problem
    hypotheses: Hypotheses
    logits: Float[Tensor, "B H"]
    """As the scorer gives them; weights are made of ``capped_logits``."""
    temperature: float
    logit_std_cap: float | None
    keys: Int[Tensor, " B"]
    """Of the draws of the aggregations ``stochastic`` and ``random``."""
    truth: Batch | None = None

    @cached_property
    def capped_logits(self) -> Float[Tensor, "B H"]:
        """The logits, each item's centred and limited in their standard deviation."""
        return cap_logit_std(self.logits, self.logit_std_cap)

    @property
    def known_truth(self) -> Batch:
        """The truth. Raises ValueError where there is none."""
        if self.truth is None:
            raise ValueError("this pool has no truth to compare with")
        return self.truth

    @cached_property
    def _compared(self) -> tuple[Float[Tensor, "B H"], Bool[Tensor, " B"]]:
        with torch.no_grad():
            estimates = self.problem.as_estimates(self.hypotheses)
            errors, has_truth = self.problem.error(estimates, self.known_truth)
        return errors.to(self.logits.dtype), has_truth

    @property
    def errors(self) -> Float[Tensor, "B H"]:
        """Each hypothesis' error against the truth. Raises ValueError where there is none."""
        return self._compared[0]

    @property
    def has_truth(self) -> Bool[Tensor, " B"]:
        """Which items have a truth to compare with."""
        return self._compared[1]

    def weights(self, aggregation: str = "weight") -> Float[Tensor, "B H"]:
        """Return the weights, which sum to 1, of one of ``AGGREGATIONS``.

        Raises ValueError for ``best`` and ``worst`` where there is no truth, and GhptConfigError
        for a name that does not exist.
        """
        errors = self.errors if aggregation in ("best", "worst") else None
        logits = self.capped_logits
        return aggregation_weights(aggregation, logits, errors, self.temperature, self.keys)

    def estimate(self, aggregation: str = "weight") -> Any:
        """Return the estimate under one of ``AGGREGATIONS``; raises as ``weights`` does."""
        return self.problem.aggregate(self.hypotheses, self.weights(aggregation))

    def first(self, count: int) -> Pool:
        """Return the pool of the first hypotheses: what a model that draws ``count`` would have."""
        hypotheses = self.hypotheses.first(count)
        return replace(self, hypotheses=hypotheses, logits=self.logits[:, :count])

    def with_temperature(self, temperature: float) -> Pool:
        """Return the pool whose softmax has another temperature."""
        return replace(self, temperature=temperature)

    def weight_summary(self) -> WeightSummary:
        """Return how concentrated the weights of ``weight`` are."""
        return summarize(self.weights())
