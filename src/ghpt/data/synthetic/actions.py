"""What people do in each action: the numbers of ``actions.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float


@dataclass(frozen=True)
class Postures:
    """Postures of an arm or of the legs, and how often each is taken."""

    angles: Float[np.ndarray, "P D"]
    """Degrees; of the legs the last column is the height of a seat in percent of the stature."""
    weights: Float[np.ndarray, " P"]
    """Relative frequencies."""


@dataclass(frozen=True)
class ActionSpec:
    """One action: postures with their frequencies, and the habits of its motion."""

    preferred_arm: Postures
    """Upper arm flexion, abduction, inward rotation; elbow flexion."""
    other_arm: Postures
    legs: Postures
    """Right thigh flexion, abduction, inward rotation, knee flexion; the same of the left; pelvis,
    lumbar and thorax flexion; height of a seat.
    """
    hold: float
    """Mean time that an arm rests in a posture, seconds."""
    reach: float
    """Mean time that an arm takes to its next posture, seconds."""
    stance: float
    """Mean time between changes of the legs, seconds."""
    walk: float
    """Share of the time that is walked."""
    speed: float
    """Of walking, m/s."""
    turn: float
    """Rotation of the body between stances, degrees."""
    twist: float
    """Of the trunk, degrees."""
    look: float
    """Rotation of the head, degrees."""
    energy: float
    """Scale of the small movements that never stop."""


def action_names() -> tuple[str, ...]:
    """Return the names of Human3.6M's 15 actions, and Panoptic Studio's RangeOfMotion."""
    return tuple(_specs())


def action_spec(action: str) -> ActionSpec:
    """Return the numbers of an action of ``action_names``."""
    return _specs()[action]


@cache
def _specs() -> dict[str, ActionSpec]:
    file = resources.files("ghpt.data.synthetic") / "actions.yaml"
    tables = yaml.safe_load(file.read_text(encoding="utf-8"))
    arms: Mapping[str, list[int]] = tables["arms"]
    legs: Mapping[str, list[int]] = tables["legs"]
    entries: Mapping[str, Any] = tables["actions"]
    specs = {}
    for name, entry in entries.items():
        habits = {habit: float(value) for habit, value in entry["habits"].items()}
        specs[name] = ActionSpec(
            preferred_arm=_select_postures(arms, entry["hand"]),
            other_arm=_select_postures(arms, entry["other"]),
            legs=_select_postures(legs, entry["legs"]),
            **habits,
        )
    return specs


def _select_postures(table: Mapping[str, list[int]], weights: Mapping[str, int]) -> Postures:
    angles = [table[posture] for posture in weights]
    return Postures(np.array(angles, dtype=float), np.array(list(weights.values()), dtype=float))
