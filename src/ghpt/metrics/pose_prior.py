"""The human pose prior S^2 (paper, section 4.4): how constant the body's symmetry is in time."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import one_hot
from torchmetrics import Metric

from ghpt.observations import PoseEstimate
from ghpt.skeleton import SYMMETRIC_BONES

PARTS = tuple(SYMMETRIC_BONES)
"""The six pairs of bones, in the order of the P axis."""


def length_ratios(estimate: PoseEstimate) -> tuple[Float[Tensor, "*B P"], Bool[Tensor, "*B P"]]:
    """Return left length / right length of each of ``PARTS``, float64, and which are defined.

    A ratio is defined where all joints of both sides are estimated and the right bone has a length;
    elsewhere it is 1.
    """
    joints = torch.tensor(list(SYMMETRIC_BONES.values()), device=estimate.points.device)
    ends = estimate.points.double()[..., joints, :]
    bones = ends[..., 0, :] - ends[..., 1, :]
    left, right = torch.linalg.vector_norm(bones, dim=-1).unbind(-1)
    estimated = estimate.estimated[..., joints].flatten(-2).all(-1)
    defined = estimated & (right > 0)
    safe_right = torch.where(defined, right, 1.0)
    return torch.where(defined, left / safe_right, 1.0), defined


class PosePrior(Metric):
    """S^2, the unbiased variance over frames of the left/right length ratio.

    It is computed for each subject and pair of bones. The sums are of (ratio - 1) and its square,
    float64: near 0 for a body, so nothing cancels, and they add up over batches and processes.
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
        excess = ratios - 1
        member = one_hot(subject.long(), self.subjects).double().mT
        self.count += member @ defined.double()
        self.excess += member @ excess
        self.excess_squared += member @ excess.square()

    def compute(self) -> Float[Tensor, "S P"]:
        """Return S^2 for each subject and part; NaN with fewer than two frames."""
        mean_square = self.excess.square() / self.count
        variance = (self.excess_squared - mean_square) / (self.count - 1)
        return torch.where(self.count >= 2, variance.clamp_min(0), torch.nan)
