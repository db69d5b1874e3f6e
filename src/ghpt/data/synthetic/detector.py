"""A model of a 2D key-point detector: what it would have seen of a moving 3D body through real
lenses.

Every error persists over time and knows the body: joints are defined a little differently than in
the truth, pixel noise grows with the person in the image, what the body hides is found worse, sides
are exchanged, and key points jump away or are missed for a while. All lengths are fractions of the
person's stature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.special import expit, ndtr
from torch import Tensor

from ghpt.data.synthetic.body import occlusion, stature, trunk_frame
from ghpt.data.synthetic.random_processes import generator, process
from ghpt.geometry import lens
from ghpt.geometry.cameras import CameraSet
from ghpt.skeleton import BONES, JOINT, JOINTS, MIRROR, PELVIS

SWAPS = tuple(
    tuple((JOINT[f"right_{part}"], JOINT[f"left_{part}"]) for part in parts)
    for parts in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
)
"""The pairs of joints that are exchanged together: legs, arms."""

_ON = {a: b for a, b in BONES if JOINTS[a].split("_")[-1] in ("ankle", "knee", "hip")}
_ON |= {b: a for a, b in BONES if JOINTS[b].split("_")[-1] in ("elbow", "wrist", "shoulder")}
_LIMBS = list(_ON), list(_ON.values())
"""Limb joints, and the joint that each hangs on."""

KINDS = tuple(name.removeprefix("right_").removeprefix("left_") for name in JOINTS)
"""The joints without their sides."""


@dataclass(frozen=True)
class SimulatedDetections:
    """What one detector says about T frames in V views."""

    key_points: Float[np.ndarray, "T V J 2"]
    """Undistorted pixels, float32; 0 where not seen."""
    confidence: Float[np.ndarray, "T V J"]
    valid: Bool[np.ndarray, "T V J"]


@dataclass(frozen=True)
class Processes:
    """Unit Gaussian processes in time that one camera's errors are made of."""

    noise: Float[np.ndarray, "T J 2"]
    outlier: Float[np.ndarray, "T J"]
    direction: Float[np.ndarray, "T J 2"]
    flip: Float[np.ndarray, "T G"]
    miss: Float[np.ndarray, "T J"]
    confidence: Float[np.ndarray, "T J"]

    def every(self, stride: int) -> Processes:
        """The same processes at every ``stride``-th frame."""
        return Processes(**{name: value[::stride] for name, value in vars(self).items()})


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
        shown = self.shown(
            points, self.body_error(len(points), rate_hz, seed, subject, take), familiar
        )
        views = []
        for view, name in enumerate(rig.names):
            processes = self.processes(len(points), rate_hz, generator(seed, "camera", take, name))
            views.append(self.view(points, shown, rig, view, processes, familiar))
        return SimulatedDetections(*(np.stack(field, axis=1) for field in zip(*views, strict=True)))

    def body_error(
        self, frames: int, rate_hz: float, seed: int, subject: str, take: str
    ) -> tuple[Float[np.ndarray, "J 4"], Float[np.ndarray, "T J 3"]]:
        """Unit joint-definition bias (along the limb, and in the trunk's frame) and unit drift."""
        bias = _symmetric(
            generator(self.bias_seed, "joint definition").normal(size=(len(JOINTS), 4))
        )
        own = generator(seed, "subject", subject).normal(size=(len(JOINTS), 4))
        bias = np.sqrt(1.0 - self.bias_of_subject) * bias + np.sqrt(self.bias_of_subject) * own
        drift = process(
            generator(seed, "drift", take), (len(JOINTS), 3), frames, self.drift_seconds * rate_hz
        )
        return bias / 2.0, drift / np.sqrt(3.0)

    def processes(self, frames: int, rate_hz: float, rng: np.random.Generator) -> Processes:
        """Draw what one camera's errors of a take are made of."""
        joints = len(JOINTS)
        white = rng.standard_normal((frames, joints, 2), dtype=np.float32)
        quick = process(rng, (joints, 2), frames, self.noise_seconds * rate_hz)
        slow = process(rng, (joints, 2), frames, self.noise_slow_seconds * rate_hz)
        shares = np.array(
            [self.noise_white, 1.0 - self.noise_white - self.noise_slow, self.noise_slow]
        )
        shares = np.sqrt(shares).astype(np.float32)
        return Processes(
            noise=shares[0] * white + shares[1] * quick + shares[2] * slow,
            outlier=process(rng, (joints,), frames, self.outlier_seconds * rate_hz),
            direction=process(rng, (joints, 2), frames, self.outlier_seconds * rate_hz),
            flip=process(rng, (len(SWAPS),), frames, self.swap_seconds * rate_hz),
            miss=process(rng, (joints,), frames, self.miss_seconds * rate_hz),
            confidence=process(rng, (joints,), frames, self.noise_seconds * rate_hz),
        )

    def shown(
        self,
        points: Float[np.ndarray, "T J 3"],
        body_error: tuple[Float[np.ndarray, "J 4"], Float[np.ndarray, "T J 3"]],
        familiar: bool,
    ) -> Float[np.ndarray, "T J 3"]:
        """Where the joints are by the detector's definition, the same for all views."""
        bias, drift = body_error
        trunk = trunk_frame(points)
        vector = bias[:, 1:] @ trunk.mT
        limb = points[:, _LIMBS[0]] - points[:, _LIMBS[1]]
        limb /= np.linalg.norm(limb, axis=-1, keepdims=True).clip(min=1e-9)
        vector[:, _LIMBS[0]] += bias[_LIMBS[0], :1] * limb
        scale = stature(points) * (self.familiar if familiar else 1.0)
        return points + scale * (self.bias * vector + self.drift * drift)

    def view(
        self,
        points: Float[np.ndarray, "T J 3"],
        shown: Float[np.ndarray, "T J 3"],
        rig: CameraSet,
        view: int,
        processes: Processes,
        familiar: bool,
    ) -> tuple[Float[np.ndarray, "T J 2"], Float[np.ndarray, "T J"], Bool[np.ndarray, "T J"]]:
        """Key points (undistorted), confidence and seen of one camera."""
        K, R, t = (x[view].numpy() for x in (rig.cameras.K, rig.cameras.R, rig.cameras.t))
        in_camera = (points @ R.T + t).astype(np.float32)
        person = stature(points)
        hidden = occlusion(in_camera, person)
        depth = in_camera[:, PELVIS, 2].clip(min=1.0)
        pixels = (np.sqrt(K[0, 0] * K[1, 1]) * person / depth)[
            :, None
        ]  # the person's size in the image

        target = shown @ R.T + t
        in_front = target[..., 2] > 0.05 * person
        safe = np.where(in_front[..., None], target, [0.0, 0.0, 1.0])
        ideal = torch.from_numpy((safe @ K.T)[..., :2] / safe[..., 2:])
        raw = _distort(ideal, rig.cameras.K[view], rig.distortion[view]).numpy()

        scale = self.familiar if familiar else 1.0
        relative = np.array([self.joints[kind] for kind in KINDS])
        spread = self.noise * (1.0 + (self.occluded_noise - 1.0) * hidden) * relative
        error = scale * (
            spread[..., None] * processes.noise + self._outliers(hidden, relative, processes)
        )
        flipped = self._swap(raw, in_camera, person, processes)
        found = flipped + pixels[..., None] * error

        size = np.linalg.norm(found - raw, axis=-1) / pixels
        missing = _rate(self.miss_rate, self.miss_rate_occluded, hidden)
        inside = ((found >= -0.5) & (found <= rig.size[view].numpy() - 0.5)).all(axis=-1)
        valid = inside & in_front & (in_camera[..., 2] > 0.0) & (ndtr(processes.miss) > missing)
        key_points, undone = _undistort(
            found, raw, ideal.numpy(), rig.cameras.K[view], rig.distortion[view]
        )
        valid &= undone
        key_points = np.where(valid[..., None], key_points, 0.0).astype(np.float32)
        confidence = np.where(valid, self._confidence(size, processes), 0.0).astype(np.float32)
        return key_points, confidence, valid

    def _outliers(
        self,
        hidden: Float[np.ndarray, "T J"],
        relative: Float[np.ndarray, " J"],
        processes: Processes,
    ) -> Float[np.ndarray, "T J 2"]:
        """Offsets of exponential length, while the process is above the quantile that the rate
        leaves; continuous in time, because the length is a function of how far it is above.
        """
        rate = (relative * _rate(self.outlier_rate, self.outlier_rate_occluded, hidden)).clip(
            1e-6, 0.9
        )
        above = (ndtr(processes.outlier) - (1.0 - rate)) / rate
        length = -self.outlier_size * np.log1p(-above.clip(0.0, 1.0 - 1e-4))
        direction = processes.direction / np.linalg.norm(
            processes.direction, axis=-1, keepdims=True
        ).clip(min=1e-6)
        return length[..., None] * direction

    def _swap(
        self,
        raw: Float[np.ndarray, "T J 2"],
        in_camera: Float[np.ndarray, "T J 3"],
        person: float,
        processes: Processes,
    ) -> Float[np.ndarray, "T J 2"]:
        """Exchange left and right of legs or arms: likelier from the side and from behind."""
        raw = raw.copy()
        for group, pairs in enumerate(SWAPS):
            right, left = pairs[0]
            across = in_camera[:, left] - in_camera[:, right]
            facing = across[:, 0] / np.linalg.norm(across, axis=-1).clip(
                min=1e-9
            )  # 1: to the camera, -1: away
            rate = self.swap_rate * (
                0.2 + 2.0 * np.exp(-((facing / 0.35) ** 2)) + 0.6 * (facing < 0)
            )
            now = ndtr(processes.flip[:, group]) > 1.0 - rate
            for a, b in pairs:
                raw[now, a], raw[now, b] = raw[now, b], raw[now, a]
        return raw

    def _confidence(
        self, size: Float[np.ndarray, "T J"], processes: Processes
    ) -> Float[np.ndarray, "T J"]:
        known = np.log(size.clip(min=0.01 * self.noise) / (1.25 * self.noise))
        # 0.8: the spread of the logarithm of an error's size, which chance must be compared with
        by_chance = 0.8 * np.sqrt(1.0 / self.confidence_knowledge**2 - 1.0) * processes.confidence
        return expit(self.confidence_typical - self.confidence_slope * (known + by_chance))


def _symmetric(bias: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "J 4"]:
    """The left side's values mirrored to the right; nothing sideways on the midline."""
    mirrored = bias[list(MIRROR)] * [1.0, 1.0, -1.0, 1.0]
    right = np.array([name.startswith("right") for name in JOINTS])[:, None]
    middle = np.array(MIRROR) == np.arange(len(JOINTS))
    bias = np.where(right, mirrored, bias)
    bias[middle, 2] = 0.0
    return bias


def _rate(
    visible: float, occluded: float, hidden: Float[np.ndarray, "T J"]
) -> Float[np.ndarray, "T J"]:
    return visible + (occluded - visible) * hidden


def _distort(
    pixels: Float[Tensor, "T J 2"], K: Float[Tensor, "3 3"], coefficients: Float[Tensor, " C"]
) -> Float[Tensor, "T J 2"]:
    return lens.distort(pixels.flatten(0, 1), K, coefficients).unflatten(0, pixels.shape[:2])


def _undistort(
    found: Float[np.ndarray, "T J 2"],
    raw: Float[np.ndarray, "T J 2"],
    ideal: Float[np.ndarray, "T J 2"],
    K: Float[Tensor, "3 3"],
    coefficients: Float[Tensor, " C"],
) -> tuple[Float[np.ndarray, "T J 2"], Bool[np.ndarray, "T J"]]:
    """Ideal pixels of found ones, and whether that worked: fixed-point steps from the truth
    (``raw`` through the lens, ``ideal`` without), which is close, take a tenth of the time of the
    general ``lens.undistort``.
    """
    target = torch.from_numpy(found)
    point = torch.from_numpy(ideal)
    error = torch.from_numpy(found - raw)
    for _ in range(4):
        point = point + error
        error = target - _distort(point, K, coefficients)
    return (point + error).numpy(), (error.abs() < 0.1).all(dim=-1).numpy()
