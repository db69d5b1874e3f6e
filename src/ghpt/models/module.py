"""The loop as a LightningModule: generate, featurize, score, aggregate, compare."""

from collections.abc import Callable, Iterable
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import MeanMetric

from ghpt import randomness
from ghpt.errors import GhptError, check
from ghpt.models.aggregation import aggregation_weights, softmax_weights
from ghpt.models.loss import LossTerms, mean_over_all
from ghpt.models.pool import Pool
from ghpt.models.problem import Keys, Problem
from ghpt.models.scorer import Scorer
from ghpt.observations import Batch, Labelled, Samples

STATISTICS_HYPOTHESES = 16
"""Hypotheses of each training sample that the feature statistics are taken from: enough for a mean
and deviation.
"""

MOST_HYPOTHESES = 100_000
"""In a pool: of more, the poses of one batch alone are gigabytes."""


_VALIDATED = ("weight", "average", "random")
"""The aggregations whose errors a training shows."""


_OF_LIGHTNING = ("map_location", "hparams_file", "strict", "weights_only")
"""Arguments of Lightning's ``load_from_checkpoint``."""


class StochasticEstimator(L.LightningModule):
    """Hypothesis generator, scorer and loss (paper, section 3), for any ``Problem``.

    ``scorer(feature_size)`` gives a module like ``Scorer``, and ``loss`` is one like
    ``StochasticLoss``. ``logit_std_cap`` limits how much a pool's logits differ
    (``cap_logit_std``). ``selection``: the aggregation of the estimation loss, ``weight`` or
    ``stochastic`` (straight through). ``schedule``: of the learning rate, step by step. All
    randomness is a function of seed, optimiser step and sample: see ``ghpt.randomness``.
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
        schedule: Callable[[torch.optim.Optimizer], LRScheduler] | None = None,
    ) -> None:
        possible = 1 <= hypotheses <= MOST_HYPOTHESES
        hint = f"Draw at least 1 and at most {MOST_HYPOTHESES} (the paper: 200)."
        check(possible, "model.hypotheses", f"is {hypotheses}", hint)
        hint = "It must be > 0 (the paper: 1.5)."
        check(temperature > 0, "model.temperature", f"is {temperature}", hint)
        capped = logit_std_cap is None or logit_std_cap > 0
        hint = "It must be > 0, or null for no limit."
        check(capped, "model.logit_std_cap", f"is {logit_std_cap}", hint)
        exists = selection in ("weight", "stochastic")
        hint = "Existing: weight, stochastic."
        check(exists, "model.selection", f"is {selection!r}", hint)
        super().__init__()
        self.problem = problem
        self.loss = loss
        self.optimizer = optimizer
        self.schedule = schedule
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)  # the initial weights too are a function of the seed alone
            self.scorer = scorer(problem.feature_size)
        self.hypotheses = hypotheses
        self.temperature = temperature
        self.gumbel = gumbel
        self.logit_std_cap = logit_std_cap
        self.selection = selection
        self.seed = seed
        shown = [name for name in _VALIDATED if name in problem.aggregations]
        self.validation = torch.nn.ModuleDict({name: _mean() for name in shown})

    def sample(
        self,
        observations: Samples,
        purpose: str,
        truth: Batch | None = None,
        step: int | None = None,
    ) -> Pool:
        """Draw and score the hypotheses of a batch.

        ``purpose`` (and ``step``, in training) name the random draws: the same names give the same
        hypotheses of a sample in any batch. ``truth`` is needed for the pool's errors alone.
        """
        keys = self.keys(purpose, observations, step)
        hypotheses = self.problem.generate(observations, self.hypotheses, keys)
        logits = self.scorer(self.problem.featurize(hypotheses))
        return Pool(
            self.problem, hypotheses, logits, self.temperature, self.logit_std_cap, keys, truth
        )

    def keys(self, purpose: str, observations: Samples, step: int | None = None) -> Keys:
        """Return the key of each sample's random draws."""
        index = observations.index
        steps = () if step is None else (step,)
        return randomness.key(self.seed, purpose, *steps, index, device=index.device)

    @torch.no_grad()
    def fit_statistics(self, batches: Iterable[Samples]) -> None:
        """Take the scorer's feature statistics from hypotheses of the training samples."""
        features = []
        for observations in batches:
            keys = self.keys("statistics", observations)
            hypotheses = self.problem.generate(observations, STATISTICS_HYPOTHESES, keys)
            features.append(self.problem.featurize(hypotheses).flatten(0, 1))
        self.scorer.standardise.fit(torch.cat(features))

    def on_fit_start(self) -> None:
        """Take the feature statistics, unless they came with a checkpoint."""
        if not self.scorer.standardise.fitted:
            data = self.trainer.datamodule  # type: ignore[attr-defined]  # not declared
            batches = data.all_training_batches()
            self.fit_statistics(batch.observations.to(self.device) for batch in batches)

    def terms(self, pool: Pool, keys: Keys) -> LossTerms:
        """Return the loss of each item; ``keys`` are those of the Gumbel noise."""
        logits = pool.capped_logits
        noise = None
        if self.gumbel:
            noise = randomness.gumbel(keys, (logits.shape[-1],)).to(logits.dtype)
        weights = softmax_weights(logits, self.temperature, noise)
        chosen = weights
        if self.selection == "stochastic":
            drawn = aggregation_weights(
                "stochastic", logits.detach(), pool.errors, self.temperature, keys
            )
            chosen = drawn + weights - weights.detach()
        estimate = self.problem.aggregate(pool.hypotheses, chosen)
        estimate_error = self.problem.training_error(estimate, pool.known_truth)
        return self.loss(weights, pool.errors, estimate_error.to(weights.dtype))

    def training_step(self, batch: Labelled[Any, Any], batch_idx: int) -> Tensor:
        """Return the mean loss. Raises GhptError where it is not finite."""
        step = self.global_step
        observations = batch.observations
        pool = self.sample(observations, "hypotheses", batch.truth, step)
        terms = self.terms(pool, self.keys("gumbel", observations, step))
        total = pool.has_truth.sum()
        world = self.trainer.world_size
        if world > 1:
            total = torch.as_tensor(self.all_gather(total)).sum()
        means = LossTerms(*(mean_over_all(term, pool.has_truth, total, world) for term in terms))
        if not torch.isfinite(means.total):
            raise GhptError(
                f"training step {step}: the loss is {means.total.item()}. The samples of the batch "
                f"are {observations.index.tolist()}. Lower optimizer.lr, or look at these frames."
            )
        for name, value in means._asdict().items():
            self.log(f"train/{name}", value.detach(), batch_size=len(batch), sync_dist=world > 1)
        return means.total

    def validation_step(self, batch: Labelled[Any, Any], batch_idx: int) -> None:
        """Add a batch to the mean error of each of a few aggregations."""
        pool = self.sample(batch.observations, "validation", batch.truth)
        for name, metric in self._validation_means().items():
            error, _ = self.problem.error(pool.estimate(name), batch.truth)
            metric.update(error.double(), pool.has_truth.double())

    def on_validation_epoch_end(self) -> None:
        """Log the mean errors of the epoch."""
        for name, metric in self._validation_means().items():
            mean = metric.compute().float()
            self.log(f"validation/{name}", mean, prog_bar=name == "weight", sync_dist=False)
            metric.reset()

    def _validation_means(self) -> dict[str, MeanMetric]:
        means = self.validation.items()
        return {name: mean for name, mean in means if isinstance(mean, MeanMetric)}

    def test_step(  # type: ignore[override]  # what takes it is the callback of predictions
        self, batch: Labelled[Any, Any], batch_idx: int
    ) -> Pool:
        """Return the pool of a batch."""
        return self.sample(batch.observations, "test", batch.truth)

    def configure_optimizers(self) -> Any:
        """Return the optimiser of the scorer's weights, and its schedule over the steps if any."""
        optimizer = self.optimizer(self.scorer.parameters())
        if self.schedule is None:
            return optimizer
        scheduler = {"scheduler": self.schedule(optimizer), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": scheduler}

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: Any, *_: Any, **changes: Any) -> Any:
        """Return the model of a checkpoint of train.py, as `load_model` reads it: no code is run.

        ``changes`` replace settings, as in ``hypotheses=50``; those that Lightning adds of its own
        (``map_location``, ``strict``) change nothing: the model is on the CPU, and whole.
        """
        from ghpt.models.checkpoint import load_model

        own = {name: value for name, value in changes.items() if name not in _OF_LIGHTNING}
        return load_model(checkpoint_path, own.pop("trust", ()), **own)[0]


def _mean() -> MeanMetric:
    """Return a weighted mean in float64 that is right with uneven processes, NaN of nothing."""
    mean = MeanMetric(nan_strategy="disable")
    mean.set_dtype(torch.float64)
    return mean
