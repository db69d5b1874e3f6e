"""The data that needs no licence: real rigs, synthetic people who move, and a model detector."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ghpt.data.synthetic.actions import action_names
from ghpt.data.synthetic.body import random_body
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.motion import synthesize_motion
from ghpt.data.synthetic.random_processes import generator
from ghpt.data.synthetic.rigs import ARRANGEMENTS, human36m_rig, panoptic_rig
from ghpt.errors import check
from ghpt.geometry.cameras import CameraSet
from ghpt.observations import LabelledRecording

SPLITS = ("train", "validation", "test")
HUMAN36M_SUBJECTS = {
    "train": ("S1", "S5", "S6", "S7"),
    "validation": ("S8",),
    "test": ("S9", "S11"),
}
HUMAN36M_RATE = 50.0
HUMAN36M_FRAMES = {"train": 512, "validation": 512, "test": 1066}
"""Of each take; every 64th of the test split are 1,020 frames."""
PANOPTIC_SUBJECTS = tuple(f"P{number}" for number in range(1, 9))
PANOPTIC_RATE = 30.0
PANOPTIC_FRAMES = 12_600
"""Hz, and frames of a person's one sequence (7 minutes), of which 40 of every 64th are tested."""
PANOPTIC_PARTS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}


@dataclass(frozen=True)
class Take:
    """One person's motion before a rig, not yet detected."""

    name: str
    subject: str
    action: str
    rate_hz: float
    rig: CameraSet
    truth: Float[np.ndarray, "T J 3"]
    """World frame, mm."""
    familiar: bool
    """Whether the detector was trained on this person."""
    first: int
    """Number of the first frame."""


def synthetic_recordings(
    data: str,
    split: str,
    seed: int,
    detector: Detector,
    cameras: Sequence[int] | None = None,
) -> Iterator[LabelledRecording]:
    """Return the synthetic recordings of ``h36m``, of ``cmu1`` to ``cmu4``, or of ``panoptic``.

    ``panoptic`` takes any HD ``cameras``. The recordings are a pure function of the arguments; a
    camera's detections are the same in every arrangement that has it. Raises GhptConfigError for an
    unknown name and GhptDataError for a bad list of cameras, at once.
    """
    return (_detect(take, seed, detector) for take in takes(data, split, seed, cameras))


def takes(
    data: str,
    split: str,
    seed: int,
    cameras: Sequence[int] | None = None,
) -> Iterator[Take]:
    """Return the motions behind `synthetic_recordings`."""
    check(split in SPLITS, "split", f"is {split!r}", f"Choose from {', '.join(SPLITS)}.")
    known = (*ARRANGEMENTS, "panoptic")
    check(data in known, "data", f"is {data!r}", f"Choose from {', '.join(known)}.")
    if data == "h36m":
        return _human36m_takes(split, seed)
    if cameras is None:
        cameras = range(31) if data == "panoptic" else ARRANGEMENTS[data]
    return _panoptic_takes(panoptic_rig(cameras), split, seed)


def draw_motion(
    seed: int,
    subject: str,
    take: str,
    action: str,
    frames: int,
    rate_hz: float,
) -> Float[np.ndarray, "T J 3"]:
    """Draw one take of one person, mm, z up: the same person in all of the subject's takes."""
    person = generator(seed, "body", subject)
    body = random_body(person)
    left_handed = bool(person.uniform() < 0.1)
    motion = generator(seed, "motion", take)
    return synthesize_motion(body, action, frames, rate_hz, motion, left_handed)


def _human36m_takes(split: str, seed: int) -> Iterator[Take]:
    frames = HUMAN36M_FRAMES[split]
    actions = [name for name in action_names() if name != "RangeOfMotion"]
    for subject in HUMAN36M_SUBJECTS[split]:
        rig = human36m_rig(subject)
        for action, number in itertools.product(actions, (1, 2)):
            name = f"{subject}/{action}-{number}"
            truth = draw_motion(seed, subject, name, action, frames, HUMAN36M_RATE)
            yield Take(
                name=name,
                subject=subject,
                action=action,
                rate_hz=HUMAN36M_RATE,
                rig=rig,
                truth=truth,
                familiar=split != "test",
                first=0,
            )


def _panoptic_takes(rig: CameraSet, split: str, seed: int) -> Iterator[Take]:
    action = "RangeOfMotion"
    start, end = PANOPTIC_PARTS[split]
    first = round(start * PANOPTIC_FRAMES)
    last = round(end * PANOPTIC_FRAMES)
    for subject in PANOPTIC_SUBJECTS:
        motion = draw_motion(seed, subject, subject, action, PANOPTIC_FRAMES, PANOPTIC_RATE)
        x, y, z = np.moveaxis(motion[first:last], -1, 0)
        yield Take(
            name=f"{subject}/{split}",
            subject=subject,
            action=action,
            rate_hz=PANOPTIC_RATE,
            rig=rig,
            truth=np.stack([x, -z, y], axis=-1),
            familiar=False,
            first=first,
        )


def _detect(take: Take, seed: int, detector: Detector) -> LabelledRecording:
    found = detector(
        take.truth,
        take.rig,
        take.rate_hz,
        seed,
        take.subject,
        take.name,
        take.familiar,
    )
    frames, joints, _ = take.truth.shape
    return LabelledRecording(
        name=take.name,
        subject=take.subject,
        action=take.action,
        rate_hz=take.rate_hz,
        camera_names=take.rig.names,
        cameras=take.rig.cameras,
        key_points=found.key_points,
        confidence=found.confidence,
        valid=found.valid,
        truth=take.truth.astype(np.float32),
        truth_valid=np.ones((frames, joints), dtype=bool),
        frame=np.arange(take.first, take.first + frames),
    )
