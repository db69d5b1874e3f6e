"""What a test measured of an estimator of poses; apart from what measures it, which is slow to
import.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ghpt.models.measured import Number


@dataclass(frozen=True)
class PoseMeans:
    """Mean distances of the estimated joints from the true ones, mm."""

    absolute: Number
    """In the world."""
    relative: Number
    """To the pelvis."""
    aligned: Number
    """After Procrustes alignment."""
    six_joints: Number
    """Relative; elbows, wrists, knees."""

    def plain(self) -> dict[str, Number]:
        """Return the means by their names in metrics.json."""
        return {
            "mpjpe_absolute": self.absolute,
            "mpjpe_relative": self.relative,
            "mpjpe_aligned": self.aligned,
            "mpjpe_6_joints": self.six_joints,
        }


@dataclass(frozen=True)
class PoseNumbers:
    """What was measured of one selection or baseline."""

    means: PoseMeans
    coverage: Number
    """Estimated joint-frames / joint-frames with a truth."""
    per_joint: Mapping[str, Number]
    """Relative, mm."""
    per_action: Mapping[str, Number]
    pose_prior: Mapping[str, Mapping[str, Number]]
    """S^2 by subject and part."""
    without_damaged: PoseMeans | None = None
    """Where the data hold damaged takes: the means of the others."""

    @property
    def headline(self) -> Number:
        return self.means.relative

    def plain(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        content = {
            **self.means.plain(),
            "coverage": self.coverage,
            "per_joint": dict(self.per_joint),
            "per_action": dict(self.per_action),
            "pose_prior": {subject: dict(parts) for subject, parts in self.pose_prior.items()},
        }
        if self.without_damaged is not None:
            content["without_damaged"] = self.without_damaged.plain()
        return content
