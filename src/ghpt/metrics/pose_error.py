"""MPJPE (paper, eq. mpjpe) in three frames, with the coverage that says what it was averaged over."""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchmetrics import Metric

from ghpt.geometry.rotations import procrustes
from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import PELVIS, SIX_JOINTS

Kind = Literal["absolute", "relative", "aligned"]
"""In the world; with both pelvises at the origin; after the best similarity onto the truth."""


def joint_errors(
    estimate: PoseEstimate, truth: Truth, kind: Kind
) -> tuple[Float[Tensor, "*B J"], Bool[Tensor, "*B J"]]:
    """Distance of each estimated joint to its true place, mm, float64, and which of them count.

    A joint counts if it is estimated and has a truth. ``relative``: only where the pelvis counts
    too, and the pelvis itself counts with an error of 0, as is the field's habit. ``aligned``: only
    where at least three joints count, the fewest that fix a similarity. An error that does not
    count is 0.
    """
    points = estimate.points.double()
    true_points = truth.points.double()
    counted = estimate.estimated & truth.valid
    if kind == "relative":
        points = points - points[..., PELVIS, None, :]
        true_points = true_points - true_points[..., PELVIS, None, :]
        counted = counted & counted[..., PELVIS, None]
    elif kind == "aligned":
        counted = counted & (counted.sum(-1, keepdim=True) >= 3)
        points = procrustes(points, true_points, counted)
    errors = torch.linalg.vector_norm(points - true_points, dim=-1)
    return torch.where(counted, errors, 0.0), counted


class PoseErrors(NamedTuple):
    """What ``MPJPE`` computes: means over all counted joint-frames, mm; NaN where none counts."""

    mean: Float[Tensor, ""]
    six_joints: Float[Tensor, ""]
    """On elbows, wrists and knees only."""
    per_joint: Float[Tensor, " J"]
    per_group: Float[Tensor, " G"] | Float[Tensor, ""]
    """torchmetrics takes the dimension away when there is one group."""
    coverage: Float[Tensor, ""]
    """Counted joint-frames / joint-frames with a truth, in [0, 1]."""


class MPJPE(Metric):
    """Mean per-joint position error over all counted joint-frames, overall and in each of
    ``groups`` groups.

    Each joint-frame weighs the same, so a frame with half of its joints missing weighs half: an
    estimator cannot change the mean by how its misses are spread over frames, only its
    ``coverage``. States are float64 sums and exact counts for each group and joint, summed over
    processes.
    """

    full_state_update = False
    error_sum: Tensor
    counted: Tensor
    with_truth: Tensor

    def __init__(self, kind: Kind, groups: int, joints: int) -> None:
        super().__init__()
        self.kind = kind
        self.groups = groups
        self.add_state(
            "error_sum", torch.zeros(groups, joints, dtype=torch.float64), dist_reduce_fx="sum"
        )
        self.add_state(
            "counted", torch.zeros(groups, joints, dtype=torch.float64), dist_reduce_fx="sum"
        )
        self.add_state(
            "with_truth", torch.zeros(groups, joints, dtype=torch.float64), dist_reduce_fx="sum"
        )

    def update(
        self,
        estimate: PoseEstimate,
        truth: Truth,
        group: Int[Tensor, " B"],
    ) -> None:
        """Add B frames; ``group`` is each frame's group (its action, say), 0 ... groups-1."""
        errors, counted = joint_errors(estimate, truth, self.kind)
        # A product, not index_add_, whose order of summation varies on a GPU.
        member = torch.nn.functional.one_hot(group.long(), self.groups).double().mT
        self.error_sum += member @ errors
        self.counted += member @ counted.double()
        self.with_truth += member @ truth.valid.double()

    def compute(self) -> PoseErrors:
        six = list(SIX_JOINTS)
        return PoseErrors(
            mean=self.error_sum.sum() / self.counted.sum(),
            six_joints=self.error_sum[:, six].sum() / self.counted[:, six].sum(),
            per_joint=self.error_sum.sum(0) / self.counted.sum(0),
            per_group=self.error_sum.sum(1) / self.counted.sum(1),
            coverage=self.counted.sum() / self.with_truth.sum(),
        )
