"""MPJPE (paper, eq. mpjpe) in three frames, with the coverage of what it is averaged over."""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import one_hot
from torchmetrics import Metric

from ghpt.geometry.rotations import procrustes
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import PELVIS, SIX_JOINTS

Kind = Literal["absolute", "relative", "aligned"]
"""In the world; with both pelvises at the origin; after the best similarity onto the truth."""


def joint_errors(
    estimate: PoseEstimate,
    truth: Truth,
    kind: Kind,
) -> tuple[Float[Tensor, "*B J"], Bool[Tensor, "*B J"]]:
    """Return the distance of each estimated joint to its true position, and which are measured.

    Distances are in mm, float64. A joint is measured if it is estimated and has a truth.
    ``relative``: only where the pelvis is measured too, and the pelvis itself has an error of 0, as
    is the field's habit. ``aligned``: only where at least three joints are measured, the fewest
    that fix a similarity. An error that is not measured is 0.
    """
    points = estimate.points.double()
    true_points = truth.points.double()
    measured = estimate.estimated & truth.valid
    if kind == "relative":
        points = points - points[..., PELVIS, None, :]
        true_points = true_points - true_points[..., PELVIS, None, :]
        measured = measured & measured[..., PELVIS, None]
    elif kind == "aligned":
        enough = measured.sum(-1, keepdim=True) >= 3
        measured = measured & enough
        points = procrustes(points, true_points, measured)
    errors = torch.linalg.vector_norm(points - true_points, dim=-1)
    return torch.where(measured, errors, 0.0), measured


class PoseErrors(NamedTuple):
    """What ``MPJPE`` computes: means over all measured joint-frames, mm, NaN for none."""

    mean: Float[Tensor, ""]
    six_joints: Float[Tensor, ""]
    """On elbows, wrists and knees only."""
    per_joint: Float[Tensor, " J"]
    per_group: Float[Tensor, " G"] | Float[Tensor, ""]
    """torchmetrics takes the dimension away when there is one group."""
    coverage: Float[Tensor, ""]
    """Measured joint-frames / joint-frames with a truth, in [0, 1]."""


class MPJPE(Metric):
    """Mean per-joint position error over all measured joint-frames, overall and in groups.

    Each joint-frame weighs the same, so a frame with half of its joints missing weighs half: an
    estimator cannot change the mean by how its misses are spread over frames, only its
    ``coverage``. States are float64 sums and exact counts for each group and joint, summed over
    processes.
    """

    full_state_update = False
    error_sum: Tensor
    measured: Tensor
    with_truth: Tensor

    def __init__(self, kind: Kind, groups: int, joints: int) -> None:
        super().__init__()
        self.kind = kind
        self.groups = groups
        zeros = torch.zeros(groups, joints, dtype=torch.float64)
        self.add_state("error_sum", zeros, dist_reduce_fx="sum")
        self.add_state("measured", zeros.clone(), dist_reduce_fx="sum")
        self.add_state("with_truth", zeros.clone(), dist_reduce_fx="sum")

    def update(
        self,
        estimate: PoseEstimate,
        truth: Truth,
        group: Int[Tensor, " B"],
    ) -> None:
        """Add B frames; ``group`` is each frame's group (its action, say), 0 ... groups-1."""
        errors, measured = joint_errors(estimate, truth, self.kind)
        # A product, not index_add_, whose order of summation varies on a GPU.
        member = one_hot(group.long(), self.groups).double().mT
        self.error_sum += member @ errors
        self.measured += member @ measured.double()
        self.with_truth += member @ truth.valid.double()

    def compute(self) -> PoseErrors:
        six = list(SIX_JOINTS)
        error_sum = self.error_sum
        measured = self.measured
        return PoseErrors(
            mean=error_sum.sum() / measured.sum(),
            six_joints=error_sum[:, six].sum() / measured[:, six].sum(),
            per_joint=error_sum.sum(0) / measured.sum(0),
            per_group=error_sum.sum(1) / measured.sum(1),
            coverage=measured.sum() / self.with_truth.sum(),
        )
