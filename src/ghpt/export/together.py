"""Several people as one reconstruction: what a picture of everybody shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from ghpt.export.npz import read_reconstruction
from ghpt.export.stream import Chunks
from ghpt.reconstruction import About, Reconstruction

_OF = " of person "


def joint_of(person: int, name: str) -> str:
    """Return the name of a person's joint among everybody's; the first person's is the joint's."""
    return f"{name}{_OF}{person}" if person else name


def persons_of(joints: Sequence[str]) -> list[list[int]]:
    """Return the places of each person's joints, in names that `joint_of` gave."""
    persons: dict[str, list[int]] = {}
    for place, name in enumerate(joints):
        persons.setdefault(name.partition(_OF)[2], []).append(place)
    return list(persons.values())


def put_together(name: str, paths: Sequence[Path]) -> tuple[About, Chunks]:
    """Return what npz files of people with the same frames and views hold, as one reconstruction.

    ``name`` is that of the whole. Raises GhptDataError as `read_reconstruction` does.
    """
    abouts = [read_reconstruction(path)[0] for path in paths]
    people = list(enumerate(abouts))
    joints = [joint_of(person, joint) for person, about in people for joint in about.joints]
    bones = [
        (joint_of(person, start), joint_of(person, end))
        for person, about in people
        for start, end in about.bones
    ]

    def chunks() -> Iterator[Reconstruction]:
        parts = [read_reconstruction(path)[1] for path in paths]
        return map(_merge, zip(*parts, strict=True))

    return replace(abouts[0], name=name, joints=tuple(joints), bones=tuple(bones)), chunks


def _merge(parts: Sequence[Reconstruction]) -> Reconstruction:
    """Return the same frames of several people as one. The score is the first person's."""
    return Reconstruction(
        frame=parts[0].frame,
        points=torch.cat([part.points for part in parts], dim=1),
        state=torch.cat([part.state for part in parts], dim=1),
        error=torch.cat([part.error for part in parts], dim=1),
        views=torch.cat([part.views for part in parts], dim=2),
        covariance=torch.cat([part.covariance for part in parts], dim=1),
        score=parts[0].score,
        flipped=torch.stack([part.flipped for part in parts]).any(0),
    )
