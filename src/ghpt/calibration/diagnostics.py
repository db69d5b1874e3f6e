"""The rules that turn a recording and the rig that it gave into findings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.bundle import Adjusted
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.independence import Evidence
from ghpt.calibration.mistakes import (
    DISAGREEMENT,
    FEW_FRAMES,
    FLAT,
    ILL_CONDITIONED,
    LARGE_RESIDUALS,
    LITTLE_MOTION,
    NOT_CONVERGED,
    NOTHING_LINKED,
    OUTSIDE_IMAGE,
    PROPORTIONS,
    SAME_PLACE,
    TWO_VIEWS,
    UNLINKED,
    UNUSED_IMAGE,
)
from ghpt.calibration.observations import Correspondences, typical_size
from ghpt.calibration.pairs import PairTable
from ghpt.calibration.repair import Repair, RepairThresholds
from ghpt.calibration.resection import PlacedRig, Resection
from ghpt.calibration.uncertainty import (
    Uncertainty,
    blocks_of,
    centre_std,
    rotation_std_deg,
)
from ghpt.errors import check_positive
from ghpt.geometry.cameras import camera_centre
from ghpt.models.relative_pose.scale import average_lengths, bone_scales

_MARGIN = 0.1
"""Of the image's size: undistorted key points may lie so far outside."""
_REACH = 0.99
"""The quantile of the key points' coordinates that is their extent."""
_SUSPICIOUS = ("resolution", "unlinked", "disagreement")
"""Findings that a mistake of the camera's own may explain."""


@dataclass(frozen=True)
class Joints:
    """The 17 joints of the rows that a rig was calibrated from, in its world."""

    points: Float[Tensor, "R 17 3"]
    estimated: Bool[Tensor, "R 17"]


@dataclass(frozen=True)
class Case:
    """All that is known of a rig when it is judged."""

    names: tuple[str, ...]
    K: Float[Tensor, "V 3 3"]
    key_points: Float[Tensor, "T V 17 2"]
    valid: Bool[Tensor, "T V 17"]
    sizes: Int[Tensor, "V 2"] | None
    frames: Int[Tensor, " F"]
    """The rows that are used."""
    observed: Correspondences
    """The detector's own key points of these rows."""
    joints: Joints
    table: PairTable
    adjusted: Adjusted | None
    evidence: Evidence | None
    """None without a rig."""
    resection: Resection
    noise: float
    """First guess of the key points' noise, in sizes of the person."""
    seed: int

    @property
    def rig(self) -> PlacedRig | None:
        """The adjusted rig, if there is one."""
        return None if self.adjusted is None else self.adjusted.rig

    @property
    def focal(self) -> Float[Tensor, " V"]:
        """The focal lengths, pixels, float64."""
        return (self.K[:, 0, 0] * self.K[:, 1, 1]).double().sqrt()

    def select_names(self, views: Bool[Tensor, " V"]) -> tuple[str, ...]:
        """Return the names of some views."""
        chosen = zip(self.names, views.tolist(), strict=True)
        return tuple(name for name, is_chosen in chosen if is_chosen)

    def agreement(self, rig: PlacedRig) -> tuple[Float[Tensor, " V"], Float[Tensor, " V"]]:
        """Return the median error in pixels, and the share of inliers, of each placed view's key
        points whose point is known.
        """
        known = self.observed.valid & rig.inlier.any(0) & rig.placed[:, None]
        error = self.observed.error(rig.R, rig.t, rig.points)
        pixels = error * self.observed.noise * self.focal[:, None]
        median = torch.where(known, pixels, torch.nan).nanmedian(-1).values
        count = known.sum(-1).clamp(min=1).double()
        return median.nan_to_num(0.0, posinf=0.0), rig.inlier.sum(-1) / count


@dataclass(frozen=True)
class Diagnostics:
    """Where a number becomes a finding. Standard deviations: of rotations in degrees, of centres
    in sizes of the rig.

    ``few_frames``: fewer are a finding. ``rotation_wanted``: a larger standard deviation of a
    rotation is a finding that says how much recording would do, and an error from
    ``rotation_useless`` on. ``flat``: least thickness of the cloud of all points, in its length.
    ``inliers``: least share of a view's key
    points that agree. ``noise``: largest noise of the key points that the residuals show, in sizes
    of the person; ``contrast``: and in the median of the views. ``distance``: least distance of two
    cameras, in sizes of the rig. ``proportions``: largest ratio of the bones' lengths, in an
    average adult's, to each other. ``outside``: largest share of key points outside the image.
    ``unused``: share of the width and of the height of the image beyond which some key points must
    lie. ``repair``: when a mistake explains a finding.
    """

    few_frames: int
    flat: float
    inliers: float
    noise: float
    contrast: float
    distance: float
    rotation_wanted: float
    rotation_useless: float
    rotation_std: float
    centre_std: float
    proportions: float
    outside: float
    unused: float
    repair: RepairThresholds

    def __post_init__(self) -> None:
        numbers = {name: value for name, value in vars(self).items() if name != "repair"}
        check_positive(**numbers)

    def __call__(self, case: Case, uncertainty: Uncertainty | None) -> tuple[Finding, ...]:
        """Return the findings.

        Where the recording does not determine a rig nothing is said of the rig: what is wrong with
        it comes from that, and shows nothing of the cameras.
        """
        recording = list(self._frames(case))
        determined = all(found.severity != Severity.ERROR for found in recording)
        findings = [*recording, *self._resolution(case), *self._links(case)]
        if case.rig is not None and uncertainty is not None and determined:
            findings += self._agreement(case, case.rig)
            findings += self._geometry(case, case.rig)
            findings += self._proportions(case)
            findings += self._evidence(case)
            findings += self._check_determined(case, case.rig, uncertainty)
        return (*findings, *self._repairs(case, findings))

    def _repairs(self, case: Case, findings: list[Finding]) -> Iterator[Finding]:
        """Yield the mistakes that explain why views do not agree with the others."""
        suspects = {name for f in findings if f.code in _SUSPICIOUS for name in f.cameras}
        repair = Repair(
            names=case.names,
            K=case.K,
            key_points=case.key_points[case.frames],
            valid=case.valid[case.frames],
            sizes=case.sizes,
            noise=case.noise,
            table=case.table,
            resection=case.resection,
            thresholds=self.repair,
            seed=case.seed,
        )
        said = set()
        for view, name in enumerate(case.names):
            found = repair.find(view) if name in suspects else None
            if found is not None and (found.code, frozenset(found.cameras)) not in said:
                said.add((found.code, frozenset(found.cameras)))
                yield found

    def _frames(self, case: Case) -> Iterator[Finding]:
        count = len(case.frames)
        if count < self.few_frames:
            severity = Severity.ERROR if count < 2 else Severity.WARNING
            plural = "" if count == 1 else "s"
            yield FEW_FRAMES.finding((), count, self.few_frames, severity, plural=plural)

    def _resolution(self, case: Case) -> Iterator[Finding]:
        """Yield the views whose key points lie outside the image, or leave much of it unused."""
        size = case.sizes
        if size is None:
            size = (2 * case.K[:, :2, 2] + 1).nan_to_num(0.0)
        unused = []
        for view, name in enumerate(case.names):
            own = case.key_points[:, view][case.valid[:, view]].double()
            if not len(own):
                continue
            limit = size[view].double()
            extent = _extent(own)
            too_far = (own < -_MARGIN * limit) | (own > (1 + _MARGIN) * limit)
            outside = float(too_far.any(-1).double().mean())
            image = f"{limit[0]:.0f} x {limit[1]:.0f}"
            words = f"{extent[0]:.0f} x {extent[1]:.0f} in an image of {image}"
            if outside > self.outside:
                yield OUTSIDE_IMAGE.finding((name,), outside, self.outside, extent=words)
            elif bool((extent < self.unused * limit).all()):
                reach = float((extent / limit).max())
                unused.append(UNUSED_IMAGE.finding((name,), reach, self.unused, extent=words))
        everywhere = len(unused) == len(case.names)
        for found in unused:
            yield replace(found, severity=Severity.ERROR) if everywhere else found

    def _links(self, case: Case) -> Iterator[Finding]:
        table = case.table
        if case.rig is None:
            every = torch.ones(len(table.common), dtype=torch.bool)
            common, agree = _most_common(table, every)
            yield NOTHING_LINKED.finding(case.names, agree, common=common)
            return
        for view in torch.nonzero(~case.rig.placed)[:, 0].tolist():
            common, agree = _most_common(table, (table.views == view).any(-1))
            yield UNLINKED.finding((case.names[view],), agree, common=common)

    def _agreement(self, case: Case, rig: PlacedRig) -> Iterator[Finding]:
        """Yield the views that agree less with the rig than the others or than detectors do."""
        pixels, inliers = case.agreement(rig)
        size = typical_size(case.key_points[case.frames].double(), case.valid[case.frames])
        noise_px = case.observed.noise.median(-1).values * case.focal
        noise = (noise_px / size.nan_to_num(1.0)).nan_to_num(0.0)
        usual = float(noise[rig.placed].median())
        for view in torch.nonzero(rig.placed)[:, 0].tolist():
            name = (case.names[view],)
            share = float(inliers[view])
            off = float(noise[view])
            if share < self.inliers or off > self.contrast * usual:
                limit = self.inliers
                yield DISAGREEMENT.finding(name, share, limit, off=off, usual=usual)
            elif off > self.noise:
                px = float(pixels[view])
                yield LARGE_RESIDUALS.finding(name, off, self.noise, pixels=px)

    def _geometry(self, case: Case, rig: PlacedRig) -> Iterator[Finding]:
        """Yield arrangements of cameras and people that leave the rig open."""
        centre = camera_centre(rig.R, rig.t)
        distance = torch.cdist(centre, centre)
        both_placed = (rig.placed & rig.placed[:, None]).triu(1)
        near = (distance < self.distance) & both_placed
        for a, b in torch.nonzero(near).tolist():
            names = (case.names[a], case.names[b])
            yield SAME_PLACE.finding(names, float(distance[a, b]), self.distance)
        if int(rig.placed.sum()) == 2:
            angle = float(torch.rad2deg(case.table.angle[case.table.linked].max()))
            yield TWO_VIEWS.finding(case.select_names(rig.placed), angle)
        known = rig.inlier.any(0)
        cloud = rig.points[known] - rig.points[known].mean(0)
        values = torch.linalg.svdvals(cloud) if len(cloud) > 2 else torch.ones(3)
        if values[2] < self.flat * values[0]:
            shape = "a line" if values[1] < self.flat * values[0] else "a plane"
            yield FLAT.finding((), float(values[2] / values[0]), self.flat, shape=shape)

    def _proportions(self, case: Case) -> Iterator[Finding]:
        lengths = torch.tensor(average_lengths(), dtype=torch.float64)
        scales = bone_scales(case.joints.points, case.joints.estimated, lengths)
        scales = scales[torch.isfinite(scales)]
        if len(scales) > 1 and scales.max() > self.proportions * scales.min():
            ratio = float(scales.max() / scales.min())
            yield PROPORTIONS.finding((), ratio, self.proportions)

    def _evidence(self, case: Case) -> Iterator[Finding]:
        """Yield that the recording is too short, or too much alike, for a rig to rely on."""
        evidence = case.evidence
        if evidence is not None and evidence.rotation_sd_deg > self.rotation_wanted:
            useless = evidence.rotation_sd_deg > self.rotation_useless
            yield LITTLE_MOTION.finding(
                (),
                evidence.rotation_sd_deg,
                self.rotation_wanted,
                Severity.ERROR if useless else Severity.WARNING,
                used=evidence.used,
                independent=evidence.independent,
                turned=evidence.turned_deg,
                needed=_needed(evidence, self.rotation_wanted),
            )

    def _check_determined(
        self, case: Case, rig: PlacedRig, uncertainty: Uncertainty
    ) -> Iterator[Finding]:
        """Yield what says that another rig would do as well."""
        if case.adjusted is not None and not case.adjusted.converged:
            gain = case.adjusted.final.gain
            yield NOT_CONVERGED.finding((), gain, iterations=case.adjusted.iterations)
        covariance = blocks_of(uncertainty.covariance)
        rotation = rotation_std_deg(covariance)
        position = centre_std(covariance)
        weak = rig.placed & ((rotation > self.rotation_std) | (position > self.centre_std))
        if weak.any():
            names = case.select_names(weak)
            most = float(position.max())
            degrees = float(rotation.max())
            yield ILL_CONDITIONED.finding(names, most, self.centre_std, degrees=degrees)


def _needed(evidence: Evidence, wanted: float) -> str:
    """Return what would give a smaller standard deviation, in words."""
    frames = evidence.frames_for(wanted)
    if frames is None:
        return f"however many frames like these leave ± {evidence.least_sd_deg:.1f}"
    return f"± {wanted:g} takes about {frames} frames like these"


def _extent(pixels: Float[Tensor, "N 2"]) -> Float[Tensor, " 2"]:
    rank = max(round(_REACH * len(pixels)), 1)
    return torch.stack([x.kthvalue(rank).values for x in pixels.T])


def _most_common(table: PairTable, pairs: Bool[Tensor, " P"]) -> tuple[int, int]:
    """Return the most key points that one of the pairs has in common, and the most that agree."""
    if not pairs.any():
        return 0, 0
    return int(table.common[pairs].max()), int(table.inliers[pairs].max())
