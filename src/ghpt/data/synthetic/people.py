"""Synthetic recordings of several people, in which it is known whose every detection is.

They cross, stand near, enter, leave and return; who is nearer to a camera hides who is behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from ghpt.config import check_arguments
from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.actions import action_names
from ghpt.data.synthetic.body import CAPSULES, random_body
from ghpt.data.synthetic.detector import Detector, SimulatedDetections
from ghpt.data.synthetic.motion import synthesize_motion
from ghpt.data.synthetic.random_processes import gaussian_process, generator
from ghpt.data.synthetic.rigs import panoptic_rig
from ghpt.errors import check
from ghpt.geometry.cameras import CameraSet, project
from ghpt.skeleton import JOINTS, PELVIS

_APART = 450.0
"""Least distance of two pelvises, mm; people walk around one another."""
_APART_SECONDS = 0.3
_LEAST_JOINTS = 5
"""Joints with which a detector lists a person."""
_SAME_BOX = 0.85
"""Overlap of two boxes from which a detector lists only the nearer person."""
_HIDDEN_SECONDS = 0.4
_HIDDEN_MISSED = 0.45
_HIDDEN_TAKEN = 0.25
"""Shares of the joints hidden by another person that are missed, and that are put on that person's
own joint; the others are found, with the noise of hidden joints.
"""
_TAKEN_WITHIN = 0.4
"""Distance in the image, in the hidden person's sizes, within which a joint can be mistaken."""
_FALSE_CONFIDENCE = 0.4


@dataclass(frozen=True)
class Stay:
    """One person of a scene."""

    action: str
    """Of ``actions.yaml``."""
    place: Sequence[float]
    """Where the motion has its middle on the floor, mm."""
    there: Sequence[Sequence[float]] = ((0.0, 1.0),)
    """When the person is in the scene, as shares of its length."""
    stature: float | None = None
    """mm; None: drawn as all bodies are."""


@dataclass(frozen=True)
class Scene:
    """What is recorded."""

    cameras: Sequence[int]
    """HD cameras of Panoptic Studio."""
    people: Sequence[Stay]
    frames: int
    rate_hz: float
    false_detections: int = 0
    """In each view of each frame, beside the people's: poses of theirs elsewhere in the image."""

    def __post_init__(self) -> None:
        check(len(self.people) >= 1, "people", "is empty", "Put somebody into the scene.")
        check(self.frames >= 1, "frames", f"is {self.frames}", "Give 1 or more.")


@dataclass(frozen=True)
class PeopleRecording:
    """T frames of P people before a rig."""

    name: str
    cameras: CameraSet
    """Ideal pinholes, mm."""
    detections: Detections
    owner: Int[np.ndarray, " N"]
    """The person of each detection; -1 for a false one."""
    truth: Float[np.ndarray, "T P J 3"]
    """World frame, mm."""
    present: Bool[np.ndarray, "T P"]

    def __len__(self) -> int:
        return len(self.truth)

    def detected_views(self) -> Int[np.ndarray, "T P"]:
        """Return the number of views that have a detection of each person."""
        count = np.zeros(self.present.shape, np.int64)
        real = self.owner >= 0
        np.add.at(count, (self.detections.row[real], self.owner[real]), 1)
        return count


def scene_of(settings: Mapping[str, Any], where: str) -> Scene:
    """Return a scene from plain settings. Raises GhptConfigError, which names them by ``where``."""
    check_arguments(Scene, settings, where)
    stays = []
    for number, person in enumerate(settings["people"]):
        check_arguments(Stay, person, f"{where}.people.{number}")
        action = person["action"]
        known = action_names()
        check(action in known, f"{where}.people.{number}.action", f"is {action!r}", _choose(known))
        stays.append(Stay(**person))
    return Scene(**{**settings, "people": tuple(stays)})


def _choose(names: Sequence[str]) -> str:
    return f"Choose from {', '.join(names)}."


def record_people(name: str, scene: Scene, detector: Detector, seed: int) -> PeopleRecording:
    """Return a recording of the scene: a pure function of the arguments.

    The people's identities are their places in ``scene.people``; the detections have none, and are
    in a random order within a view of a frame.
    """
    rig = panoptic_rig(scene.cameras)
    truth = _keep_apart(_motions(name, scene, seed), scene.rate_hz)
    truth = y_down(truth)
    present = _presence(scene)
    found = []
    for person in range(len(scene.people)):
        own = f"{name}/{person}"
        points = truth[:, person]
        found.append(detector(points, rig, scene.rate_hz, seed, own, own))
    seen = _hide(name, scene, rig, truth, present, found, detector, seed)
    key_points, confidence, valid = seen
    order = generator(seed, "order", name)
    pieces = [_people_detections(key_points, confidence, valid)]
    if scene.false_detections:
        false = _false_detections(scene, rig, pieces[0], generator(seed, "false", name))
        pieces.append(false)
    row = np.concatenate([piece.row for piece in pieces])
    view = np.concatenate([piece.view for piece in pieces])
    owner = np.concatenate([piece.owner for piece in pieces])
    found_points = KeyPoints(
        pixels=np.concatenate([piece.points.pixels for piece in pieces]),
        confidence=np.concatenate([piece.points.confidence for piece in pieces]),
        valid=np.concatenate([piece.points.valid for piece in pieces]),
    )
    at = np.lexsort((order.random(len(row)), row, view))
    detections = Detections(
        path=name,
        views=rig.names,
        joints=JOINTS,
        frame=np.arange(scene.frames),
        row=row[at],
        view=view[at],
        identity=np.full(len(at), -1),
        points=found_points[at],
        rate_hz=scene.rate_hz,
    )
    cameras = CameraSet.from_cameras(rig.names, rig.cameras, size=rig.size, path=name)
    return PeopleRecording(name, cameras, detections, owner[at], truth, present)


@dataclass(frozen=True)
class _Piece:
    """Detections with their owners."""

    row: Int[np.ndarray, " N"]
    view: Int[np.ndarray, " N"]
    owner: Int[np.ndarray, " N"]
    points: KeyPoints


def _motions(name: str, scene: Scene, seed: int) -> Float[np.ndarray, "T P J 3"]:
    """Return the people's joints, mm, z up."""
    motions = []
    for number, person in enumerate(scene.people):
        own = f"{name}/{number}"
        body = random_body(generator(seed, "body", own))
        rng = generator(seed, "motion", own)
        points = synthesize_motion(body, person.action, scene.frames, scene.rate_hz, rng)
        if person.stature is not None:
            points = points * (person.stature / body.stature)
        motions.append(points + np.array([*person.place, 0.0]))
    return np.stack(motions, axis=1)


def _keep_apart(points: Float[np.ndarray, "T P J 3"], rate_hz: float) -> np.ndarray:
    """Shift people over the floor so that no two are at one place."""
    people = points.shape[1]
    shift = np.zeros((len(points), people, 2))
    place = points[:, :, PELVIS, :2]
    for _ in range(8):
        now = place + shift
        offset = now[:, :, None] - now[:, None]
        distance = np.linalg.norm(offset, axis=-1)
        direction = offset / distance.clip(1.0)[..., None]
        lacking = (_APART - distance).clip(0) * (1 - np.eye(people))
        step = 0.5 * (lacking[..., None] * direction).sum(2)
        shift += gaussian_filter1d(step, _APART_SECONDS * rate_hz, axis=0, mode="nearest")
    return points + np.concatenate([shift, np.zeros_like(shift[..., :1])], -1)[:, :, None]


def y_down(points: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Return points of a world with z up in Panoptic's, whose y points down."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, -z, y], axis=-1)


def _presence(scene: Scene) -> Bool[np.ndarray, "T P"]:
    time = np.arange(scene.frames) / scene.frames
    present = np.zeros((scene.frames, len(scene.people)), bool)
    for number, person in enumerate(scene.people):
        for start, end in person.there:
            present[:, number] |= (time >= start) & (time < end)
    return present


def _hide(
    name: str,
    scene: Scene,
    rig: CameraSet,
    truth: Float[np.ndarray, "T P J 3"],
    present: Bool[np.ndarray, "T P"],
    found: Sequence[SimulatedDetections],
    detector: Detector,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the key points [P T V J], their confidence and validity, as the people hide them."""
    key_points = np.stack([each.key_points for each in found])
    confidence = np.stack([each.confidence for each in found])
    valid = np.stack([each.valid for each in found]) & present.T[:, :, None, None]
    before = key_points.copy()
    shape = (len(JOINTS), 2)
    for view, camera in enumerate(rig.names):
        images = _images(rig, view, truth)
        for person in range(len(found)):
            rng = generator(seed, "hidden", name, camera, str(person))
            luck = gaussian_process(rng, shape, scene.frames, _HIDDEN_SECONDS * scene.rate_hz)
            chance = ndtr(luck[..., 0])
            hidden_by = _nearest_hider(images, present, person)
            hidden = hidden_by >= 0
            missed = hidden & (chance < _HIDDEN_MISSED)
            other = before[hidden_by, np.arange(scene.frames)[:, None], view, _ALL_JOINTS]
            own = before[person, :, view]
            size = images.size[:, person, None]
            near = np.linalg.norm(other - own, axis=-1) < _TAKEN_WITHIN * size
            taken = hidden & near & (chance > 1 - _HIDDEN_TAKEN)
            noise = detector.noise * detector.occluded_noise * size[..., None] * luck[..., :2]
            displaced = np.where(hidden[..., None], own + noise, own)
            key_points[person, :, view] = np.where(taken[..., None], other, displaced)
            confidence[person, :, view] *= np.where(hidden, 0.6, 1.0)
            valid[person, :, view] &= ~missed
    valid &= _lists(key_points, valid, truth, rig)[..., None]
    return key_points, confidence, valid


_ALL_JOINTS = np.arange(len(JOINTS))[None]


@dataclass(frozen=True)
class _Images:
    """Where the people are in one view."""

    pixels: Float[np.ndarray, "T P J 2"]
    depth: Float[np.ndarray, "T P J"]
    """mm."""
    size: Float[np.ndarray, "T P"]
    """Of a person of 1.7 m at the pelvis' depth, pixels."""


def _images(rig: CameraSet, view: int, truth: Float[np.ndarray, "T P J 3"]) -> _Images:
    pixels, depth = project(rig.cameras.index([view]), torch.from_numpy(truth))
    away = depth[:, :, 0].numpy().clip(1.0)
    focal = float(rig.K[view, 0, 0])
    return _Images(pixels[:, :, 0].numpy(), away, 1700.0 * focal / away[..., PELVIS])


def _nearest_hider(
    images: _Images, present: Bool[np.ndarray, "T P"], person: int
) -> Int[np.ndarray, "T J"]:
    """Return who hides each joint of a person, -1 where nobody does."""
    frames, people, joints = images.depth.shape
    hider = np.full((frames, joints), -1)
    nearest = np.full((frames, joints), np.inf)
    point = images.pixels[:, person]
    depth = images.depth[:, person]
    for other in range(people):
        if other == person:
            continue
        covered, at = _covers(images, other, point)
        hides = covered & present[:, other, None] & (at < depth - 100.0) & (at < nearest)
        hider = np.where(hides, other, hider)
        nearest = np.where(hides, at, nearest)
    return hider


def _covers(
    images: _Images, other: int, point: Float[np.ndarray, "T J 2"]
) -> tuple[Bool[np.ndarray, "T J"], Float[np.ndarray, "T J"]]:
    """Return whether a person's body covers points of the image, and its depth there."""
    start = [capsule.start for capsule in CAPSULES]
    end = [capsule.end for capsule in CAPSULES]
    radius = np.array([capsule.radius for capsule in CAPSULES])
    body = images.pixels[:, other]
    axis = body[:, end] - body[:, start]
    offset = point[:, :, None] - body[:, None, start]
    along = (offset * axis[:, None]).sum(-1) / (axis**2).sum(-1).clip(1e-9)[:, None]
    along = along.clip(0, 1)
    apart = np.linalg.norm(offset - along[..., None] * axis[:, None], axis=-1)
    inside = apart < radius * images.size[:, other, None, None]
    depth = images.depth[:, other]
    at = depth[:, None, start] + along * (depth[:, end] - depth[:, start])[:, None]
    at = np.where(inside, at, np.inf)
    return inside.any(-1), at.min(-1)


def _lists(
    key_points: Float[np.ndarray, "P T V J 2"],
    valid: Bool[np.ndarray, "P T V J"],
    truth: Float[np.ndarray, "T P J 3"],
    rig: CameraSet,
) -> Bool[np.ndarray, "P T V"]:
    """Return which people a detector lists: enough joints, and not those in a nearer one's box."""
    listed = valid.sum(-1) >= _LEAST_JOINTS
    mask = valid[..., None]
    low = np.where(mask, key_points, np.inf).min(-2)
    high = np.where(mask, key_points, -np.inf).max(-2)
    known = np.isfinite(low)
    low = np.where(known, low, 0)
    high = np.where(known, high, 0)
    area = (high - low).prod(-1)
    _, depth = project(rig.cameras, torch.from_numpy(truth[:, :, PELVIS]))
    away = depth.numpy().transpose(2, 0, 1)
    for person in range(len(listed)):
        shared = np.minimum(high, high[person]) - np.maximum(low, low[person])
        common = shared.clip(0).prod(-1)
        overlap = common / (area + area[person] - common).clip(1e-9)
        nearer = (away < away[person]) & listed
        listed[person] &= ~(nearer & (overlap > _SAME_BOX)).any(0)
    return listed


def _people_detections(key_points: np.ndarray, confidence: np.ndarray, valid: np.ndarray) -> _Piece:
    """Return the detections of key points [P T V J]."""
    owner, row, view = np.nonzero(valid.any(-1))
    at = (owner, row, view)
    points = KeyPoints(key_points[at].astype(np.float64), confidence[at].astype(float), valid[at])
    return _Piece(row, view, owner, points)


def _false_detections(
    scene: Scene, rig: CameraSet, people: _Piece, rng: np.random.Generator
) -> _Piece:
    """Return detections of nobody: poses of people of any frame, elsewhere in the image."""
    count = scene.false_detections
    views = len(rig.names)
    total = scene.frames * views * count
    row = np.repeat(np.arange(scene.frames), views * count)
    view = np.tile(np.repeat(np.arange(views), count), scene.frames)
    source = rng.integers(0, len(people.row), total)
    points = people.points[source]
    middle = points.pixels.mean(1, keepdims=True)
    size = rig.image_size.numpy()[view][:, None]
    place = rng.uniform(0.1, 0.9, (total, 1, 2)) * size
    scale = rng.uniform(0.3, 1.1, (total, 1, 1))
    pixels = place + scale * (points.pixels - middle)
    confidence = _FALSE_CONFIDENCE * rng.random((total, 1)) * points.valid
    inside = ((pixels >= 0) & (pixels < size)).all(-1)
    found = KeyPoints(pixels, confidence, points.valid & inside)
    return _Piece(row, view, np.full(total, -1), found)
