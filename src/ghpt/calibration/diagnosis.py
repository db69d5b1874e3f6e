"""What is wrong with a recording or the rig it gave, by name, with the number that shows it and the
mend.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.bundle import Adjusted
from ghpt.calibration.observations import Observations
from ghpt.calibration.pairs import PairTable
from ghpt.calibration.repair import find_repair
from ghpt.calibration.resection import Resection, Rig
from ghpt.models.relative_pose.scale import HUMAN, STATURES, stature


@dataclass(frozen=True)
class Diagnosis:
    code: str
    severity: Literal["error", "warning"]
    cameras: tuple[str, ...]
    """Those it is about; empty: the recording."""
    text: str
    value: float
    """The number that shows it."""


@dataclass(frozen=True)
class Case:
    """All that is known when a rig is diagnosed."""

    names: tuple[str, ...]
    K: Float[Tensor, "V 3 3"]
    key_points: Float[Tensor, "T V J 2"]
    usable: Bool[Tensor, "T V J"]
    sizes: Int[Tensor, "V 2"] | None
    frames: Int[Tensor, " F"]
    seen_by: Observations
    table: PairTable
    adjusted: Adjusted | None
    resection: Resection
    noise: float
    """First guess, in persons' sizes."""
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """Frames used, joints."""
        return len(self.frames), self.key_points.shape[2]

    @property
    def rig(self) -> Rig | None:
        return None if self.adjusted is None else self.adjusted.rig

    def named(self, views: Bool[Tensor, " V"]) -> tuple[str, ...]:
        return tuple(
            name for name, chosen in zip(self.names, views.tolist(), strict=True) if chosen
        )

    def repaired(self, view: int) -> Iterator[Diagnosis]:
        """The user's mistake that explains why a view does not agree with the others, if one does."""
        chosen = self.key_points[self.frames], self.usable[self.frames]
        repair = find_repair(
            self.names,
            self.K,
            *chosen,
            self.sizes,
            self.noise,
            self.table,
            view,
            self.resection,
            self.seed,
        )
        if repair is not None:
            text = f"{repair.text} ({repair.share:.0%} of its key points then agree)"
            yield Diagnosis(repair.code, "error", (self.names[view],), text, repair.share)

    def agreement(self, rig: Rig) -> tuple[Float[Tensor, " V"], Float[Tensor, " V"]]:
        """Median error in pixels, and share of inliers, of each placed view's key points whose
        point is known.
        """
        known = self.seen_by.valid & rig.inlier.any(0) & rig.placed[:, None]
        focal = (self.K[:, 0, 0] * self.K[:, 1, 1]).double().sqrt()[:, None]
        pixels = self.seen_by.error(rig.R, rig.t, rig.points) * self.seen_by.noise * focal
        median = (
            torch.where(known, pixels, torch.nan).nanmedian(-1).values.nan_to_num(0.0, posinf=0.0)
        )
        return median, rig.inlier.sum(-1) / known.sum(-1).clamp(min=1).double()


def of_stature(
    points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"]
) -> Iterator[Diagnosis]:
    """Whether the person in the scaled rig (mm) is of human size: an error for a size that is
    nobody's.
    """
    height = float(stature(points, estimated))
    if not height or STATURES[0] <= height <= STATURES[1]:
        return
    severity: Literal["error", "warning"] = "warning" if HUMAN[0] <= height <= HUMAN[1] else "error"
    low, high = (size / 1000 for size in STATURES)
    text = (
        f"the person measures {height / 1000:.3g} m by the rig's scale, people measure {low:g} to {high:g} m; "
        "check the length that gave the scale and its unit (millimetres)"
    )
    yield Diagnosis("stature", severity, (), text, height)
