"""A model of a 2D key-point detector: what it would detect of a moving body through real lenses.

Every error persists over time and knows the body: joints are defined a little differently than in
the truth, pixel noise grows with the person in the image, what the body hides is found worse, left
and right are exchanged, and key points jump away or are missed for a while. All lengths are
fractions of the person's stature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path
from scipy.special import expit, ndtr
from torch import Tensor

from ghpt.data.synthetic.body import occlusion, stature, trunk_frame
from ghpt.data.synthetic.random_processes import gaussian_process, generator
from ghpt.geometry import lens
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import BONES, JOINT, JOINTS, MIRROR, PELVIS


def _pairs(*names: str) -> tuple[tuple[int, int], ...]:
    return tuple((JOINT[f"right_{name}"], JOINT[f"left_{name}"]) for name in names)


FLIPPED_TOGETHER = (_pairs("hip", "knee", "ankle"), _pairs("shoulder", "elbow", "wrist"))
"""The pairs of joints whose left and right are exchanged together: legs, arms."""

KINDS = tuple(name.removeprefix("right_").removeprefix("left_") for name in JOINTS)
"""The joints without their sides."""


def _limb_joints() -> tuple[list[int], list[int]]:
    """Return the joints of arms and legs, and the joint that each hangs on."""
    parent = {a: b for a, b in BONES if KINDS[a] in ("ankle", "knee", "hip")}
    parent |= {b: a for a, b in BONES if KINDS[b] in ("elbow", "wrist", "shoulder")}
    return list(parent), list(parent.values())


_LIMB_JOINTS, _LIMB_PARENTS = _limb_joints()


@dataclass(frozen=True)
class SimulatedDetections:
    """What one detector says about T frames in V views."""

    key_points: Float[np.ndarray, "T V J 2"]
    """Undistorted pixels, float32; 0 where not valid."""
    confidence: Float[np.ndarray, "T V J"]
    valid: Bool[np.ndarray, "T V J"]


@dataclass(frozen=True)
class ViewDetections:
    """The same of one view."""

    key_points: Float[np.ndarray, "T J 2"]
    confidence: Float[np.ndarray, "T J"]
    valid: Bool[np.ndarray, "T J"]


@dataclass(frozen=True)
class Processes:
    """Unit Gaussian processes in time that one camera's errors are made of."""

    noise: Float[np.ndarray, "T J 2"]
    outlier: Float[np.ndarray, "T J"]
    direction: Float[np.ndarray, "T J 2"]
    flip: Float[np.ndarray, "T G"]
    miss: Float[np.ndarray, "T J"]
    confidence: Float[np.ndarray, "T J"]
    hardness: Float[np.ndarray, "T J"]
    """How hard the joint is to find at the time."""

    def subsample(self, stride: int) -> Processes:
        """Return the same processes at every ``stride``-th frame."""
        sampled = {name: value[::stride] for name, value in vars(self).items()}
        return Processes(**sampled)


def _bones_apart() -> Float[np.ndarray, "J J"]:
    """Return how many bones lie between each two joints."""
    ends = np.array(BONES).T
    graph = coo_array((np.ones(len(BONES)), ends), shape=(len(JOINTS), len(JOINTS)))
    return shortest_path(graph, directed=False, unweighted=True)


_BONES_APART = _bones_apart()

_WAVES = 64
"""Waves that a random function of a direction is the sum of."""
_UNBIASED = np.zeros((1, 1, 2))


@dataclass(frozen=True)
class DirectionBias:
    """Random functions of the direction from which a body is seen, of unit variance: one for each
    joint and image coordinate.

    They are sums of waves over the unit sphere (random Fourier features), which forget within the
    angle that their frequencies say.
    """

    frequency: Float[np.ndarray, "W 3"]
    phase: Float[np.ndarray, " W"]
    amplitude: Float[np.ndarray, "W J 2"]

    @classmethod
    def draw(cls, rng: np.random.Generator, degrees: float) -> DirectionBias:
        """Draw functions whose correlation is exp(-1/2) at directions ``degrees`` apart."""
        distance = 2.0 * np.sin(np.deg2rad(degrees) / 2.0)
        frequency = rng.normal(size=(_WAVES, 3)) / distance
        phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        return cls(frequency, phase, rng.normal(size=(_WAVES, len(JOINTS), 2)))

    def __call__(self, direction: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T J 2"]:
        """Return the functions' values at unit vectors."""
        waves = np.cos(direction @ self.frequency.T + self.phase)
        return np.sqrt(2.0 / _WAVES) * np.tensordot(waves, self.amplitude, axes=1)


@dataclass(frozen=True)
class BodyError:
    """What all views share of a take's errors, before it is scaled."""

    bias: Float[np.ndarray, "J 4"]
    """Difference between the detector's and the truth's definition of each joint: along the limb,
    and forward, left and up in the trunk's frame.
    """
    drift: Float[np.ndarray, "T J 3"]
    """Slow error in the world's frame."""


@dataclass(frozen=True)
class _Projection:
    """One camera's image of a take, before the detector errs."""

    in_camera: Float[np.ndarray, "T J 3"]
    """True joints in the camera's frame, mm."""
    stature: float
    """mm."""
    stature_pixels: Float[np.ndarray, "T 1"]
    """The person's stature in the image."""
    hidden: Float[np.ndarray, "T J"]
    """How far the body hides each joint, 0 to 1."""
    ideal: Float[np.ndarray, "T J 2"]
    """Pixels of the joints by the detector's definition in a pinhole camera."""
    raw: Float[np.ndarray, "T J 2"]
    """The same through the lens."""
    in_front: Bool[np.ndarray, "T J"]


@dataclass(frozen=True)
class Detector:
    """The detector's numbers: lengths in statures, rates as a share of the time, durations in
    seconds.
    """

    noise: float
    """Standard deviation of a pixel coordinate of an average joint."""
    noise_seconds: float
    noise_white: float
    """Share of the noise's variance that is new in every frame."""
    noise_slow: float
    """Share of the noise's variance that lasts for ``noise_slow_seconds`` instead of
    ``noise_seconds``.
    """
    noise_slow_seconds: float
    neighbours: float
    """Correlation of the noise and of the view bias of joints that a bone connects; its n-th power
    where n bones do.
    """
    noise_spread: float
    """Standard deviation of the logarithm of the noise's size, which lasts for
    ``noise_slow_seconds``: the noise's tails are the heavier for it.
    """
    joints: Mapping[str, float]
    """Noise and outlier rate of ``ankle``, ``knee``, ... relative to the average joint's."""
    bias: float
    """Size of the difference between the detector's and the truth's definition of a joint, in the
    body's frame.
    """
    bias_seed: int
    """Which definition: the same for everybody, mirrored on the other side."""
    bias_of_subject: float
    """Share of the bias' variance that differs between people."""
    view_bias: float
    """Standard deviation of a pixel coordinate's bias that depends on the direction from which the
    body is seen: it lasts as long as the person does not turn, and differs between views.
    """
    view_bias_degrees: float
    """Turn of the body within which that bias is forgotten."""
    drift: float
    """Size of the slow 3D error that all views share: clothes, the body's shape."""
    drift_seconds: float
    occluded_noise: float
    """How much larger the noise of a joint is that the body hides."""
    outlier_rate: float
    outlier_rate_occluded: float
    outlier_size: float
    outlier_seconds: float
    swap_rate: float
    swap_seconds: float
    swap_together: float
    """Correlation of the exchange of the legs with that of the arms."""
    miss_rate: float
    miss_rate_occluded: float
    miss_seconds: float
    confidence_typical: float
    """Logit of the confidence at an error of typical size."""
    confidence_slope: float
    """Change of the confidence's logit when the error grows e-fold (or by chance)."""
    confidence_knowledge: float
    """Correlation of the confidence's logit with the error's logarithm, for one joint."""
    familiar: float
    """Scale of noise, outliers and bias for people that the detector was trained on."""

    def __call__(
        self,
        points: Float[np.ndarray, "T J 3"],
        rig: CameraSet,
        rate_hz: float,
        seed: int,
        subject: str,
        take: str,
        familiar: bool = False,
    ) -> SimulatedDetections:
        """Detect a take (world, mm) in every view of the rig.

        A view's detections depend on the seed, the subject, the take and the camera's name, not on
        the other views. Joints whose truth is unknown must hold finite numbers; mask them
        afterwards.
        """
        frames = len(points)
        body_error = self.draw_body_error(frames, rate_hz, seed, subject, take)
        apparent = self.displace_joints(points, body_error, familiar)
        views = []
        for view, name in enumerate(rig.names):
            camera_rng = generator(seed, "camera", take, name)
            processes = self.draw_processes(frames, rate_hz, camera_rng)
            bias = self.draw_view_bias(points, rig, view, seed, subject)
            views.append(self.detect_view(points, apparent, rig, view, processes, familiar, bias))
        return SimulatedDetections(
            key_points=np.stack([view.key_points for view in views], axis=1),
            confidence=np.stack([view.confidence for view in views], axis=1),
            valid=np.stack([view.valid for view in views], axis=1),
        )

    def draw_body_error(
        self,
        frames: int,
        rate_hz: float,
        seed: int,
        subject: str,
        take: str,
    ) -> BodyError:
        """Draw the bias of the joints' definition and the drift of a take, both of unit size."""
        shape = (len(JOINTS), 4)
        common = _mirror_sides(generator(self.bias_seed, "joint definition").normal(size=shape))
        own = generator(seed, "subject", subject).normal(size=shape)
        common_share = np.sqrt(1.0 - self.bias_of_subject)
        own_share = np.sqrt(self.bias_of_subject)
        bias = common_share * common + own_share * own
        drift_rng = generator(seed, "drift", take)
        persistence = self.drift_seconds * rate_hz
        drift = gaussian_process(drift_rng, (len(JOINTS), 3), frames, persistence)
        return BodyError(bias / 2.0, drift / np.sqrt(3.0))

    def draw_view_bias(
        self,
        points: Float[np.ndarray, "T J 3"],
        rig: CameraSet,
        view: int,
        seed: int,
        subject: str,
    ) -> Float[np.ndarray, "#T #J 2"]:
        """Draw the bias of the direction from which a camera sees the body, of unit size.

        What everybody shares of it and what is the subject's own are in the proportion of ``bias``.
        """
        if not self.view_bias:
            return _UNBIASED
        centre = rig.cameras.centre[view].numpy()
        ray = centre - points[:, PELVIS]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True).clip(min=1e-9)
        direction = (ray[:, None] @ trunk_frame(points))[:, 0]
        common_rng = generator(self.bias_seed, "view bias")
        common = DirectionBias.draw(common_rng, self.view_bias_degrees)
        own_rng = generator(seed, "view bias", subject)
        own = DirectionBias.draw(own_rng, self.view_bias_degrees)
        common_share = np.sqrt(1.0 - self.bias_of_subject)
        own_share = np.sqrt(self.bias_of_subject)
        bias = common_share * common(direction) + own_share * own(direction)
        return self._share_with_neighbours(bias)

    def displace_joints(
        self,
        points: Float[np.ndarray, "T J 3"],
        error: BodyError,
        familiar: bool,
    ) -> Float[np.ndarray, "T J 3"]:
        """Return where the joints are by the detector's definition, the same for all views."""
        trunk = trunk_frame(points)
        offset = error.bias[:, 1:] @ trunk.mT
        limb = points[:, _LIMB_JOINTS] - points[:, _LIMB_PARENTS]
        limb /= np.linalg.norm(limb, axis=-1, keepdims=True).clip(min=1e-9)
        offset[:, _LIMB_JOINTS] += error.bias[_LIMB_JOINTS, :1] * limb
        scale = stature(points) * self._familiarity(familiar)
        return points + scale * (self.bias * offset + self.drift * error.drift)

    def _familiarity(self, familiar: bool) -> float:
        return self.familiar if familiar else 1.0

    def draw_processes(
        self,
        frames: int,
        rate_hz: float,
        rng: np.random.Generator,
    ) -> Processes:
        """Draw what one camera's errors of a take are made of."""
        joints = len(JOINTS)

        def draw(shape: tuple[int, ...], seconds: float) -> Float[np.ndarray, "T ..."]:
            return gaussian_process(rng, shape, frames, seconds * rate_hz)

        white = rng.standard_normal((frames, joints, 2), dtype=np.float32)
        quick = draw((joints, 2), self.noise_seconds)
        slow = draw((joints, 2), self.noise_slow_seconds)
        quick_share = 1.0 - self.noise_white - self.noise_slow
        variances = np.array([self.noise_white, quick_share, self.noise_slow])
        deviations = np.sqrt(variances).astype(np.float32)
        noise = deviations[0] * white + deviations[1] * quick + deviations[2] * slow
        processes = Processes(
            noise=self._share_with_neighbours(noise),
            outlier=draw((joints,), self.outlier_seconds),
            direction=draw((joints, 2), self.outlier_seconds),
            flip=draw((len(FLIPPED_TOGETHER),), self.swap_seconds),
            miss=draw((joints,), self.miss_seconds),
            confidence=draw((joints,), self.noise_seconds),
            hardness=np.zeros((frames, joints), dtype=np.float32),
        )
        # drawn last: what detectors without these numbers draw is as it was
        if self.noise_spread:
            hardness = draw((joints,), self.noise_slow_seconds)
            processes = replace(processes, hardness=hardness)
        if self.swap_together:
            both = draw((1,), self.swap_seconds)
            alone = np.sqrt(1.0 - self.swap_together) * processes.flip
            flip = np.sqrt(self.swap_together) * both + alone
            processes = replace(processes, flip=flip)
        return processes

    def _share_with_neighbours(
        self,
        independent: Float[np.ndarray, "T J 2"],
    ) -> Float[np.ndarray, "T J 2"]:
        """Return unit processes that neighbouring joints share of independent ones."""
        if not self.neighbours:
            return independent
        mixing = np.linalg.cholesky(self.neighbours**_BONES_APART)
        return mixing.astype(independent.dtype) @ independent

    def detect_view(
        self,
        points: Float[np.ndarray, "T J 3"],
        apparent: Float[np.ndarray, "T J 3"],
        rig: CameraSet,
        view: int,
        processes: Processes,
        familiar: bool,
        view_bias: Float[np.ndarray, "#T #J 2"] = _UNBIASED,
    ) -> ViewDetections:
        """Detect the key points of one camera; ``apparent`` is of ``displace_joints``,
        ``view_bias`` of ``draw_view_bias``.
        """
        projection = _project(points, apparent, rig, view)
        K = rig.K[view]
        distortion = rig.distortion[view]
        raw = projection.raw
        error = self._error(projection.hidden, processes) + self.view_bias * view_bias
        error = self._familiarity(familiar) * error
        flipped = self._flip(projection, processes)
        found = flipped + projection.stature_pixels[..., None] * error

        missing_rate = _rate(self.miss_rate, self.miss_rate_occluded, projection.hidden)
        found_at_all = ndtr(processes.miss) > missing_rate
        before_camera = projection.in_front & (projection.in_camera[..., 2] > 0.0)
        inside = _inside_image(found, rig.image_size[view].numpy())
        key_points, undistorted = _undistort(found, raw, projection.ideal, K, distortion)
        valid = inside & before_camera & found_at_all & undistorted
        size = np.linalg.norm(found - raw, axis=-1) / projection.stature_pixels
        confidence = self._confidence(size, processes)
        return ViewDetections(
            key_points=np.where(valid[..., None], key_points, 0.0).astype(np.float32),
            confidence=np.where(valid, confidence, 0.0).astype(np.float32),
            valid=valid,
        )

    def _error(
        self,
        hidden: Float[np.ndarray, "T J"],
        processes: Processes,
    ) -> Float[np.ndarray, "T J 2"]:
        """Return noise and outliers in statures."""
        relative = np.array([self.joints[kind] for kind in KINDS])
        occluded = 1.0 + (self.occluded_noise - 1.0) * hidden
        deviation = self.noise * occluded * relative
        # a log-normal size of mean square 1: the noise's variance does not depend on its spread
        size = np.exp(self.noise_spread * processes.hardness - self.noise_spread**2)
        noise = (size * deviation)[..., None] * processes.noise
        return noise + self._outliers(hidden, relative, processes)

    def _outliers(
        self,
        hidden: Float[np.ndarray, "T J"],
        relative: Float[np.ndarray, " J"],
        processes: Processes,
    ) -> Float[np.ndarray, "T J 2"]:
        """Return offsets while the process exceeds the quantile that the rate leaves.

        Their length is exponential, and continuous in time because it is a function of the excess.
        """
        rate = relative * _rate(self.outlier_rate, self.outlier_rate_occluded, hidden)
        rate = rate.clip(1e-6, 0.9)
        excess = (ndtr(processes.outlier) - (1.0 - rate)) / rate
        length = -self.outlier_size * np.log1p(-excess.clip(0.0, 1.0 - 1e-4))
        norm = np.linalg.norm(processes.direction, axis=-1, keepdims=True)
        direction = processes.direction / norm.clip(min=1e-6)
        return length[..., None] * direction

    def _flip(self, projection: _Projection, processes: Processes) -> Float[np.ndarray, "T J 2"]:
        """Exchange left and right of legs or arms: likelier from the side and from behind."""
        pixels = projection.raw.copy()
        in_camera = projection.in_camera
        for group, pairs in enumerate(FLIPPED_TOGETHER):
            right, left = pairs[0]
            across = in_camera[:, left] - in_camera[:, right]
            width = np.linalg.norm(across, axis=-1)
            facing = across[:, 0] / width.clip(min=1e-9)  # 1: to the camera, -1: away
            from_side = np.exp(-((facing / 0.35) ** 2))
            rate = self.swap_rate * (0.2 + 2.0 * from_side + 0.6 * (facing < 0))
            now = ndtr(processes.flip[:, group]) > 1.0 - rate
            for a, b in pairs:
                pixels[now, a] = projection.raw[now, b]
                pixels[now, b] = projection.raw[now, a]
        return pixels

    def _confidence(
        self,
        size: Float[np.ndarray, "T J"],
        processes: Processes,
    ) -> Float[np.ndarray, "T J"]:
        """Return the confidence of an error of this size, in statures."""
        log_size = np.log(size.clip(min=0.01 * self.noise) / (1.25 * self.noise))
        # 0.8: the deviation of the logarithm of an error's size, which chance is compared with
        chance = 0.8 * np.sqrt(1.0 / self.confidence_knowledge**2 - 1.0) * processes.confidence
        return expit(self.confidence_typical - self.confidence_slope * (log_size + chance))


def _project(
    points: Float[np.ndarray, "T J 3"],
    apparent: Float[np.ndarray, "T J 3"],
    rig: CameraSet,
    view: int,
) -> _Projection:
    """Project the true and the apparent joints of a take (world, mm) into one camera."""
    cameras = rig.cameras
    K = cameras.K[view].numpy()
    R = cameras.R[view].numpy()
    t = cameras.t[view].numpy()
    in_camera = (points @ R.T + t).astype(np.float32)
    person = stature(points)
    depth = in_camera[:, PELVIS, 2].clip(min=1.0)
    stature_pixels = np.sqrt(K[0, 0] * K[1, 1]) * person / depth
    target = apparent @ R.T + t
    in_front = target[..., 2] > 0.05 * person
    safe = np.where(in_front[..., None], target, [0.0, 0.0, 1.0])
    homogeneous = safe @ K.T
    ideal = homogeneous[..., :2] / safe[..., 2:]
    raw = _distort(torch.from_numpy(ideal), rig.K[view], rig.distortion[view])
    return _Projection(
        in_camera=in_camera,
        stature=person,
        stature_pixels=stature_pixels[:, None],
        hidden=occlusion(in_camera, person),
        ideal=ideal,
        raw=raw.numpy(),
        in_front=in_front,
    )


def _inside_image(
    pixels: Float[np.ndarray, "T J 2"],
    size: np.ndarray,
) -> Bool[np.ndarray, "T J"]:
    inside = (pixels >= -0.5) & (pixels <= size - 0.5)
    return np.logical_and(inside[..., 0], inside[..., 1])


def _mirror_sides(bias: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "J 4"]:
    """Mirror the left side's values to the right; nothing is sideways on the midline."""
    mirror = np.array(MIRROR)
    mirrored = bias[mirror] * [1.0, 1.0, -1.0, 1.0]
    right = np.array([name.startswith("right") for name in JOINTS])
    symmetric = np.where(right[:, None], mirrored, bias)
    midline = mirror == np.arange(len(JOINTS))
    symmetric[midline, 2] = 0.0
    return symmetric


def _rate(
    visible: float,
    occluded: float,
    hidden: Float[np.ndarray, "T J"],
) -> Float[np.ndarray, "T J"]:
    return visible + (occluded - visible) * hidden


def _distort(
    pixels: Float[Tensor, "T J 2"],
    K: Float[Tensor, "3 3"],
    coefficients: Float[Tensor, " C"],
) -> Float[Tensor, "T J 2"]:
    distorted = lens.distort(pixels.flatten(0, 1), K, coefficients)
    return distorted.unflatten(0, pixels.shape[:2])


def _undistort(
    found: Float[np.ndarray, "T J 2"],
    raw: Float[np.ndarray, "T J 2"],
    ideal: Float[np.ndarray, "T J 2"],
    K: Float[Tensor, "3 3"],
    coefficients: Float[Tensor, " C"],
) -> tuple[Float[np.ndarray, "T J 2"], Bool[np.ndarray, "T J"]]:
    """Return the ideal pixels of found ones, and whether there are such.

    Fixed-point steps from the truth (``raw`` through the lens, ``ideal`` without), which is close,
    take a tenth of the time of the general ``lens.undistort``.
    """
    target = torch.from_numpy(found)
    point = torch.from_numpy(ideal)
    error = torch.from_numpy(found - raw)
    for _ in range(4):
        point = point + error
        error = target - _distort(point, K, coefficients)
    converged = (error.abs() < 0.1).all(dim=-1)
    return (point + error).numpy(), converged.numpy()
