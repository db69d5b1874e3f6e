"""One loop, many problems: what the LightningModule asks of a problem, and nothing more.

observations -> generate -> hypotheses -> featurize -> features -> scorer -> logits -> weights
                                |                                                         |
                    error (against truth)  <-----------  aggregate  <---------------------+
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.observations import Batch

HypothesesT = TypeVar("HypothesesT", bound="Hypotheses")


@dataclass(frozen=True)
class Hypotheses(Batch):
    """H hypotheses for each of B items. Every field has leading dimensions B H, save ``shared``."""

    shared: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that all hypotheses of an item share; leading dimension B."""

    def first(self: HypothesesT, count: int) -> HypothesesT:
        """Return the first ``count`` hypotheses of each item."""
        own = [field.name for field in fields(self) if field.name not in self.shared]
        return replace(self, **{name: getattr(self, name)[:, :count] for name in own})


@runtime_checkable
class Problem(Protocol):
    """Hypotheses and estimates are the problem's own types; only the problem looks inside."""

    measures: str
    """What ``error`` is, for people; mm."""
    feature_size: int
    """D, the length of the feature vector that the scorer sees."""

    def generate(self, observations: Any, count: int, keys: Int[Tensor, " B"]) -> Any:
        """Return ``count`` random hypotheses for each item: a pure function of item and key."""

    def featurize(self, hypotheses: Any) -> Float[Tensor, "B H D"]:
        """Return what the scorer sees of each hypothesis: float32, finite, never the cameras."""

    def aggregate(self, hypotheses: Any, weights: Float[Tensor, "B H"]) -> Any:
        """Return the estimate under weights that sum to 1; differentiable in the weights.

        One-hot weights select a hypothesis.
        """

    def as_estimates(self, hypotheses: Any) -> Any:
        """Return all hypotheses as estimates with leading dimensions B H."""

    def error(self, estimate: Any, truth: Any) -> tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]:
        """Return each estimate's error, and which items have a truth to compare with.

        An item that has none gets 0.
        """
