"""The numbers of the paper: for each a stateless function, and a torchmetrics ``Metric`` that sums
it up.
"""

from ghpt.metrics.pose_error import MPJPE, PoseErrors, joint_errors
from ghpt.metrics.pose_prior import PosePrior, length_ratios
from ghpt.metrics.relative_pose import MeanError

__all__ = ["MPJPE", "MeanError", "PoseErrors", "PosePrior", "joint_errors", "length_ratios"]
