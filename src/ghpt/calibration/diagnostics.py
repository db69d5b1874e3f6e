"""The rules that turn a recording and its rig into diagnoses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.diagnosis import Case, Diagnosis
from ghpt.calibration.observations import typical_size
from ghpt.calibration.resection import Rig
from ghpt.calibration.uncertainty import Uncertainty
from ghpt.errors import check_positive
from ghpt.models.relative_pose.scale import average_lengths, part_scales


@dataclass(frozen=True)
class Diagnostics:
    """Where a number is a diagnosis. Standard deviations: of rotations in degrees, of centres in
    sizes of the rig.
    """

    few_frames: int
    motion: float
    """Spread over the frames of a joint's place in the image, in persons' sizes; an error below
    half of it.
    """
    flat: float
    """Thickness of the cloud of all points, in its length."""
    inliers: float
    noise: float
    """Noise of the key points that the residuals show, in persons' sizes."""
    contrast: float
    """The same in the median of the views."""
    apart: float
    """Distance of two cameras, in sizes of the rig."""
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
            found += self._agreement(case, case.rig)
            found += self._geometry(case, case.rig)
            found += self._determined(case, case.rig, spread)
        suspects = {name for d in found if d.code in _SUSPICIOUS for name in d.cameras}
        for view, name in enumerate(case.names):
            if name in suspects:
                found += case.repaired(view)
        return tuple(found)

    def _recording(self, case: Case) -> Iterator[Diagnosis]:
        count = len(case.frames)
        if count < self.few_frames:
            yield Diagnosis(
                "few_frames",
                "error" if count < 2 else "warning",
                (),
                (
                    f"{count} usable frame{'s' * (count != 1)}, {self.few_frames} or more are needed for a rig to rely on; "
                    "record longer, with a person that several cameras see at a time"
                ),
                float(count),
            )
        motion = _motion(case.key_points[case.frames], case.usable[case.frames])
        if count > 1 and motion < self.motion:
            yield Diagnosis(
                "little_motion",
                "error" if motion < self.motion / 2 else "warning",
                (),
                (
                    f"joints move by {motion:.2g} of the person's size in the image: {count} frames are worth little more "
                    "than one, and errors larger than the uncertainty says; let the person walk through the whole volume"
                ),
                motion,
            )
        yield from self._resolution(case)

    def _resolution(self, case: Case) -> Iterator[Diagnosis]:
        size = case.sizes if case.sizes is not None else (2 * case.K[:, :2, 2] + 1).nan_to_num(0.0)
        unused = []
        for v, name in enumerate(case.names):
            own = case.key_points[:, v][case.usable[:, v]].double()
            if not len(own):
                continue
            extent = torch.stack([x.kthvalue(max(round(0.99 * len(x)), 1)).values for x in own.T])
            limit = size[v].double()
            # undistorted key points may lie a little outside
            outside = float(((own < -0.1 * limit) | (own > 1.1 * limit)).any(-1).double().mean())
            reach = (
                f"{extent[0]:.0f} x {extent[1]:.0f} in an image of {limit[0]:.0f} x {limit[1]:.0f}"
            )
            if outside > self.outside:
                yield Diagnosis(
                    "resolution",
                    "error",
                    (name,),
                    (
                        f"key points of {name} reach {reach}, {outside:.0%} are outside; give intrinsics and key points of "
                        "one and the same resolution"
                    ),
                    outside,
                )
            elif bool((extent < self.unused * limit).all()):
                unused.append((name, reach, float((extent / limit).max())))
        everywhere = len(unused) == len(case.names)
        for name, reach, share in unused:
            yield Diagnosis(
                "resolution",
                "error" if everywhere else "warning",
                (name,),
                (
                    f"key points of {name} reach no further than {reach}; give intrinsics and key points of one and the "
                    "same resolution"
                ),
                share,
            )

    def _links(self, case: Case) -> Iterator[Diagnosis]:
        if case.rig is None:
            most = int(case.table.common.max()) if len(case.table.common) else 0
            agree = int(case.table.inliers.max()) if len(case.table.inliers) else 0
            yield Diagnosis(
                "unlinked",
                "error",
                case.names,
                (
                    f"no two cameras can be linked: at best {most} common key points, {agree} of which agree with one "
                    "relative pose; check that the cameras are apart, synchronised, and see the same moving person"
                ),
                float(agree),
            )
            return
        placed = case.rig.placed
        for v in torch.nonzero(~placed)[:, 0].tolist():
            own = (case.table.views == v).any(-1)
            common = int(case.table.common[own].max()) if own.any() else 0
            agree = int(case.table.inliers[own].max()) if own.any() else 0
            name = case.names[v]
            yield Diagnosis(
                "unlinked",
                "error",
                (name,),
                (
                    f"{name} cannot be linked to the other cameras: at best {common} common key points with one of them, "
                    f"{agree} of which agree; check its intrinsics, its synchronisation, and that it sees the same person"
                ),
                float(agree),
            )

    def _agreement(self, case: Case, rig: Rig) -> Iterator[Diagnosis]:
        pixels, inliers = case.agreement(rig)
        size = typical_size(
            case.key_points[case.frames].double(), case.usable[case.frames]
        ).nan_to_num(1.0)
        focal = (case.K[:, 0, 0] * case.K[:, 1, 1]).double().sqrt()
        noise = (case.seen_by.noise.median(-1).values * focal / size).nan_to_num(0.0)
        usual = float(noise[rig.placed].median())
        for v in torch.nonzero(rig.placed)[:, 0].tolist():
            name = case.names[v]
            off = float(noise[v])
            alone = inliers[v] < self.inliers or off > self.contrast * usual
            if alone:
                yield Diagnosis(
                    "disagreement",
                    "warning",
                    (name,),
                    (
                        f"{inliers[v]:.0%} of {name}'s key points agree with the other cameras, and those are off by "
                        f"{off:.1%} of the person's size (median of the cameras: {usual:.1%}); check its intrinsics, its "
                        "synchronisation and its key points"
                    ),
                    float(inliers[v]),
                )
            elif off > self.noise:
                yield Diagnosis(
                    "large_residuals",
                    "warning",
                    (name,),
                    (
                        f"key points of {name} are off by {off:.1%} of the person's size ({pixels[v]:.1f} px), detectors' "
                        "by 1 to 2 %; check all intrinsics, lens distortion and synchronisation"
                    ),
                    off,
                )

    def _geometry(self, case: Case, rig: Rig) -> Iterator[Diagnosis]:
        centre = rig.centre
        distance = torch.cdist(centre, centre)
        near = (distance < self.apart) & (rig.placed & rig.placed[:, None]).triu(1)
        for a, b in torch.nonzero(near).tolist():
            yield Diagnosis(
                "same_place",
                "error",
                (case.names[a], case.names[b]),
                (
                    f"{case.names[a]} and {case.names[b]} are {distance[a, b]:.1%} of the rig's size apart; check that "
                    "they are not one camera given twice"
                ),
                float(distance[a, b]),
            )
        if int(rig.placed.sum()) == 2:
            angle = float(torch.rad2deg(case.table.angle[case.table.linked].max()))
            yield Diagnosis(
                "two_views",
                "warning",
                case.named(rig.placed),
                (
                    f"two cameras only, whose rays meet at {angle:.0f} degrees: nothing checks them, and depths are weak "
                    "where the angle is near 0 (side by side, or opposite); add a third camera"
                ),
                angle,
            )
        known = rig.inlier.any(0)
        cloud = rig.points[known] - rig.points[known].mean(0)
        values = torch.linalg.svdvals(cloud) if len(cloud) > 2 else torch.ones(3)
        if values[2] < self.flat * values[0]:
            shape = "a line" if values[1] < self.flat * values[0] else "a plane"
            yield Diagnosis(
                "flat",
                "warning",
                (),
                (
                    f"all points lie near {shape} (thickness {values[2] / values[0]:.1%} of the length), which leaves "
                    "several rigs possible; let the person move in depth and turn"
                ),
                float(values[2] / values[0]),
            )
        lengths = torch.tensor(average_lengths(), dtype=torch.float64)
        parts = part_scales(
            rig.points.unflatten(0, case.shape), known.unflatten(0, case.shape), lengths
        )
        parts = parts[torch.isfinite(parts)]
        if len(parts) > 1 and parts.max() > self.proportions * parts.min():
            ratio = float(parts.max() / parts.min())
            yield Diagnosis(
                "proportions",
                "warning",
                (),
                (
                    f"the person's limbs are out of human proportion by a factor {ratio:.2f}; check the joints' order and "
                    "the intrinsics, and do not scale this rig by a body"
                ),
                ratio,
            )

    def _determined(self, case: Case, rig: Rig, spread: Uncertainty) -> Iterator[Diagnosis]:
        assert case.adjusted is not None
        if not case.adjusted.converged:
            yield Diagnosis(
                "not_converged",
                "error",
                (),
                (
                    f"the bundle adjustment stopped after {case.adjusted.iterations} steps short of a minimum; "
                    "raise bundle.iterations and bundle.seconds, or look at the other diagnoses"
                ),
                case.adjusted.final.gain,
            )
        variance = spread.covariance.diagonal(dim1=-2, dim2=-1)
        turn = torch.rad2deg(variance[:, :3].mean(-1).sqrt())
        place = variance[:, 3:].mean(-1).sqrt()
        weak = rig.placed & ((turn > self.rotation_std) | (place > self.centre_std))
        if weak.any():
            yield Diagnosis(
                "ill_conditioned",
                "warning",
                case.named(weak),
                (
                    f"the recording hardly determines {', '.join(case.named(weak))}: standard deviation up to "
                    f"{turn.max():.2g} degrees and {place.max():.1%} of the rig's size; record more motion through the "
                    "whole volume, or place cameras so that they look across one another"
                ),
                float(place.max()),
            )


def _motion(key_points: Float[Tensor, "T V J 2"], valid: Bool[Tensor, "T V J"]) -> float:
    """Median over the joints of the spread (half the range of the middle 80 %) of their place, in
    persons' sizes, in the view with most.
    """
    size = typical_size(key_points.double(), valid)
    place = torch.where(valid[..., None], key_points.double(), torch.nan)
    if not len(place):
        return 0.0
    low, high = place.nanquantile(torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
    spread = ((high - low).norm(dim=-1) / 2).nanmedian(-1).values / size
    return float(spread.nan_to_num(0.0).max())


_SUSPICIOUS = ("resolution", "unlinked", "disagreement")
"""Diagnoses that one of the user's mistakes may explain."""
