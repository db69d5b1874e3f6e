"""Short recordings in which everything is random: rig, person, motion, detector and mistakes.

They teach what holds for any cameras and any detector. A recording has ``VIEWS`` views, of which
the last ones see nothing where its rig has fewer, so that all of them make one batch. The truth is
the joints by the detector's own definition: what a detector means by a joint is no error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ghpt.data.synthetic.actions import action_names
from ghpt.data.synthetic.detector import KINDS, Detector, SimulatedDetections
from ghpt.data.synthetic.random_processes import gaussian_process, generator
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.observations import LabelledRecording

VIEWS = 8
"""The most views of a random rig."""
FEWEST_VIEWS = 2
RATE = 6.0
"""Hz: poses of one recording that differ."""

_IMAGES = ((1000, 1000), (1920, 1080), (1080, 1920), (1280, 720))
_TARGET = np.array([0.0, 0.0, 900.0])
"""Where the cameras look, mm."""


@dataclass(frozen=True)
class Mistakes:
    """What is wrong with a recording, beside its detector."""

    outliers: float
    """Share of the key points that are displaced, anew in every frame."""
    missing: float
    """Share of the key points that are missed, anew in every frame."""
    others: float
    """Share of the time in which a view shows another person."""
    turned: Float[np.ndarray, " V"]
    """Angle by which each camera is not where it is said to be, degrees."""
    shifted: Float[np.ndarray, " V"]
    """Distance likewise, mm."""


def random_recordings(
    split: str, seed: int, count: int, frames: int
) -> Iterator[LabelledRecording]:
    """Return ``count`` recordings of so many frames, a pure function of the arguments."""
    for number in range(count):
        yield _draw_recording(f"{split}-{number}", seed, frames)


def _draw_recording(name: str, seed: int, frames: int) -> LabelledRecording:
    rng = generator(seed, "random recording", name)
    actions = action_names()
    action = actions[rng.integers(len(actions))]
    truth = draw_motion(seed, name, name, action, frames, RATE)
    rig = random_rig(rng)
    views = int(rng.integers(FEWEST_VIEWS, VIEWS + 1))
    detector = random_detector(rng)
    found = detector(truth, rig, RATE, seed, name, name)
    mistakes = _draw_mistakes(rng)
    if mistakes.others > 0:
        other = draw_motion(seed, f"{name} other", f"{name} other", action, frames, RATE)
        other[..., :2] += rng.normal(0, 600.0, 2)
        found = _show_another(found, other, rig, mistakes.others, rng)
    found = _displace(found, mistakes, rng)
    valid = found.valid & (np.arange(VIEWS) < views)[:, None]
    confidence = found.confidence
    if rng.uniform() < 0.3:  # of a detector that gives none
        confidence = np.ones_like(confidence)
    return LabelledRecording(
        name=name,
        subject=name,
        action=action,
        rate_hz=RATE,
        camera_names=rig.names,
        cameras=_move_cameras(rig.cameras, mistakes, rng),
        key_points=np.where(valid[..., None], found.key_points, 0.0).astype(np.float32),
        confidence=np.where(valid, confidence, 0.0).astype(np.float32),
        valid=valid,
        truth=truth.astype(np.float32),
        truth_valid=np.ones(truth.shape[:2], dtype=bool),
        frame=np.arange(frames),
    )


def random_rig(rng: np.random.Generator) -> CameraSet:
    """Return ``VIEWS`` pinhole cameras around a person, of one kind of image."""
    width, height = _IMAGES[rng.integers(len(_IMAGES))]
    reach = rng.uniform(2500.0, 6500.0)
    # the smallest focal length at which a person of two metres fills a third of the image's height
    focal = rng.uniform(0.33, 0.8) * min(width, height) * reach / 2000.0
    arc = np.deg2rad(rng.choice([360.0, 360.0, 200.0, 100.0]))
    azimuth = (
        rng.uniform(0, 2 * np.pi) + arc * (np.arange(VIEWS) + rng.uniform(-0.4, 0.4, VIEWS)) / VIEWS
    )
    azimuth = rng.permutation(azimuth)
    distance = reach * rng.uniform(0.8, 1.25, VIEWS)
    level = rng.uniform(300.0, 2800.0, VIEWS)
    ground = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1) * distance[:, None]
    centre = np.concatenate([ground, level[:, None]], axis=-1)
    target = _TARGET + rng.normal(0.0, 150.0, (VIEWS, 3))
    R = np.stack([_look(towards) for towards in target - centre])
    K = np.zeros((VIEWS, 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal * rng.uniform(0.9, 1.1, VIEWS)
    K[:, 0, 2] = (width - 1) / 2
    K[:, 1, 2] = (height - 1) / 2
    K[:, 2, 2] = 1.0
    cameras = Cameras(
        K=torch.from_numpy(K),
        R=torch.from_numpy(R),
        t=torch.from_numpy(-np.einsum("vij,vj->vi", R, centre)),
    )
    names = tuple(f"camera{view}" for view in range(VIEWS))
    size = torch.tensor([width, height]).expand(VIEWS, 2)
    return CameraSet.from_cameras(names, cameras, size=size)


def _look(towards: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation, world to camera, of an upright camera that looks in a direction."""
    axis = towards / np.linalg.norm(towards)
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis])


def random_detector(rng: np.random.Generator) -> Detector:
    """Return a detector without a definition of its own of the joints."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    outlier_rate = between(0.0005, 0.05)
    miss_rate = between(0.001, 0.05)
    return Detector(
        noise=between(0.002, 0.02),
        noise_seconds=0.12,
        noise_white=0.15,
        noise_slow=0.5,
        noise_slow_seconds=2.0,
        neighbours=rng.uniform(0.0, 0.7),
        noise_spread=rng.uniform(0.0, 0.6),
        joints={kind: between(0.6, 1.7) for kind in dict.fromkeys(KINDS)},
        bias=0.0,
        bias_seed=int(rng.integers(2**31)),
        bias_of_subject=0.0,
        view_bias=between(0.001, 0.012),
        view_bias_degrees=30.0,
        drift=0.0,
        drift_seconds=2.0,
        occluded_noise=between(1.2, 5.0),
        outlier_rate=outlier_rate,
        outlier_rate_occluded=min(outlier_rate * between(2.0, 10.0), 0.4),
        outlier_size=between(0.03, 0.3),
        outlier_seconds=0.4,
        swap_rate=between(0.001, 0.05),
        swap_seconds=0.3,
        swap_together=rng.uniform(),
        miss_rate=miss_rate,
        miss_rate_occluded=min(miss_rate * between(2.0, 10.0), 0.4),
        miss_seconds=0.3,
        confidence_typical=rng.uniform(0.0, 2.5),
        confidence_slope=between(0.2, 1.5),
        confidence_knowledge=rng.uniform(0.05, 0.8),
        familiar=1.0,
    )


def _draw_mistakes(rng: np.random.Generator) -> Mistakes:
    turned = np.zeros(VIEWS)
    shifted = np.zeros(VIEWS)
    kind = rng.uniform()
    if kind < 0.4:  # all cameras
        turned = rng.uniform(0.0, 2.5) * rng.uniform(0.7, 1.3, VIEWS)
        shifted = rng.uniform(0.0, 40.0) * rng.uniform(0.7, 1.3, VIEWS)
    elif kind < 0.55:  # one of them
        turned[rng.integers(VIEWS // 2)] = rng.uniform(0.3, 4.0)
    return Mistakes(
        outliers=rng.uniform(0.02, 0.4) if rng.uniform() < 0.5 else 0.0,
        missing=rng.uniform(0.05, 0.6) if rng.uniform() < 0.35 else 0.0,
        others=rng.uniform(0.03, 0.25) if rng.uniform() < 0.4 else 0.0,
        turned=turned,
        shifted=shifted,
    )


def _show_another(
    found: SimulatedDetections,
    other: Float[np.ndarray, "T J 3"],
    rig: CameraSet,
    share: float,
    rng: np.random.Generator,
) -> SimulatedDetections:
    """Show another person in each view for a share of the time."""
    process = gaussian_process(rng, (VIEWS,), len(other), 0.5 * RATE)
    wrong = process < np.quantile(process, share)
    pixels, depth = project(rig.cameras.expand(len(other)), torch.from_numpy(other))
    width, height = rig.image_size[0].tolist()
    own = found.key_points
    extent = np.ptp(own, axis=2).max(-1)[..., None, None]
    noisy = pixels.numpy() + 0.01 * extent * rng.normal(size=pixels.shape)
    inside = (noisy >= 0) & (noisy <= [width - 1, height - 1])
    seen = inside.all(-1) & (depth.numpy() > 100.0)
    wrong = wrong[..., None] & seen.any(-1, keepdims=True)
    return SimulatedDetections(
        key_points=np.where(wrong[..., None], noisy, own),
        confidence=found.confidence,
        valid=np.where(wrong, seen, found.valid),
    )


def _displace(
    found: SimulatedDetections, mistakes: Mistakes, rng: np.random.Generator
) -> SimulatedDetections:
    """Displace some key points, by 0.05 to 0.6 of the person's size, and take others away."""
    shape = found.valid.shape
    seen = found.valid[..., None]
    high = np.where(seen, found.key_points, -np.inf).max(2, keepdims=True)
    low = np.where(seen, found.key_points, np.inf).min(2, keepdims=True)
    with np.errstate(invalid="ignore"):
        extent = np.linalg.norm(high - low, axis=-1)
    extent = np.where(np.isfinite(extent), extent, 0.0)
    angle = rng.uniform(0, 2 * np.pi, shape)
    length = rng.uniform(0.05, 0.6, shape) * extent * (rng.uniform(size=shape) < mistakes.outliers)
    offset = length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    kept: Bool[np.ndarray, "T V J"] = rng.uniform(size=shape) >= mistakes.missing
    return replace(found, key_points=found.key_points + offset, valid=found.valid & kept)


def _move_cameras(cameras: Cameras, mistakes: Mistakes, rng: np.random.Generator) -> Cameras:
    """Return where the cameras are said to be."""
    axis = rng.normal(size=(VIEWS, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    turn = np.deg2rad(mistakes.turned)[:, None] * axis
    rotation = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
    direction = rng.normal(size=(VIEWS, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    shift = torch.from_numpy(mistakes.shifted[:, None] * direction)
    R = rotation @ cameras.R
    centre = cameras.centre + shift
    return Cameras(cameras.K, R, -(R @ centre[..., None])[..., 0])
