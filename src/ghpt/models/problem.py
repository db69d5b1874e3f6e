"""One loop, many problems: what the loop, training and testing ask of a problem, and nothing more.

    observations -> generate -> hypotheses -> featurize -> features -> scorer -> logits -> weights
                                    |                                                         |
                        error (against truth)  <-----------  aggregate  <---------------------+

A problem is a class derived from ``Problem``, in a package of ghpt's or of the user's own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.config import Target
from ghpt.data.datasets.frames import SampleSet, Sampling, draw_frames
from ghpt.models.aggregation import AGGREGATIONS
from ghpt.models.mean_error import mean_errors
from ghpt.models.measured import Measured
from ghpt.models.predictions import Predictions, Schema, Tables, TrueJoints
from ghpt.observations import Batch, Estimate, Labelled, LabelledRecording
from ghpt.report.report import Report

HypothesesT = TypeVar("HypothesesT", bound="Hypotheses")

Keys = Int[Tensor, " B"]
"""Keys of the samples' random draws."""
Features = Float[Tensor, "B H D"]
"""What the scorer sees of each hypothesis."""
Weights = Float[Tensor, "B H"]
"""Weights of the hypotheses, which sum to 1."""
Errors = tuple[Float[Tensor, " B *H"], Bool[Tensor, " B"]]
"""Each estimate's error, and which samples can be compared with a truth."""


@dataclass(frozen=True)
class Hypotheses(Batch):
    """H hypotheses for each of B samples. Every field begins with B H, save the ``shared`` ones."""

    shared: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that all hypotheses of a sample share; they begin with B."""

    def first(self: HypothesesT, count: int) -> HypothesesT:
        """Return the first ``count`` hypotheses of each sample."""
        own = [field.name for field in fields(self) if field.name not in self.shared]
        return replace(self, **{name: getattr(self, name)[:, :count] for name in own})


@dataclass(frozen=True)
class BaselineSettings:
    """The groups of test.yaml that say what is tested beside a model."""

    baselines: Target
    """Classical estimators of poses."""
    camera_baselines: Target
    """Classical estimators of relative camera poses."""
    trajectory: Target | None = None
    """How whole recordings are estimated; None: not at all."""


class Problem(ABC):
    """What is estimated, from what, and how it is compared with the truth.

    The types of observations, hypotheses, estimates and truth are the problem's own: only the
    problem looks inside. The first five methods are the loop, and every problem has its own. The
    others say where its samples come from and what a test run stores and shows; what is here
    serves problems whose samples are frames of a recording.
    """

    measures: ClassVar[str]
    """What ``error`` is, for people; mm."""
    schema: ClassVar[Schema[Any, Any, Any]]
    """What a test run stores."""
    aggregations: ClassVar[tuple[str, ...]] = AGGREGATIONS
    """Those that mean something here; ``weight`` and ``average`` always do."""
    feature_size: int
    """D, the length of the feature vector that the scorer sees."""

    @abstractmethod
    def generate(self, observations: Any, count: int, keys: Keys) -> Any:
        """Return ``count`` random hypotheses for each sample: a function of sample and key."""

    @abstractmethod
    def featurize(self, hypotheses: Any) -> Features:
        """Return what the scorer sees of each hypothesis: float32, finite, never the cameras."""

    @abstractmethod
    def aggregate(self, hypotheses: Any, weights: Weights) -> Any:
        """Return the estimate under weights that sum to 1; differentiable in the weights.

        One-hot weights select a hypothesis.
        """

    @abstractmethod
    def as_estimates(self, hypotheses: Any) -> Any:
        """Return all hypotheses as estimates with leading dimensions B H."""

    @abstractmethod
    def error(self, estimate: Any, truth: Any) -> Errors:
        """Return each estimate's error, and which samples can be compared with a truth.

        A sample that cannot gets 0.
        """

    def training_error(self, estimate: Any, truth: Any) -> Float[Tensor, " B"]:
        """Return what the estimation loss lessens: the error, unless a problem says otherwise."""
        return self.error(estimate, truth)[0]

    def dataset(self, recordings: Sequence[LabelledRecording], sampling: Sampling) -> SampleSet:
        """Return the samples that are drawn from the recordings of a split."""
        return draw_frames(recordings, sampling)

    def baselines(
        self, settings: BaselineSettings, model: Any
    ) -> Mapping[str, Callable[[Any], Any]]:
        """Return the estimators that are tested beside the aggregations, by name."""
        return {}

    def from_baseline(self, estimate: Any, observations: Any) -> Estimate:
        """Return a baseline's estimate as one of this problem."""
        return estimate

    def record(self, batch: Labelled[Any, Any], dataset: Any) -> Batch:
        """Return what ``schema`` stores of each sample of a batch."""
        return TrueJoints.from_truth(batch.truth)

    def tables(self, dataset: Any) -> Tables:
        """Return what ``schema`` stores of a data set once."""
        return Tables()

    def meta(self) -> dict[str, Any]:
        """Return what the stored predictions say of the problem's settings, as plain data."""
        return {}

    def metrics(self, predictions: Predictions[Any, Any, Any]) -> Measured[Any]:
        """Return what a test run measured of each selection and baseline."""
        return mean_errors(predictions, self.error)

    def report(self) -> Report:
        """Return what shows the metrics; imported here, since drawing is slow to import."""
        from ghpt.report.mean_error import REPORT

        return REPORT
