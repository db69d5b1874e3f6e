"""The loop of the framework as a LightningModule: generate, describe, score, weigh, combine,
compare.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torchmetrics import MeanMetric

from ghpt import randomness
from ghpt.errors import GhptError, check
from ghpt.models.aggregation import (
    AGGREGATIONS,
    aggregation_weights,
    cap_logit_std,
    softmax_weights,
)
from ghpt.models.loss import LossTerms, mean_over_all
from ghpt.models.problem import Problem
from ghpt.models.scorer import Scorer

STATISTICS_HYPOTHESES = 16
"""Hypotheses of each training sample that the feature statistics are taken from: enough for a mean
and deviation.
"""

MOST_HYPOTHESES = 100_000
"""In a pool: of more, the poses of one batch alone are gigabytes."""


@dataclass(frozen=True)
class Pool:
    """A batch's hypotheses with their logits and errors."""

    hypotheses: Any
    logits: Float[Tensor, "B H"]
    errors: Float[Tensor, "B H"]
    counted: Tensor
    """Which items have a truth to compare with, Bool [B]."""


class StochasticEstimator(L.LightningModule):
    """Hypothesis generator, scorer and loss (paper, section 3), for any ``Problem``.

    ``scorer(feature_size)`` gives a module like ``Scorer``, and ``loss`` is one like
    ``StochasticLoss``. ``logit_std_cap`` limits how much a pool's logits differ
    (``cap_logit_std``). ``selection``: the hypothesis of the estimation loss, ``weight`` or
    ``stochastic`` (straight through). All randomness is a function of (seed, optimiser step,
    sample): see ``ghpt.randomness``.
    """

    def __init__(
        self,
        problem: Problem,
        scorer: Callable[[int], Scorer],
        loss: nn.Module,
        optimizer: Callable[..., torch.optim.Optimizer],
        hypotheses: int,
        temperature: float,
        gumbel: bool,
        logit_std_cap: float | None,
        selection: str,
        seed: int,
    ) -> None:
        super().__init__()
        check(
            1 <= hypotheses <= MOST_HYPOTHESES,
            "model.hypotheses",
            f"is {hypotheses}",
            f"Draw at least 1 and at most {MOST_HYPOTHESES} (the paper: 200).",
        )
        check(
            temperature > 0,
            "model.temperature",
            f"is {temperature}",
            "It must be > 0 (the paper: 1.5).",
        )
        check(
            logit_std_cap is None or logit_std_cap > 0,
            "model.logit_std_cap",
            f"is {logit_std_cap}",
            "It must be > 0, or null for no limit.",
        )
        check(
            selection in ("weight", "stochastic"),
            "model.selection",
            f"is {selection!r}",
            "Existing: weight, stochastic.",
        )
        self.problem = problem
        self.loss = loss
        self.optimizer = optimizer
        with torch.random.fork_rng(
            devices=[]
        ):  # the initial weights too are a function of the seed alone
            torch.manual_seed(seed)
            self.scorer = scorer(problem.feature_size)
        self.hypotheses = hypotheses
        self.temperature = temperature
        self.gumbel = gumbel
        self.logit_std_cap = logit_std_cap
        self.selection = selection
        self.seed = seed
        self.validation = torch.nn.ModuleDict(
            {name: _mean() for name in ("weight", "average", "random")}
        )

    def pool(self, batch: Any, keys: Int[Tensor, " B"]) -> Pool:
        """Draw, score and measure the hypotheses of a batch."""
        hypotheses = self.problem.generate(batch, self.hypotheses, keys)
        logits = cap_logit_std(self.scorer(self.problem.featurize(hypotheses)), self.logit_std_cap)
        with torch.no_grad():
            errors, counted = self.problem.error(self.problem.as_estimates(hypotheses), batch)
        return Pool(hypotheses, logits, errors.to(logits.dtype), counted)

    def keys(self, purpose: str, batch: Any, *indices: int) -> Int[Tensor, " B"]:
        return randomness.key(
            self.seed, purpose, *indices, batch.sample, device=batch.sample.device
        )

    @torch.no_grad()
    def fit_statistics(self, batches: Iterator[Any]) -> None:
        """Take the scorer's feature statistics from hypotheses of the training samples."""
        features = [
            self.problem.featurize(
                self.problem.generate(batch, STATISTICS_HYPOTHESES, self.keys("statistics", batch))
            ).flatten(0, 1)
            for batch in batches
        ]
        self.scorer.standardise.fit(torch.cat(features))

    def on_fit_start(self) -> None:
        if not self.scorer.standardise.fitted:
            self.fit_statistics(
                batch.to(self.device) for batch in self.trainer.datamodule.all_training_batches()
            )

    def terms(self, pool: Pool, batch: Any, keys: Int[Tensor, " B"]) -> LossTerms:
        """The loss of each item."""
        noise = (
            randomness.gumbel(keys, (pool.logits.shape[-1],)).to(pool.logits.dtype)
            if self.gumbel
            else None
        )
        weights = softmax_weights(pool.logits, self.temperature, noise)
        chosen = weights
        if self.selection == "stochastic":
            drawn = aggregation_weights(
                "stochastic", pool.logits.detach(), pool.errors, self.temperature, keys
            )
            chosen = drawn + weights - weights.detach()
        estimate_error, _ = self.problem.error(
            self.problem.aggregate(pool.hypotheses, chosen), batch
        )
        return self.loss(weights, pool.errors, estimate_error.to(weights.dtype))

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        step = self.global_step
        pool = self.pool(batch, self.keys("hypotheses", batch, step))
        terms = self.terms(pool, batch, self.keys("gumbel", batch, step))
        total = pool.counted.sum()
        if self.trainer.world_size > 1:
            total = self.all_gather(total).sum()
        world = self.trainer.world_size
        means = LossTerms(*(mean_over_all(term, pool.counted, total, world) for term in terms))
        if not torch.isfinite(means.total):
            raise GhptError(
                f"training step {step}: the loss is {means.total.item()}. The samples of the batch are"
                f" {batch.sample.tolist()}. Lower optimizer.lr, or look at these frames."
            )
        for name, value in means._asdict().items():
            self.log(f"train/{name}", value.detach(), batch_size=len(batch), sync_dist=world > 1)
        return means.total

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        keys = self.keys("validation", batch)
        pool = self.pool(batch, keys)
        for name, metric in self.validation.items():
            weights = aggregation_weights(name, pool.logits, pool.errors, self.temperature, keys)
            error, _ = self.problem.error(self.problem.aggregate(pool.hypotheses, weights), batch)
            metric.update(error.double(), pool.counted.double())

    def on_validation_epoch_end(self) -> None:
        for name, metric in self.validation.items():
            self.log(
                f"validation/{name}",
                metric.compute().float(),
                prog_bar=name == "weight",
                sync_dist=False,
            )
            metric.reset()

    def test_step(self, batch: Any, batch_idx: int) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Every selection's estimate, and a summary of the weights: what the report is made of."""
        keys = self.keys("test", batch)
        pool = self.pool(batch, keys)
        weights = {
            name: aggregation_weights(name, pool.logits, pool.errors, self.temperature, keys)
            for name in AGGREGATIONS
        }
        estimates = {
            name: self.problem.aggregate(pool.hypotheses, w) for name, w in weights.items()
        }
        w = weights["weight"]
        summary = {
            "entropy": torch.special.entr(w).sum(dim=-1),
            "max": w.amax(dim=-1),
            "effective": 1 / w.square().sum(dim=-1),
        }
        return estimates, summary

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return self.optimizer(self.scorer.parameters())


def _mean() -> MeanMetric:
    """A weighted mean in float64 that is right with uneven processes; NaN when nothing was counted."""
    return MeanMetric(nan_strategy="disable").set_dtype(torch.float64)
