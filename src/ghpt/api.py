"""The public face: NumPy or torch arrays in, NumPy arrays out, with the defaults of the commands.

Key points are pixels as a detector gives them, [T V J 2] for T frames, V views and J joints; NaN is
a missing key point. Cameras are what `read_cameras` returns, or the three arrays K [V 3 3], R
[V 3 3] and t [V 3] of ideal pinholes, world to camera, mm. Defaults are those of the packaged
configuration: nothing here has numbers of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from ghpt.arrays import (
    ARRAYS,
    Array,
    CamerasLike,
    as_camera_set,
    as_detections,
    as_key_points,
    as_tensor,
)
from ghpt.commands.overrides import Source, compose
from ghpt.config import CONF, build, plain, settings
from ghpt.data.people.detections import Detections
from ghpt.data.people.persons import detector_sequence, person_sequence
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptConfigError, GhptDataError, check
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import undistort
from ghpt.metrics.pose_error import Kind, joint_errors
from ghpt.metrics.relative_pose import (
    quaternion_error,
    rotation_deg,
    translation_deg,
    translation_error,
)
from ghpt.observations import Observations, PoseEstimate, Truth
from ghpt.reconstruction import About, Reconstruction, State
from ghpt.skeleton import JOINTS

if TYPE_CHECKING:
    from ghpt.calibration.findings import Finding
    from ghpt.commands.prediction.settings import PredictSettings
    from ghpt.models.estimators.predictors import Classical, FrameSource
    from ghpt.models.estimators.predictors import Predictor as FittablePredictor

Rows = Int[np.ndarray, " N"]


@dataclass(frozen=True)
class Poses:
    """T frames of J joints, found in V views; NaN where a joint has no position."""

    about: About
    """The names of joints and views, the rate, and what made them."""
    reconstruction: Reconstruction
    """The same as tensors, with covariances; see `ghpt.reconstruction.Reconstruction`."""
    cameras: CameraSet | None = None
    """The V views, which html and rrd show; None where they are not known."""

    def __len__(self) -> int:
        return len(self.reconstruction)

    @property
    def points(self) -> Float[np.ndarray, "T J 3"]:
        """World, mm, float64."""
        return _with_nan(self.reconstruction.points, self.reconstruction.has_position)

    @property
    def error(self) -> Float[np.ndarray, "T J"]:
        """Root mean square reprojection error over the views that made the joint, pixels."""
        return _with_nan(self.reconstruction.error, self.reconstruction.has_position)

    @property
    def state(self) -> Int8[np.ndarray, "T J"]:
        """Values of `ghpt.reconstruction.State`: 0 is observed, others say why there is nothing."""
        return self.reconstruction.state.numpy()

    @property
    def views(self) -> Bool[np.ndarray, "T V J"]:
        """The views that made each joint."""
        return self.reconstruction.views.numpy()

    @property
    def frame(self) -> Int[np.ndarray, " T"]:
        """The recording's own frame numbers."""
        return self.reconstruction.frame.numpy()


@dataclass(frozen=True)
class RelativePoseErrors:
    """Errors of N relative poses of cameras."""

    rotation_deg: Float[np.ndarray, "*N"]
    """Angle between the rotations, in [0, 180]."""
    quaternion: Float[np.ndarray, "*N"]
    """The paper's E_R, the distance of the unit quaternions."""
    translation_mm: Float[np.ndarray, "*N"]
    """The paper's E_t, the distance of the translations."""
    translation_deg: Float[np.ndarray, "*N"]
    """Angle between the directions of the translations, in [0, 180]."""


def triangulate(key_points: Array, cameras: CamerasLike, confidence: Array | None = None) -> Poses:
    """Return the points [T J 3] that key points [T V J 2] of any J joints show, robustly.

    The estimator is predict.py's classical one, without what takes a known skeleton (the search for
    exchanged sides). A missing or wrong key point costs its joint that view alone; a joint that
    fewer than two views see, or that no two views agree on, is NaN, and ``state`` says why.
    ``confidence`` [T V J] is in [0, 1]; a key point of confidence 0 is missing. Raises
    GhptDataError for shapes that do not fit, and for cameras without extrinsics.
    """
    rig = as_camera_set(cameras)
    points = as_key_points(key_points, confidence, len(rig))
    names = tuple(f"joint_{joint}" for joint in range(points.valid.shape[-1]))
    defaults = _defaults("predict")
    name = "adaptive_ransac"
    group = defaults["predictor"]["classical"] | {"flips": None}
    baseline = build(defaults["baselines"][name], f"baselines.{name}")
    predictor: Classical = build(group, "predictor.classical")(estimator=baseline)
    observations = _observe(points, rig)
    source = _ArraySource(np.arange(len(points)), None, observations)
    part = _estimate(predictor, source, defaults["fitted_frames"], defaults["batch"])
    return Poses(_about(name, names, rig.names, None), part, rig)


class Predictor:
    """Predicts 3D poses as predict.py does: robustly, with exchanged sides undone.

    Without a checkpoint the estimator is classical; with one that train.py wrote it is the trained
    model. ``changes`` are settings of conf/predict.yaml, such as ``estimator="linear"`` or
    ``hypotheses=100``; ``trust`` names packages of your own whose classes the checkpoint uses.
    Raises GhptCheckpointError and GhptConfigError.
    """

    def __init__(
        self, checkpoint: str | Path | None = None, trust: Sequence[str] = (), **changes: Any
    ) -> None:
        from ghpt.commands.prediction.estimator import build_estimator

        path = None if checkpoint is None else str(checkpoint)
        self.settings = default_settings(ckpt=path, trust=list(trust), **changes)
        self.estimator = build_estimator(self.settings)

    def __call__(
        self,
        key_points: Array | Detections,
        cameras: CamerasLike,
        confidence: Array | None = None,
        rate_hz: int | float | None = None,
    ) -> Poses:
        """Return the poses of one person in millimetres, in the world of the cameras.

        ``key_points`` are what `read_key_points` returns, or [T V 17 2] in the order of
        `ghpt.skeleton.JOINTS`, with the views in the order of the cameras. The joints are all that
        the detector gives and the 17, or with ``joints="human36m"`` these alone. Raises
        GhptDataError.
        """
        from ghpt.commands.inputs import resolve_unit
        from ghpt.commands.prediction.sequences import joints_of, needed_key_points

        rig = as_camera_set(cameras)
        people = as_detections(key_points, rig, confidence, rate_hz)
        wanted = self.settings
        person = wanted.person or 0
        sequence = detector_sequence(people, rig, wanted.match, wanted.views, person)
        sequence = needed_key_points(wanted, sequence)
        sequence.cameras.check_calibrated(sequence.source)
        sequence = resolve_unit(
            sequence, build(wanted.camera_check, "camera_check").consensus, ask=True
        )
        predictor = self.estimator.predictor.for_skeleton(sequence.skeleton)
        part = _estimate(predictor, sequence, wanted.fitted_frames, wanted.batch)
        joints = joints_of(wanted, sequence.skeleton)
        names = sequence.cameras.names
        about = _about(self.estimator.name, joints.joints, names, sequence.rate_hz)
        x, y, z = sequence.origin.tolist()
        about = replace(about, origin=(x, y, z), bones=joints.bones)
        return Poses(about, joints(sequence.to_world(part)), sequence.cameras)

    def stream(
        self, frames: Iterable[Array], cameras: CamerasLike, rate_hz: int | float | None = None
    ) -> Iterator[Poses]:
        """Yield the pose of each frame as soon as its lag is over, while ``frames`` come.

        It takes ``estimator="online"``; ``lag=0.1`` is in seconds. Each of ``frames`` has the key
        points of one person's 17 joints in a frame, [V 17 2], or of a few frames, [T V 17 2]; NaN
        is missing, and a third coordinate is the confidence. The poses are those of `__call__` on
        all frames, in millimetres, in the world of the cameras. Raises GhptConfigError for another
        estimator, GhptDataError for wrong shapes.
        """
        from ghpt.models.estimators.trajectory.online import as_reconstruction
        from ghpt.models.estimators.trajectory.online_predictor import OnlinePredictor
        from ghpt.models.estimators.trajectory.sightings import frames_of

        predictor = self.estimator.predictor
        if not isinstance(predictor, OnlinePredictor):
            problem = f"is {self.estimator.name!r}, which needs all frames"
            raise GhptConfigError("estimator", problem, 'Use Predictor(estimator="online").')
        rig = as_camera_set(cameras)
        rig.check_calibrated("cameras")
        about = _about(self.estimator.name, JOINTS, rig.names, rate_hz and float(rate_hz))
        online = predictor.stream(rate_hz)
        has_lens = bool(rig.distortion.any())
        number = 0
        for values in frames:
            points = _frames_of_joints(values, len(rig))
            batch = _observe(points, rig, has_lens)
            batch = replace(batch, index=batch.index + number)
            number += len(points)
            for frame in frames_of(batch):
                for found in online.push(frame):
                    yield Poses(about, as_reconstruction([found]), rig)
        for found in online.finish():
            yield Poses(about, as_reconstruction([found]), rig)


def calibrate_rig(
    key_points: Array | Detections,
    cameras: CamerasLike | Array,
    height: int | float | None = None,
    confidence: Array | None = None,
    **changes: Any,
) -> tuple[CameraSet, tuple[Finding, ...]]:
    """Return the cameras that can be used, calibrated from the person in view, and what is wrong.

    ``cameras`` have known lenses, or are the intrinsics K [V 3 3] alone; extrinsics that they have
    only fix the world. ``height`` (mm) of the person gives the length; without it an average one is
    taken, and a finding says so. ``changes`` are settings of conf/calibrate.yaml. Raises
    GhptDataError where no rig can be found.
    """
    from ghpt.calibration.millimetres import read_scale
    from ghpt.commands.calibration.case import Case
    from ghpt.commands.calibration.settings import CalibrateSettings
    from ghpt.commands.calibration.solution import solve_rig

    defaults = _defaults("calibrate")
    scale = defaults["scale"] | {"height": height}
    wanted = settings(CalibrateSettings, defaults | {"scale": scale} | changes)
    rig = as_camera_set(cameras)
    rig = rig.without_extrinsics() if rig.unposed else rig
    people = as_detections(key_points, rig, confidence)
    people.skeleton.require_joints(people.path)
    evidence = detector_sequence(people, rig, wanted.match, wanted.views, person=None)
    sequence = evidence.as_joints()
    case = Case(sequence, evidence, "the given calibration", is_own=True)
    calibration = build(wanted.calibration, "calibration")
    name = wanted.estimator
    estimator = build(wanted.baselines[name], f"baselines.{name}")
    source = read_scale(wanted.scale, sequence.cameras.names)
    solution = solve_rig(case, calibration, estimator, source, wanted.seed)
    findings = solution.findings
    if not solution.usable:
        problem = findings[0].text if findings else "no two cameras can be calibrated"
        raise GhptDataError(people.path, "calibration", problem, "Record more, or other, motion.")
    usable = sequence.cameras.select(solution.usable)
    return usable.with_cameras(solution.rig.index(solution.usable)), findings


def check_cameras(
    key_points: Array | Detections, cameras: CamerasLike, confidence: Array | None = None
) -> tuple[Finding, ...]:
    """Return what is wrong with calibrated cameras, as the person in view shows it.

    Each finding has a code, the cameras it is about and a text; there are none where nothing is
    wrong. Raises GhptDataError for key points that cannot tell.
    """
    from ghpt.calibration.check.evidence import gather
    from ghpt.calibration.check.setup import setup_of

    check_of = build(_defaults("cameras")["camera_check"], "camera_check")
    rig = as_camera_set(cameras)
    people = as_detections(key_points, rig, confidence)
    sequence = person_sequence(people, rig, person=None, check_sizes=False)
    evidence = gather(sequence, check_of.frames, check_of.shift)
    findings: tuple[Finding, ...] = check_of(evidence, setup_of(sequence.cameras)).findings
    return findings


def write_poses(path: str | Path, poses: Poses | Array, rate_hz: int | float | None = None) -> None:
    """Write poses into a file of the format that its suffix names.

    Formats are npz, csv, parquet, trc, c3d, html and rrd (rerun). ``poses`` may be points [T J 3]
    (mm; NaN is missing); 17 joints are named as `ghpt.skeleton.JOINTS`. ``rate_hz`` is of the
    frames, which trc and c3d need. html and rrd show the cameras that ``poses`` has. Raises
    GhptConfigError for an unknown suffix and for what the format lacks, GhptDataError for what it
    cannot hold.
    """
    from ghpt.export import WRITERS, Scene

    writers = {Path(writer.file).suffix: writer for writer in WRITERS.values()}
    suffix = Path(path).suffix
    check(suffix in writers, str(path), f"has the suffix {suffix!r}", f"Use {', '.join(writers)}.")
    whole = poses if isinstance(poses, Poses) else _poses_of(poses)
    about = whole.about if rate_hz is None else replace(whole.about, rate_hz=float(rate_hz))
    writer = writers[suffix]
    scene = {} if whole.cameras is None else {"scene": Scene(whole.cameras.cameras)}
    shown = scene if writer.pictures else {}
    writer.write(Path(path), about, lambda: iter([whole.reconstruction]), **shown)


def mpjpe(estimate: Array, truth: Array, kind: Kind = "absolute") -> float:
    """Return the mean per-joint position error of poses [*T 17 3], in their unit.

    It is the mean over all joints that both have (NaN is missing), and NaN if there are none.
    ``kind``: ``absolute`` in the world, ``relative`` to the pelvis, or ``aligned`` by the best
    similarity of each frame.
    """
    points = as_tensor(estimate)
    true_points = as_tensor(truth)
    found = PoseEstimate(points.nan_to_num(0.0), torch.isfinite(points).all(-1))
    known = Truth(true_points.nan_to_num(0.0), torch.isfinite(true_points).all(-1))
    errors, counted = joint_errors(found, known, kind)
    return float(errors.sum() / counted.sum())


def relative_pose_errors(R: Array, t: Array, true_R: Array, true_t: Array) -> RelativePoseErrors:
    """Return the errors of relative poses ``x_b = R x_a + t``: rotations [*N 3 3], mm [*N 3]."""
    rotation = as_tensor(R)
    true_rotation = as_tensor(true_R)
    translation = as_tensor(t)
    true_translation = as_tensor(true_t)
    return RelativePoseErrors(
        rotation_deg=rotation_deg(rotation, true_rotation).numpy(),
        quaternion=quaternion_error(rotation, true_rotation).numpy(),
        translation_mm=translation_error(translation, true_translation).numpy(),
        translation_deg=translation_deg(translation, true_translation).numpy(),
    )


@functools.cache
def _defaults(command: str) -> dict[str, Any]:
    """Return the packaged settings of a command."""
    values: dict[str, Any] = plain(compose(Source(CONF, command), ["output=''"]))
    return values


@dataclass(frozen=True)
class _ArraySource:
    """Observations in memory, as a recording whose frames are read."""

    frame: Rows
    rate_hz: float | None
    observations: Observations

    def read(self, rows: Rows) -> Observations:
        return self.observations.rows(torch.from_numpy(rows))


def default_settings(**changes: Any) -> PredictSettings:
    """Return the settings of conf/predict.yaml with some changed."""
    from ghpt.commands.prediction.settings import PredictSettings

    return settings(PredictSettings, _defaults("predict") | changes)


def _estimate(
    predictor: FittablePredictor, source: FrameSource, fitted_frames: int, batch: int
) -> Reconstruction:
    """Return what the predictor makes of all frames."""
    fitted = predictor.fit(source, fitted_frames)
    rows = np.arange(len(source.frame))
    return fitted.predict(source, rows, batch, torch.device("cpu"), lambda frames: None)


def _observe(points: KeyPoints, rig: CameraSet, has_lens: bool = True) -> Observations:
    """Return observations of ideal pinholes, without what the lens cannot show.

    ``has_lens``: False where the rig is known to be of ideal pinholes, which saves time.
    """
    pixels = torch.from_numpy(points.pixels)
    frames, views, joints, _ = pixels.shape
    by_view = pixels.transpose(0, 1).reshape(views, frames * joints, 2)
    ideal = by_view
    possible = torch.ones(by_view.shape[:-1], dtype=torch.bool)
    if has_lens:
        ideal, possible = undistort(by_view, rig.K, rig.distortion)
    shape = (views, frames, joints)
    return Observations(
        index=torch.arange(frames),
        recording=torch.zeros(frames, dtype=torch.int64),
        cameras=rig.cameras.to(torch.float64).expand(frames),
        key_points=ideal.reshape(*shape, 2).transpose(0, 1).contiguous(),
        confidence=torch.from_numpy(points.confidence),
        valid=torch.from_numpy(points.valid) & possible.reshape(shape).transpose(0, 1),
    )


def _frames_of_joints(values: Array, views: int) -> KeyPoints:
    """Return the key points of one frame or a few; a third coordinate is the confidence."""
    numbers = as_tensor(values)
    frames = numbers[None] if numbers.ndim == 3 else numbers
    if frames.ndim != 4 or frames.shape[2] != len(JOINTS) or frames.shape[3] not in (2, 3):
        problem = f"has the shape {list(numbers.shape)}"
        hint = f"Give [{views} {len(JOINTS)} 2], or [T {views} {len(JOINTS)} 2]."
        raise GhptDataError("frames", "", problem, hint)
    confidence = frames[..., 2] if frames.shape[3] == 3 else None
    return as_key_points(frames[..., :2], confidence, views)


def _poses_of(points: Array) -> Poses:
    """Return points [T J 3] as poses of which no more is known."""
    values = as_tensor(points)
    if values.ndim != 3 or values.shape[-1] != 3:
        problem = f"has the shape {list(values.shape)}"
        raise GhptDataError("poses", "", problem, "Give [T J 3].")
    frames, joints, _ = values.shape
    there = torch.isfinite(values).all(-1)
    state = torch.where(there, int(State.OBSERVED), int(State.FEW_VIEWS)).to(torch.int8)
    names = JOINTS if joints == len(JOINTS) else tuple(f"joint_{j}" for j in range(joints))
    part = Reconstruction(
        frame=torch.arange(frames),
        points=torch.where(there[..., None], values, 0.0),
        state=state,
        error=torch.zeros(frames, joints),
        views=torch.zeros(frames, 0, joints, dtype=torch.bool),
        covariance=torch.zeros(frames, joints, 6),
        score=torch.zeros(frames),
        flipped=torch.zeros(frames, 0, dtype=torch.bool),
    )
    return Poses(_about("unknown", names, (), None), part)


def _about(
    estimator: str, joints: tuple[str, ...], views: tuple[str, ...], rate_hz: float | None
) -> About:
    return About(
        name=ARRAYS,
        source=ARRAYS,
        estimator=estimator,
        joints=joints,
        camera_names=views,
        rate_hz=rate_hz,
        smoothed=False,
        provenance={},
    )


def _with_nan(values: Tensor, there: Bool[Tensor, "T J"]) -> np.ndarray:
    mask = there.reshape(*there.shape, *[1] * (values.ndim - there.ndim))
    return torch.where(mask, values, torch.nan).numpy()
