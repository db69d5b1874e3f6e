"""Intrinsics of cameras of which only the image size is known, from the people in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.findings import Finding
from ghpt.calibration.focal import (
    FocalAdjustment,
    FocalEstimate,
    FocalLengths,
    lens_errors,
    seen_by,
    state_of,
    with_focal,
    without,
)
from ghpt.calibration.mistakes import FOCAL_DIFFERS, FOCAL_UNKNOWN
from ghpt.calibration.rig import RigCalibration
from ghpt.calibration.uncertainty import LensErrors
from ghpt.errors import check, check_positive
from ghpt.geometry.cameras import CameraSet

_LEAST_VIEWS = 3
"""Two views determine no focal length."""


@dataclass(frozen=True)
class EstimatedIntrinsics:
    """Cameras whose focal lengths, and k1 if asked for, come from the people in view."""

    K: Float[Tensor, "V 3 3"]
    distortion: Float[Tensor, "V 5"]
    std: Float[Tensor, " V"]
    """Relative, of the focal lengths; inf where nothing is determined."""
    errors: LensErrors | None
    """What is not known of them; None where nothing is determined."""
    findings: tuple[Finding, ...]
    text: str
    """What was estimated, in words."""


@dataclass(frozen=True)
class IntrinsicsEstimation:
    """The settings of the estimation.

    ``focal``: one focal length for all cameras, or one for each. ``k1``: whether radial distortion
    is estimated too. ``frames``: most frames of the rig's that are adjusted. ``guess``: the first
    focal length, in longer sides of the image. ``std``: largest relative standard deviation of a
    focal length that counts as determined. ``differs``: standard deviations by which a camera's own
    focal length may differ from the shared one.
    """

    focal: str
    k1: bool
    frames: int
    guess: float
    std: float
    differs: float
    adjustment: FocalAdjustment

    def __post_init__(self) -> None:
        check_positive(frames=self.frames, guess=self.guess, std=self.std, differs=self.differs)
        known = ", ".join(FocalLengths)
        problem = f"is {self.focal!r}"
        check(self.focal in list(FocalLengths), "intrinsics.focal", problem, f"Give {known}.")

    def guess_cameras(self, names: Sequence[str], size: Int[Tensor, " 2"]) -> CameraSet:
        """Return cameras of one image size with the first guess of the focal length."""
        width, height = size.tolist()
        focal = self.guess * max(width, height)
        K = torch.tensor(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]],
            dtype=torch.float64,
        )
        views = len(names)
        return CameraSet(
            names=tuple(names),
            K=K.repeat(views, 1, 1),
            distortion=torch.zeros(views, 5, dtype=torch.float64),
            size=size.repeat(views, 1),
            path="image_size",
        )

    @torch.no_grad()
    def __call__(
        self,
        calibration: RigCalibration,
        cameras: CameraSet,
        key_points: Float[Tensor, "T V J 2"],
        confidence: Float[Tensor, "T V J"],
        valid: Bool[Tensor, "T V J"],
        seed: int,
    ) -> EstimatedIntrinsics:
        """Return the intrinsics of cameras as `guess_cameras`.

        ``key_points`` are pixels as detected.
        """
        K = cameras.K
        rig = calibration(cameras.names, K, key_points, confidence, valid, cameras.size, seed)
        views = int(rig.calibrated.sum())
        if views < _LEAST_VIEWS:
            return self._unknown(cameras, f"{views} cameras do not determine it")
        count = len(rig.frames)
        rows = torch.linspace(0, count - 1, min(self.frames, count)).round().long()
        frames = rig.frames[rows]
        shown = valid[frames] & rig.estimated[rows][:, None]
        seen = without(seen_by(K, key_points[frames], shown), ~rig.calibrated)
        start = state_of(rig.cameras.R, rig.cameras.t, rig.points[rows].flatten(0, 1))
        side = cameras.image_size.double().amax(-1)
        centre_std = self.adjustment.principal_point * side / K[:, 0, 0]
        focal = FocalLengths(self.focal)
        found = self.adjustment(seen, start, focal, self.k1, centre_std)
        findings: tuple[Finding, ...] = ()
        if focal is FocalLengths.SHARED:
            once = replace(self.adjustment, rounds=1)
            own = once(seen, found.state, FocalLengths.EACH, self.k1, centre_std)
            findings = self._differing(cameras, found, own, rig.calibrated)
        largest = float(found.std[rig.calibrated].max())
        if not largest <= self.std:
            return self._unknown(cameras, f"± {largest:.0%}")
        distortion = cameras.distortion.clone()
        distortion[:, 0] = found.k1
        estimated = with_focal(K, found.ratio)
        estimated[:, :2, 2] += K[:, :1, 0] * found.state.c
        text = self._text(cameras.names, estimated, found)
        errors = lens_errors(focal, found.std, centre_std / found.ratio)
        return EstimatedIntrinsics(estimated, distortion, found.std, errors, findings, text)

    def _unknown(self, cameras: CameraSet, why: str) -> EstimatedIntrinsics:
        std = torch.full((len(cameras),), torch.inf, dtype=torch.float64)
        finding = FOCAL_UNKNOWN.finding((), limit=self.std, why=why)
        text = f"focal length: not determined ({why})"
        return EstimatedIntrinsics(cameras.K, cameras.distortion, std, None, (finding,), text)

    def _differing(
        self,
        cameras: CameraSet,
        shared: FocalEstimate,
        each: FocalEstimate,
        calibrated: Bool[Tensor, " V"],
    ) -> tuple[Finding, ...]:
        """Return a warning of the cameras whose own focal lengths are clearly not the shared one;
        empty where there are none.
        """
        apart = (each.ratio / shared.ratio).log().abs() / each.std
        differing = torch.nonzero(calibrated & (apart > self.differs))[:, 0].tolist()
        if not differing:
            return ()
        names = tuple(cameras.names[view] for view in differing)
        most = float(apart[differing].max())
        return (FOCAL_DIFFERS.finding(names, most, self.differs),)

    def _text(self, names: tuple[str, ...], K: Float[Tensor, "V 3 3"], found: FocalEstimate) -> str:
        values = [
            f"{focal:.0f} ± {std:.1%}"
            for focal, std in zip(K[:, 0, 0].tolist(), found.std.tolist(), strict=True)
        ]
        if self.focal == FocalLengths.SHARED:
            focal = f"{values[0]} px for all cameras"
        else:
            each = zip(names, values, strict=True)
            focal = ", ".join(f"{name} {value} px" for name, value in each)
        lens = ""
        if self.k1:
            lens = f"; k1 {', '.join(f'{k1:.3f}' for k1 in found.k1.tolist())}"
        return f"focal length, estimated: {focal}{lens}; principal points near the image's centre"
