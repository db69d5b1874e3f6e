"""How often the tests repeat what is drawn at random: in the ordinary suite, and every night.

``GHPT_NIGHTLY=1`` (``scripts/reliability.py --nightly``) gives the nightly sizes. The draws are
seeded: the ordinary ones are always the same.
"""

import os
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")
NIGHTLY = os.environ.get("GHPT_NIGHTLY") == "1"


def _size(ordinary: int, nightly: int) -> int:
    return nightly if NIGHTLY else ordinary


def representatives(ordinary: Sequence[T], others: Sequence[T]) -> list[T]:
    """Return the parameters of a test: one of each sort, and at night the others of its sort."""
    return [*ordinary, *(others if NIGHTLY else ())]


MUTATED_FILES = _size(100, 20_000)
"""A1: spoilt files of each foreign format."""
MUTATED_NPZ = _size(300, 20_000)
"""A2: spoilt bytes of our own key points."""
CUT_FILES = _size(150, 10**9)
"""A3: the places at which a file of each format is cut; at night every byte."""
FLIPPED_BITS = _size(300, 1500)
"""A2: flipped bits of a checkpoint, beside those of its end."""
DAMAGED_CHECKPOINTS = _size(25, 100)
"""B6: damaged checkpoints that a training is to go on after."""
KILLED_SAVES = _size(4, 300)
"""B1: kills while a checkpoint is saved."""
KILLED_TRAININGS = _size(1, 10)
"""B2: trainings that are killed and resumed."""
KILLED_PREDICTIONS = _size(4, 200)
"""B3: kills of a prediction."""
PREDICTED_FRAMES = _size(500, 100_000)
"""B3: frames of that prediction."""
TRAINING_STEPS = _size(120, 20_000)
"""E3: steps of a long training."""
STREAMED_FRAMES = _size(12_000, 1_000_000)
"""E2: frames of a prediction whose memory stays flat."""
LENSES = _size(200, 10_000)
"""D1: rigs whose lenses are undone."""
ESTIMATED_FRAMES = _size(60, 1000)
"""D2: frames of the batch that a degenerate frame is put into."""
BROKEN_NUMBERS = _size(100, 5_000)
"""D3: cameras, key points and weights with a number that is broken."""
BATCHED_FRAMES = _size(3, 64)
"""C4: frames that are computed one by one."""
ADJUSTMENTS = _size(75, 10_000)
"""D5: starts of the bundle adjustment."""
SCENE_FRAMES = _size(28, 64)
"""C4: frames of their batch."""
CALIBRATED_RIGS = _size(8, 24)
"""Rigs whose uncertainty is compared with their error."""
GOOD_RIGS = _size(2, 100)
"""D6: recordings that give a good rig."""
SCALED_RIGS = _size(8, 300)
"""D6: recordings that are scaled by the person."""
MANY_FILES = _size(1_000, 50_000)
"""E4: files of a recording, and twice as many."""
