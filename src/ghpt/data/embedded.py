"""The data that needs no licence: real rigs, synthetic people who move, and a model of their detector."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ghpt.data.body import random_body
from ghpt.data.detector import Detector, generator
from ghpt.data.motion import actions, move
from ghpt.data.rigs import ARRANGEMENTS, Rig, human36m_rig, panoptic_rig
from ghpt.errors import check
from ghpt.recording import Recording

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
PANOPTIC_RATE, PANOPTIC_FRAMES = 30.0, 12_600
"""Hz, and frames of a person's one sequence (7 minutes), of which 40 of every 64th are tested."""
PANOPTIC_PARTS = {"train": (0.0, 0.6), "validation": (0.6, 0.8), "test": (0.8, 1.0)}


def embedded_recordings(
    data: str, split: str, seed: int, detector: Detector, cameras: Sequence[int] | None = None
) -> Iterator[Recording]:
    """The synthetic recordings of ``h36m``, of ``cmu1`` to ``cmu4``, or of ``panoptic`` with any HD ``cameras``.

    A pure function of its arguments; a camera's detections are the same in every arrangement that has it.
    """
    check(split in SPLITS, "split", f"is {split!r}", f"Choose from {', '.join(SPLITS)}.")
    known = (*ARRANGEMENTS, "panoptic")
    check(data in known, "data", f"is {data!r}", f"Choose from {', '.join(known)}.")
    if data == "h36m":
        return _human36m(split, seed, detector)
    rig = panoptic_rig(ARRANGEMENTS[data] if cameras is None else cameras)
    return _panoptic(rig, split, seed, detector)


def _human36m(split: str, seed: int, detector: Detector) -> Iterator[Recording]:
    for subject in HUMAN36M_SUBJECTS[split]:
        rig = human36m_rig(subject)
        for action in (name for name in actions() if name != "RangeOfMotion"):
            for number in (1, 2):
                take = f"{subject}/{action}-{number}"
                truth = motion(seed, subject, take, action, HUMAN36M_FRAMES[split], HUMAN36M_RATE)
                familiar = split != "test"
                yield _record(take, subject, action, HUMAN36M_RATE, rig, truth, detector, seed, familiar, 0)


def _panoptic(rig: Rig, split: str, seed: int, detector: Detector) -> Iterator[Recording]:
    first, last = (round(part * PANOPTIC_FRAMES) for part in PANOPTIC_PARTS[split])
    for subject in PANOPTIC_SUBJECTS:
        truth = motion(seed, subject, subject, "RangeOfMotion", PANOPTIC_FRAMES, PANOPTIC_RATE)[first:last]
        truth = np.stack([truth[..., 0], -truth[..., 2], truth[..., 1]], axis=-1)
        name = f"{subject}/{split}"
        yield _record(name, subject, "RangeOfMotion", PANOPTIC_RATE, rig, truth, detector, seed, False, first)


def motion(seed: int, subject: str, take: str, action: str, frames: int, rate_hz: float) -> np.ndarray:
    """One take of one person, T x J x 3, mm, z up: the same person in all of the subject's takes."""
    person = generator(seed, "body", subject)
    body, left_handed = random_body(person), bool(person.uniform() < 0.1)
    return move(body, action, frames, rate_hz, generator(seed, "motion", take), left_handed)


def _record(
    name: str,
    subject: str,
    action: str,
    rate_hz: float,
    rig: Rig,
    truth: np.ndarray,
    detector: Detector,
    seed: int,
    familiar: bool,
    first: int,
) -> Recording:
    found = detector(truth, rig, rate_hz, seed, subject, name, familiar)
    return Recording(
        name=name,
        subject=subject,
        action=action,
        rate_hz=rate_hz,
        camera_names=rig.names,
        cameras=rig.cameras,
        key_points=found.key_points,
        confidence=found.confidence,
        seen=found.seen,
        truth=truth.astype(np.float32),
        truth_seen=np.ones(truth.shape[:2], dtype=bool),
        frame=np.arange(first, first + len(truth)),
    )
