"""The world that a prediction is written in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.errors import check
from ghpt.export.stream import Chunks
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.similarity import Similarity
from ghpt.geometry.upright import upright
from ghpt.models.relative_pose.scale import MEASURED_FRAMES
from ghpt.reconstruction import About, Reconstruction, State, concatenate, select_frames
from ghpt.skeleton import JOINTS

Seen = tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J"]]
"""Somebody's joints in some frames, and which of them are observed."""
WORLDS = ("cameras", "people", "first")
_WORDS = {
    "cameras": "the cameras' own",
    "people": "z up, the floor at 0, x where the first camera looks",
    "first": "that of the first camera: x right, y down, z forward",
}
_FEET = ("heel", "big_toe", "small_toe")


@dataclass(frozen=True)
class World:
    """A world, and the way there from the cameras'."""

    name: str
    change: Similarity
    """``X' = R X + t``, mm."""

    @property
    def words(self) -> str:
        """The world as people read it."""
        return _WORDS[self.name]

    def reconstruction(self, part: Reconstruction) -> Reconstruction:
        """Return a part of a reconstruction in this world."""
        if self.name == "cameras":
            return part
        return replace(
            part,
            points=self.change.points(part.points),
            covariance=_rotate(part.covariance, self.change.R.to(part.covariance)),
        )

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras in this world."""
        return cameras if self.name == "cameras" else self.change.cameras(cameras)

    def about(self, about: About) -> About:
        """Return what holds for all frames, in this world."""
        if self.name == "cameras":
            return about
        return replace(about, origin=(0.0, 0.0, 0.0), world=self.words)

    def numbers(self) -> dict[str, Any]:
        """Return the world as plain data."""
        return {
            "name": self.name,
            "axes": self.words,
            "R": self.change.R.tolist(),
            "t_mm": self.change.t.tolist(),
        }


def _rotate(covariance: Float[Tensor, "T J 6"], R: Float[Tensor, "3 3"]) -> Float[Tensor, "T J 6"]:
    """Return covariances xx xy xz yy yz zz about other axes."""
    full = covariance[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
    turned = (R @ full @ R.mT).flatten(-2)
    return turned[..., [0, 1, 2, 4, 5, 8]]


def choose_world(
    name: str,
    floor: list[str] | None,
    cameras: Cameras,
    joints: tuple[str, ...],
    chunks: Chunks,
    total: int,
    others: Iterable[Seen] = (),
) -> World:
    """Return the world ``name``: ``cameras``, ``people`` or ``first``.

    ``people`` is that of `upright`, on evenly spread frames of the ``total`` and of the
    ``others``, more people with the same joints. ``floor``: the joints
    that stand on it; None: heels and toes where they are observed, else the ankles. Raises
    GhptConfigError for one that is no joint, or that is never observed.
    """
    identity = torch.eye(3, dtype=torch.float64)
    if name == "first":
        first = cameras.index(0).to(torch.float64)
        return World(name, Similarity(first.R, 1.0, first.t))
    if name == "cameras":
        return World(name, Similarity(identity, 1.0, torch.zeros(3, dtype=torch.float64)))
    poses = _sample(chunks, total)
    observed = poses.state == State.OBSERVED
    feet = _feet(floor, joints, observed)
    everybody = [(poses.points, observed), *others]
    points = torch.cat([of_one for of_one, _ in everybody])
    known = torch.cat([of_one for _, of_one in everybody])
    at = [joints.index(foot) for foot in feet]
    human = torch.tensor([joints.index(name) if name in joints else -1 for name in JOINTS])
    change = upright(
        points[:, human],
        known[:, human] & (human >= 0),
        cameras.to(torch.float64),
        points[:, at][known[:, at]] if at else None,
    )
    return World(name, change)


def _feet(floor: list[str] | None, joints: tuple[str, ...], observed: Tensor) -> list[str]:
    """Return the names of the joints that stand on the floor; none: the ankles."""
    for name in floor or ():
        hint = f"The joints are {', '.join(joints)}."
        check(name in joints, "floor", f"{name!r} is no joint of this recording", hint)
    sided = [name for name in joints if name.partition("_")[2] in _FEET]
    wanted = floor or sided
    at = [joints.index(name) for name in wanted]
    seen = bool(observed[:, at].any())
    check(seen or not floor, "floor", "none of these joints is observed", "Name others.")
    return wanted if seen else []


def _sample(chunks: Chunks, total: int) -> Reconstruction:
    """Return at most ``MEASURED_FRAMES`` frames, evenly spread."""
    step = max(1, -(-total // MEASURED_FRAMES))
    parts = []
    frames = 0
    for chunk in chunks():
        rows = torch.arange(-frames % step, len(chunk), step)
        parts.append(select_frames(chunk, rows))
        frames += len(chunk)
    return concatenate(parts)
