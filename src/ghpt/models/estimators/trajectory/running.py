"""What a person's trajectory has told of the person so far."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from ghpt.models.estimators.confidence import confidence_exponent, confidence_weights
from ghpt.models.estimators.trajectory.estimator import LEAST_EXPONENT, Trajectory
from ghpt.models.estimators.trajectory.solver import joint_noise

Array = np.ndarray

_LARGEST_NOISE = 60.0
"""mm. A joint that has lost its key points must not explain itself by their noise."""


@dataclass(frozen=True)
class Sample:
    """What one frame tells; lengths are those of an adult (`Trajectory.size`)."""

    residual: Float[Array, "V J"]
    """Lengths of the residuals at the body's depth, mm."""
    used: Bool[Array, "V J"]
    confidence: Float[Array, "V J"]
    lengths: Float[Array, " B"]
    """Of the bones, mm."""
    free_lengths: Float[Array, " B"]
    """The same by the frame's own key points, without time and bones, mm."""
    placed: Bool[Array, " B"]
    """Whether the frame alone places both ends of a bone."""
    extent: float
    """Of the person, mm; NaN where too little is seen."""


@dataclass(frozen=True)
class RunningBody:
    """What frames tell of their person and of the detector."""

    scale: Float[Array, " J"]
    """Deviation of a key point's coordinate, mm at the body's depth."""
    length: Float[Array, " B"]
    """Of the bones, mm; 0 where unknown."""
    precision: Float[Array, " B"]
    """Of their lengths, mm^-2; 0 where unknown."""
    exponent: float
    """Of the confidences."""
    extent: float
    """Of the person, mm; NaN where unknown."""


def measure(samples: Sequence[Sample], trajectory: Trajectory) -> RunningBody:
    """Return what some frames tell, as all frames of a recording tell it."""
    solver = trajectory.solver
    residual = torch.from_numpy(np.stack([sample.residual for sample in samples]))
    used = torch.from_numpy(np.stack([sample.used for sample in samples]))
    confidence = torch.from_numpy(np.stack([sample.confidence for sample in samples]))
    lengths = torch.from_numpy(np.stack([sample.lengths for sample in samples], axis=-1))
    placed = torch.from_numpy(np.stack([sample.placed for sample in samples], axis=-1))
    free = torch.from_numpy(np.stack([sample.free_lengths for sample in samples], axis=-1))
    _, precision = solver.bones.measure(lengths, placed)
    length, _ = solver.bones.measure(free, placed)
    exponent = confidence_exponent(residual, confidence, used, LEAST_EXPONENT)
    exponent = min(exponent, trajectory.largest_exponent)
    weight = confidence_weights(confidence, exponent)
    order = (1, 2, 0)
    scale = joint_noise(
        residual.permute(order), used.permute(order), weight.permute(order), solver.noise
    )
    extents = torch.tensor([sample.extent for sample in samples])
    return RunningBody(
        scale=scale.clamp(max=_LARGEST_NOISE).numpy(),
        length=length.numpy(),
        precision=precision.numpy(),
        exponent=exponent,
        extent=float(extents.nanmedian()),
    )


class Memory:
    """Of the last frames every ``step``-th, ``size`` of them, and at first every one."""

    def __init__(self, size: int, step: int, first: int) -> None:
        self.samples: deque[Sample] = deque(maxlen=size)
        self.step = step
        self.first = first
        self.seen = 0
        """Frames so far."""

    @property
    def takes_next(self) -> bool:
        """Whether the next frame is one of them."""
        return self.seen < self.first or self.seen % self.step == 0
