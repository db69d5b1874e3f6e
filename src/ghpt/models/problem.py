"""One loop, many problems: what the LightningModule asks of a problem, and nothing more.

    batch -> generate -> hypotheses -> describe -> features -> scorer -> logits -> weights
                              |                                                       |
                  error (against truth)  <-----------  combine  <---------------------+

A third problem is one file with a class like this and one yaml::

    class LineFit:
        measures, feature_size = "distance from the true line", 10
        def generate(self, batch, count, keys): ...      # two random points each -> [B, H, 2]
        def describe(self, hypotheses): ...              # sorted residuals -> [B, H, D]
        def combine(self, hypotheses, weights): ...      # weights [B, H] -> [B, 2]
        def as_estimates(self, hypotheses): ...                # each hypothesis as an estimate, [B, H, 2]
        def error(self, estimate, batch): ...            # distance to the true line -> [B], counted [B]
"""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor


@runtime_checkable
class Problem(Protocol):
    """Hypotheses and estimates are the problem's own types; only the problem looks inside."""

    measures: str
    """What ``error`` is, for people; mm."""
    feature_size: int
    """D, the length of the feature vector that the scorer sees."""

    def generate(self, batch: Any, count: int, keys: Int[Tensor, " B"]) -> Any:
        """``count`` random hypotheses for each item; a pure function of the item and its key."""

    def featurize(self, hypotheses: Any) -> Float[Tensor, "B H D"]:
        """What the scorer sees of each hypothesis: float32, finite, never the cameras."""

    def aggregate(self, hypotheses: Any, weights: Float[Tensor, "B H"]) -> Any:
        """The estimate under weights that sum to 1; differentiable in the weights. One-hot weights
        select.
        """

    def as_estimates(self, hypotheses: Any) -> Any:
        """All hypotheses as estimates with leading dimensions B H."""

    def error(self, estimate: Any, batch: Any) -> tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]:
        """Each estimate's error against the truth, and which items have a truth to compare with.
        An item that has none gets 0."""
