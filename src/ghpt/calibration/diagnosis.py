"""What is wrong with a recording or the rig it gave, by name, with the number that shows it and the mend."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.bundle import Adjusted
from ghpt.calibration.observations import Observations, check_positive
from ghpt.calibration.pairs import PairTable
from ghpt.calibration.resection import Resection, Rig
from ghpt.calibration.uncertainty import Uncertainty
from ghpt.models.baselines import person_size
from ghpt.models.scale import average_lengths, part_scales, stature

HUMAN = (1300.0, 2200.0)
"""Statures (mm) beyond which nearly no adult is."""


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
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """Frames used, joints."""
        return len(self.frames), self.key_points.shape[2]

    @property
    def rig(self) -> Rig | None:
        return None if self.adjusted is None else self.adjusted.rig

    def named(self, views: Bool[Tensor, " V"]) -> tuple[str, ...]:
        return tuple(name for name, chosen in zip(self.names, views.tolist(), strict=True) if chosen)

    def agreement(self, rig: Rig) -> tuple[Float[Tensor, " V"], Float[Tensor, " V"]]:
        """Median error in pixels, and share of inliers, of each placed view's key points whose point is known."""
        known = self.seen_by.seen & rig.inlier.any(0) & rig.placed[:, None]
        focal = (self.K[:, 0, 0] * self.K[:, 1, 1]).double().sqrt()[:, None]
        pixels = self.seen_by.error(rig.R, rig.t, rig.points) * self.seen_by.noise * focal
        median = torch.where(known, pixels, torch.nan).nanmedian(-1).values.nan_to_num(0.0, posinf=0.0)
        return median, rig.inlier.sum(-1) / known.sum(-1).clamp(min=1).double()


def of_stature(points: Float[Tensor, "T J 3"], estimated: Bool[Tensor, "T J"]) -> Iterator[Diagnosis]:
    """Whether the person in the scaled rig (mm) is of human size."""
    height = float(stature(points, estimated))
    if height and not HUMAN[0] <= height <= HUMAN[1]:
        yield Diagnosis("stature", "warning", (), (
            f"the person measures {height / 1000:.3g} m by the rig's scale, people measure 1.3 to 2.2 m; "
            "check the length that gave the scale and its unit (millimetres)"
        ), height)  # fmt: skip


@dataclass(frozen=True)
class Diagnostics:
    """Where a number is a diagnosis. Standard deviations: of rotations in degrees, of centres in sizes of the rig."""

    few_frames: int
    motion: float
    """Spread over the frames of a joint's place in the image, in persons' sizes, below which nothing moves."""
    flat: float
    """Thickness of the cloud of all points, in its length."""
    inliers: float
    noise: float
    """Noise of the key points that the residuals show, in persons' sizes."""
    rotation_std: float
    centre_std: float
    proportions: float
    """Largest over smallest ratio of the limbs' lengths to an average adult's."""
    outside: float
    """Share of key points outside the image."""
    unused: float
    """Share of width and of height of the image beyond which no key point lies."""

    def __post_init__(self) -> None:
        check_positive(**vars(self))

    def __call__(self, case: Case, spread: Uncertainty | None) -> tuple[Diagnosis, ...]:
        found = [*self._recording(case), *self._links(case)]
        if case.rig is not None and spread is not None:
            found += [*self._agreement(case, case.rig), *self._determined(case, case.rig, spread)]
        return tuple(found)

    def _recording(self, case: Case) -> Iterator[Diagnosis]:
        count = len(case.frames)
        if count < self.few_frames:
            yield Diagnosis("few_frames", "error" if count < 2 else "warning", (), (
                f"{count} usable frame{'s' * (count != 1)}, {self.few_frames} or more are needed for a rig to rely on; "
                "record longer, with a person that several cameras see at a time"
            ), float(count))  # fmt: skip
        motion = _motion(case.key_points[case.frames], case.usable[case.frames])
        if count > 1 and motion < self.motion:
            yield Diagnosis("little_motion", "warning", (), (
                f"joints move by {motion:.2g} of the person's size in the image, too little to tell noise from shape; "
                "let the person walk through the whole volume"
            ), motion)  # fmt: skip
        size = case.sizes if case.sizes is not None else (2 * case.K[:, :2, 2] + 1).nan_to_num(0.0)
        for v, name in enumerate(case.names):
            own = case.key_points[:, v][case.usable[:, v]].double()
            if not len(own):
                continue
            extent, limit = own.quantile(0.99, dim=0) if len(own) < 10**7 else own.amax(0), size[v].double()
            outside = float(((own < -0.02 * limit) | (own > 1.02 * limit)).any(-1).double().mean())
            if outside > self.outside or bool((extent < self.unused * limit).all()):
                reach = f"{extent[0]:.0f} x {extent[1]:.0f}"
                yield Diagnosis("resolution", "error" if outside > self.outside else "warning", (name,), (
                    f"key points of {name} reach {reach} in an image of {limit[0]:.0f} x {limit[1]:.0f} ({outside:.0%} "
                    "outside); give intrinsics and key points of one and the same resolution"
                ), outside)  # fmt: skip

    def _links(self, case: Case) -> Iterator[Diagnosis]:
        placed = torch.zeros(len(case.names), dtype=torch.bool) if case.rig is None else case.rig.placed
        for v in torch.nonzero(~placed)[:, 0].tolist():
            own = (case.table.views == v).any(-1)
            common = int(case.table.common[own].max()) if own.any() else 0
            agree = int(case.table.inliers[own].max()) if own.any() else 0
            name = case.names[v]
            yield Diagnosis("unlinked", "error", (name,), (
                f"{name} cannot be linked to the other cameras: at best {common} common key points with one of them, "
                f"{agree} of which agree; check its intrinsics, its synchronisation, and that it sees the same person"
            ), float(agree))  # fmt: skip

    def _agreement(self, case: Case, rig: Rig) -> Iterator[Diagnosis]:
        pixels, inliers = case.agreement(rig)
        for v in torch.nonzero(rig.placed & (inliers < self.inliers))[:, 0].tolist():
            yield Diagnosis("disagreement", "warning", (case.names[v],), (
                f"only {inliers[v]:.0%} of {case.names[v]}'s key points agree with the other cameras (median error "
                f"{pixels[v]:.1f} px); check its intrinsics, its synchronisation and its key points"
            ), float(inliers[v]))  # fmt: skip
        size = person_size(case.key_points[case.frames].double(), case.usable[case.frames])
        size = torch.where(size > 0, size, torch.nan).nanmedian(0).values.nan_to_num(1.0)
        focal = (case.K[:, 0, 0] * case.K[:, 1, 1]).double().sqrt()
        noise = (case.seen_by.noise.median(-1).values * focal / size).nan_to_num(0.0)
        for v in torch.nonzero(rig.placed & (noise > self.noise))[:, 0].tolist():
            yield Diagnosis("large_residuals", "warning", (case.names[v],), (
                f"key points of {case.names[v]} are off by {noise[v]:.1%} of the person's size, detectors by 1 to 2 %; "
                "check its intrinsics, lens distortion and synchronisation"
            ), float(noise[v]))  # fmt: skip

    def _determined(self, case: Case, rig: Rig, spread: Uncertainty) -> Iterator[Diagnosis]:
        assert case.adjusted is not None
        if not case.adjusted.converged:
            yield Diagnosis("not_converged", "error", (), (
                f"the bundle adjustment stopped after {case.adjusted.iterations} steps short of a minimum; "
                "raise bundle.iterations and bundle.seconds, or look at the other diagnoses"
            ), case.adjusted.final.gain)  # fmt: skip
        if int(rig.placed.sum()) == 2:
            angle = float(torch.rad2deg(case.table.angle[case.table.linked].max()))
            yield Diagnosis("two_views", "warning", case.named(rig.placed), (
                f"two cameras only, whose rays meet at {angle:.0f} degrees: nothing checks the depths along the line "
                "between them, weak where it is near 0 (side by side, or opposite); a third camera would"
            ), angle)  # fmt: skip
        variance = spread.covariance.diagonal(dim1=-2, dim2=-1)
        turn, place = torch.rad2deg(variance[:, :3].mean(-1).sqrt()), variance[:, 3:].mean(-1).sqrt()
        weak = rig.placed & ((turn > self.rotation_std) | (place > self.centre_std))
        if weak.any():
            yield Diagnosis("ill_conditioned", "warning", case.named(weak), (
                f"the recording hardly determines {', '.join(case.named(weak))}: standard deviation up to "
                f"{turn.max():.2g} degrees and {place.max():.1%} of the rig's size; record more motion through the "
                "whole volume, or place cameras so that they look across one another"
            ), float(place.max()))  # fmt: skip
        known = rig.inlier.any(0)
        cloud = rig.points[known] - rig.points[known].mean(0)
        values = torch.linalg.svdvals(cloud) if len(cloud) > 2 else torch.ones(3)
        if values[2] < self.flat * values[0]:
            shape = "a line" if values[1] < self.flat * values[0] else "a plane"
            yield Diagnosis("flat", "warning", (), (
                f"all points lie near {shape} (thickness {values[2] / values[0]:.1%} of the length), which leaves several "
                "rigs possible; let the person move in depth and turn"
            ), float(values[2] / values[0]))  # fmt: skip
        lengths = torch.tensor(average_lengths(), dtype=torch.float64)
        parts = part_scales(rig.points.unflatten(0, case.shape), known.unflatten(0, case.shape), lengths)
        parts = parts[torch.isfinite(parts)]
        if len(parts) > 1 and parts.max() > self.proportions * parts.min():
            ratio = float(parts.max() / parts.min())
            yield Diagnosis("proportions", "warning", (), (
                f"the person's limbs are out of human proportion by a factor {ratio:.2f}; check the joints' order and "
                "the intrinsics, and do not scale this rig by a body"
            ), ratio)  # fmt: skip


def _motion(key_points: Float[Tensor, "T V J 2"], seen: Bool[Tensor, "T V J"]) -> float:
    """Median over the joints of the spread (half the range of the middle 80 %) of their place, in persons' sizes, in
    the view with most."""
    size = person_size(key_points.double(), seen)
    size = torch.where(size > 0, size, torch.nan).nanmedian(0).values
    place = torch.where(seen[..., None], key_points.double(), torch.nan)
    if not len(place):
        return 0.0
    low, high = place.nanquantile(torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
    spread = ((high - low).norm(dim=-1) / 2).nanmedian(-1).values / size
    return float(spread.nan_to_num(0.0).max())
