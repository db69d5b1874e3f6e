"""The human pose prior S^2 (paper, section 4.4): how constant the body's left/right symmetry is in
time.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchmetrics import Metric

from ghpt.observations import PoseEstimate
from ghpt.skeleton import SYMMETRIC_PARTS

PARTS = tuple(SYMMETRIC_PARTS)
"""The six parts, in the order of the P axis."""


def length_ratios(estimate: PoseEstimate) -> tuple[Float[Tensor, "*B P"], Bool[Tensor, "*B P"]]:
    """Length of the left part / length of the right, float64, for each of ``PARTS``, and which are
    defined.

    A ratio is defined where all joints of both sides are estimated and the right part has a length;
    elsewhere it is 1.
    """
    ends = torch.tensor(list(SYMMETRIC_PARTS.values()), device=estimate.points.device)
    points = estimate.points.double()[..., ends, :]
    left, right = torch.linalg.vector_norm(points[..., 0, :] - points[..., 1, :], dim=-1).unbind(-1)
    defined = estimate.estimated[..., ends].flatten(-2).all(-1) & (right > 0)
    return torch.where(defined, left / torch.where(defined, right, 1.0), 1.0), defined


class PosePrior(Metric):
    """S^2, the unbiased variance over frames of the left/right length ratio, for each subject and
    part.

    The sums are of (ratio - 1) and its square, float64: near 0 for a body, so nothing cancels, and
    they add up over batches and processes.
    """

    full_state_update = False
    count: Tensor
    excess: Tensor
    excess_squared: Tensor

    def __init__(self, subjects: int) -> None:
        super().__init__()
        self.subjects = subjects
        zeros = torch.zeros(subjects, len(PARTS), dtype=torch.float64)
        self.add_state("count", zeros, dist_reduce_fx="sum")
        self.add_state("excess", zeros.clone(), dist_reduce_fx="sum")
        self.add_state("excess_squared", zeros.clone(), dist_reduce_fx="sum")

    def update(self, estimate: PoseEstimate, subject: Int[Tensor, " B"]) -> None:
        """Add B frames; ``subject`` is each frame's subject, 0 ... subjects-1."""
        ratios, defined = length_ratios(estimate)
        member = torch.nn.functional.one_hot(subject.long(), self.subjects).double().mT
        self.count += member @ defined.double()
        self.excess += member @ (ratios - 1)
        self.excess_squared += member @ (ratios - 1).square()

    def compute(self) -> Float[Tensor, "S P"]:
        """S^2 for each subject and part; NaN with fewer than two frames."""
        variance = (self.excess_squared - self.excess.square() / self.count) / (self.count - 1)
        return torch.where(self.count >= 2, variance.clamp_min(0), torch.nan)
