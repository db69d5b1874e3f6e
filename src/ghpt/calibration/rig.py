"""A whole rig's extrinsics from the people in view: frames, pairs, resection, bundle adjustment,
uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from ghpt.calibration.bundle import Adjusted, BundleAdjustment
from ghpt.calibration.diagnostics import Case, Diagnostics, Joints
from ghpt.calibration.error_model import ErrorModel
from ghpt.calibration.findings import Finding, Severity
from ghpt.calibration.independence import Evidence, persistence, turning
from ghpt.calibration.mistakes import size_finding
from ghpt.calibration.observations import (
    Correspondences,
    choose_frames,
    joints_of,
    observe,
    reweight,
    spread_key_points,
    usable,
)
from ghpt.calibration.pairs import PairEstimation, PairTable
from ghpt.calibration.resection import PlacedRig, Resection
from ghpt.calibration.uncertainty import (
    LensErrors,
    Uncertainty,
    blocks_of,
    centre_std,
    rotation_std_deg,
    uncertainty,
)
from ghpt.errors import GhptDataError, check_positive
from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.scale import stature
from ghpt.skeleton import HUMAN36M, Skeleton

_ROUGH = 1e-3
"""Tolerance of the adjustments whose weights and points are not the last."""


@dataclass(frozen=True)
class RigEstimate:
    """A calibrated rig. The world is the frame of the first calibrated camera; the unit of length
    is the rig's size (the root mean square distance of the cameras from their mean) until
    ``scaled`` makes it millimetres.
    """

    names: tuple[str, ...]
    cameras: Cameras
    """K, R, t with leading dimension V, float64; identity and t = 0 for a camera that is not
    calibrated.
    """
    calibrated: Bool[Tensor, " V"]
    joint_covariance: Float64[Tensor, "P P"]
    """Of all cameras together: of each the rotation vector about the world's axes (radians; of
    camera to world), then the centre (world), in the gauge of the rig as a whole
    (``ghpt.calibration.uncertainty.Uncertainty``); 0 for a camera that is not calibrated.
    """
    reprojection: Float64[Tensor, " V"]
    """Median reprojection error of the key points whose point is known, outliers among them,
    pixels.
    """
    inliers: Float64[Tensor, " V"]
    """Share of those key points that agree with the rig."""
    pairs: PairTable
    frames: Int[Tensor, " T"]
    """Which frames of the recording were used."""
    points: Float64[Tensor, "T 17 3"]
    estimated: Bool[Tensor, "T 17"]
    converged: bool
    iterations: int
    evidence: Evidence | None
    """What the recording is worth; None without a rig."""
    findings: tuple[Finding, ...]

    @property
    def covariance(self) -> Float64[Tensor, "V 6 6"]:
        """Each camera's own part of the covariance."""
        return blocks_of(self.joint_covariance)

    @property
    def rotation_std_deg(self) -> Float64[Tensor, " V"]:
        """Standard deviation of a camera's rotation: of the angle about whatever axis."""
        return rotation_std_deg(self.covariance)

    @property
    def centre_std(self) -> Float64[Tensor, " V"]:
        """Standard deviation of a camera's centre, of its distance, in the unit of length."""
        return centre_std(self.covariance)

    @property
    def succeeded(self) -> bool:
        """Converged, every camera calibrated, and no finding is an error."""
        return (
            self.converged
            and bool(self.calibrated.all())
            and all(found.severity != Severity.ERROR for found in self.findings)
        )

    def scale_by(self, factor: float) -> RigEstimate:
        """The rig in millimetres: lengths times ``factor``. Warns of a person who is not of human
        size.
        """
        if not 0 < factor < float("inf"):
            hint = "Give a body height, segment lengths or a baseline that the recording shows."
            raise GhptDataError("rig", "scale", f"{factor} mm per unit of length", hint)
        unit = torch.cat((torch.ones(3), torch.full((3,), factor))).double().repeat(len(self.names))
        points = self.points * factor
        height = float(stature(points, self.estimated))
        wrong_size = size_finding(height) if height else None
        return replace(
            self,
            cameras=Cameras(self.cameras.K, self.cameras.R, self.cameras.t * factor),
            joint_covariance=self.joint_covariance * unit * unit[:, None],
            points=points,
            findings=self.findings if wrong_size is None else (*self.findings, wrong_size),
        )


@dataclass(frozen=True)
class RigCalibration:
    """Key points and known intrinsics to the extrinsics of all cameras.

    ``frames``: most frames of a person used, and fewer where they have more key points than
    ``observations`` in all views together. ``spacing``: of key points that are nearer to each
    other, in sizes of the person, one is used. ``noise``: first guess of the key points' noise, in
    sizes of the person in the image. ``seeds``: best-conditioned pairs that the rig is begun from
    in turn, until one places every linked view with a share of ``good`` inliers; the best is kept.
    ``rounds``: bundle adjustments, each with the noise of views and joints that the one before has
    shown and points triangulated anew. ``draws``: see ``uncertainty``.
    """

    frames: int
    observations: int
    spacing: float
    noise: float
    pairs: PairEstimation
    resection: Resection
    seeds: int
    good: float
    bundle: BundleAdjustment
    rounds: int
    draws: int
    diagnostics: Diagnostics

    def __post_init__(self) -> None:
        check_positive(
            frames=self.frames,
            observations=self.observations,
            spacing=self.spacing,
            noise=self.noise,
            seeds=self.seeds,
            good=self.good,
            rounds=self.rounds,
        )
        check_positive(draws=self.draws)

    @torch.no_grad()
    def __call__(
        self,
        names: Sequence[str],
        K: Float64[Tensor, "V 3 3"],
        key_points: Float[Tensor, "T V J 2"],
        confidence: Float[Tensor, "T V J"],
        valid: Bool[Tensor, "T V J"],
        sizes: Int[Tensor, "V 2"] | None,
        seed: int,
        frame: Int[Tensor, " T"] | None = None,
        person: Int[Tensor, " T"] | None = None,
        skeleton: Skeleton = HUMAN36M,
        lenses: LensErrors | None = None,
    ) -> RigEstimate:
        """Calibrate; ``key_points`` are undistorted pixels of the ``skeleton``. Never raises on
        values: what is wrong is among the findings. Raises GhptDataError for fewer than two
        cameras, a name that occurs twice, or arrays that do not belong together.

        ``frame`` and ``person``: the numbers of each row's, where there are several people; frames
        rise. ``lenses``: what is not known of the intrinsics; it adds to the ±.
        """
        _check(names, K, key_points)
        if frame is None:
            frame = torch.arange(len(key_points))
        if person is None:
            person = torch.zeros_like(frame)
        mask = usable(K, key_points, valid)
        apart = spread_key_points(key_points, mask, self.spacing)
        most = max(self.observations // max(mask.shape[1] * len(apart), 1), 1)
        joints, joints_valid = joints_of(skeleton, key_points, mask)
        used = key_points[:, :, apart]
        mask = mask[:, :, apart]
        if len(person):
            most = min(most, self.frames * (int(person.max()) + 1))
        frames = choose_frames(used, confidence[:, :, apart], mask, most)
        numbers = (frame[frames], person[frames])
        observed = observe(K, used[frames], mask[frames], self.noise, *numbers)
        table = self.pairs(observed, seed)
        rig = self.begin(observed, table, seed)
        adjusted = None
        if rig is not None:
            observed, adjusted = self.refine(observed, table, rig, seed)
        shown = self.joints(K, joints[frames], joints_valid[frames], adjusted, seed)
        spread = None
        evidence = None
        if adjusted is not None:
            facing = turning(shown.points, shown.estimated)
            used = frame[frames].unique()
            height = float(stature(shown.points, shown.estimated)) or 1.0
            errors = ErrorModel.of(observed, adjusted.rig, used, facing.axes, height)
            lasting = persistence(observed, adjusted.rig)
            scale = self.bundle.loss_scale
            spread = uncertainty(errors, adjusted.rig, scale, self.draws, lenses)
            evidence = Evidence(
                frames=len(frame.unique()),
                used=observed.frames,
                independent=lasting.independent,
                turned_deg=facing.degrees,
                rotation_sd_deg=float(rotation_std_deg(blocks_of(spread.covariance)).max()),
                lasting=spread.lasting,
            )
        case = Case(
            names=tuple(names),
            K=K,
            key_points=joints,
            valid=joints_valid,
            sizes=sizes,
            frames=frames,
            observed=observed,
            joints=shown,
            table=table,
            adjusted=adjusted,
            evidence=evidence,
            resection=self.resection,
            noise=self.noise,
            seed=seed,
        )
        return self._estimate(case, spread)

    def joints(
        self,
        K: Float64[Tensor, "V 3 3"],
        joints: Float[Tensor, "R V 17 2"],
        valid: Bool[Tensor, "R V 17"],
        adjusted: Adjusted | None,
        seed: int,
    ) -> Joints:
        """Return the 17 joints that the adjusted rig shows; none without one."""
        rows = len(joints)
        if adjusted is None:
            nothing = torch.zeros(rows, 17, dtype=torch.bool)
            return Joints(torch.zeros(rows, 17, 3, dtype=torch.float64), nothing)
        observed = observe(K, joints, valid, self.noise)
        rig = replace(adjusted.rig, points=adjusted.rig.points[:0], inlier=observed.valid)
        rig = self.resection.triangulate(observed, rig, seed)
        estimated = rig.inlier.any(0).unflatten(0, (rows, 17))
        points = rig.points.unflatten(0, (rows, 17))
        return Joints(torch.where(estimated[..., None], points, 0.0), estimated)

    def begin(self, observed: Correspondences, table: PairTable, seed: int) -> PlacedRig | None:
        """The first rig, from the seed with the most views and the largest share of inliers; None
        without a pair.
        """
        best = None
        merit = (-1, -1.0)
        order = torch.sort(
            torch.where(table.linked, table.expected, torch.inf), stable=True
        ).indices
        linked = int(torch.isin(torch.arange(len(observed.valid)), table.views[table.linked]).sum())
        for edge in order[: min(self.seeds, int(table.linked.sum()))].tolist():
            rig = self.resection.begin(observed, table, edge, seed)
            rig = self.resection.grow(observed, table, rig, seed)
            share = rig.inlier.sum() / (observed.valid & rig.placed[:, None]).sum().clamp(min=1)
            if (int(rig.placed.sum()), float(share)) > merit:
                best = rig
                merit = (int(rig.placed.sum()), float(share))
            if merit[0] == linked and merit[1] >= self.good:
                break
        return best

    def refine(
        self, observed: Correspondences, table: PairTable, rig: PlacedRig, seed: int
    ) -> tuple[Correspondences, Adjusted]:
        """Bundle adjustments in turn with new weights and new points; the last result is not
        touched any more.
        """
        rough = replace(self.bundle, tolerance=max(self.bundle.tolerance, _ROUGH))
        adjusted = (self.bundle if self.rounds == 1 else rough)(observed, rig)
        for left in range(self.rounds - 1, 0, -1):
            error = observed.error(adjusted.rig.R, adjusted.rig.t, adjusted.rig.points)
            observed = reweight(observed, error, adjusted.rig.inlier)
            rig = self.resection.triangulate(observed, unitise(adjusted.rig), seed)
            rig = self.resection.grow(observed, table, self.resection.keep_supported(rig), seed)
            adjusted = (self.bundle if left == 1 else rough)(observed, rig)
        adjusted = replace(adjusted, rig=unitise(adjusted.rig))
        final = self.bundle.state(observed, adjusted.rig)
        return observed, replace(adjusted, final=final)

    def _estimate(self, case: Case, spread: Uncertainty | None) -> RigEstimate:
        views = len(case.names)
        eye = torch.eye(3, dtype=torch.float64).repeat(views, 1, 1)
        rig = case.rig or PlacedRig(
            eye,
            torch.zeros(views, 3, dtype=torch.float64),
            torch.zeros(views, dtype=torch.bool),
            torch.zeros(len(case.observed.frame), 3, dtype=torch.float64),
            torch.zeros_like(case.observed.valid),
        )
        placed = rig.placed
        nothing = torch.zeros(views, dtype=torch.float64)
        reprojection, inliers = case.agreement(rig) if placed.any() else (nothing, nothing)
        return RigEstimate(
            names=case.names,
            cameras=Cameras(
                case.K.double(),
                torch.where(placed[:, None, None], rig.R, eye),
                torch.where(placed[:, None], rig.t, 0.0),
            ),
            calibrated=placed,
            joint_covariance=torch.zeros(6 * views, 6 * views, dtype=torch.float64)
            if spread is None
            else spread.covariance,
            reprojection=reprojection,
            inliers=inliers,
            pairs=case.table,
            frames=case.frames,
            points=case.joints.points,
            estimated=case.joints.estimated,
            converged=case.adjusted is not None and case.adjusted.converged,
            iterations=0 if case.adjusted is None else case.adjusted.iterations,
            evidence=case.evidence,
            findings=self.diagnostics(case, spread),
        )


def unitise(rig: PlacedRig) -> PlacedRig:
    """The rig in the frame of its first placed view, with the size 1."""
    views = torch.nonzero(rig.placed)[:, 0]
    centre = rig.centre
    size = (centre[views] - centre[views].mean(0)).square().sum(-1).mean().sqrt()
    size = torch.where((size > 0) & torch.isfinite(size), size, 1.0)
    first = views[0]
    R = torch.where(rig.placed[:, None, None], rig.R @ rig.R[first].T, rig.R)
    centre = (centre - centre[first]) @ rig.R[first].T / size
    t = torch.where(rig.placed[:, None], -(R @ centre[..., None])[..., 0], rig.t)
    known = rig.inlier.any(0)[:, None]
    points = torch.where(known, (rig.points @ rig.R[first].T + rig.t[first]) / size, 0.0)
    return replace(rig, R=R, t=t, points=points)


def _check(names: Sequence[str], K: Tensor, key_points: Tensor) -> None:
    hint = "Give each camera once, with its intrinsics and its key points."
    if len(names) < 2:
        raise GhptDataError("rig", "cameras", f"{len(names)} given, a rig has two or more", hint)
    if twice := [name for name in names if list(names).count(name) > 1]:
        raise GhptDataError("rig", "cameras", f"{twice[0]!r} occurs twice", hint)
    if not len(names) == len(K) == key_points.shape[1]:
        count = (
            f"{len(names)} names, {len(K)} intrinsics, key points of {key_points.shape[1]} cameras"
        )
        raise GhptDataError("rig", "cameras", count, hint)
