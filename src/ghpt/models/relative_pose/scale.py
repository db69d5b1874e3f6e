"""Millimetres per unit of length: what gives a relative pose or a rig its scale."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.data.synthetic import body
from ghpt.data.synthetic.body import pose, random_body
from ghpt.errors import check
from ghpt.geometry.cameras import Cameras
from ghpt.geometry.triangulation import triangulate
from ghpt.observations import PairObservations, RelativePoseEstimate
from ghpt.skeleton import BONES, JOINTS

_PARTS = {
    "shank": ("ankle", "knee"),
    "thigh": ("knee", "hip"),
    "upper_arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "hip": ("hip", "pelvis"),
    "clavicle": ("thorax", "shoulder"),
    "lumbar": ("pelvis", "spine"),
    "thorax": ("spine", "thorax"),
    "neck": ("thorax", "head_top"),
}


def _name(bone: tuple[int, int]) -> str:
    names = [JOINTS[joint] for joint in bone]
    side = next((f"{s}_" for s in ("right", "left") for n in names if n.startswith(s)), "")
    kinds = tuple(name.removeprefix("right_").removeprefix("left_") for name in names)
    return side + next((part for part, ends in _PARTS.items() if ends == kinds), "_".join(kinds))


BONE_NAMES = tuple(map(_name, BONES))
"""Names of the parts in the order of ``ghpt.skeleton.BONES``: right_shank, right_thigh, right_hip
(to the pelvis), the same of the left, lumbar, thorax, neck (to the head's top), head_top_nose,
right_clavicle, right_upper_arm, right_forearm, and of the left.
"""

STATURES = (900.0, 2300.0)
"""mm: from a child of four years, whose limbs are short for its height, to the tallest. What is
measured beyond is worth a look."""

HUMAN = (600.0, 2800.0)
"""mm: beyond, a measured stature is nobody's: the unit of length is wrong."""

MEASURED_FRAMES = 300
"""At most so many, evenly spread, give the stature of the person in a recording, in every command.
"""

LIMBS = ("shank", "thigh", "upper_arm", "forearm")
"""The parts whose ends detectors define alike."""


@cache
def typical_lengths() -> tuple[float, ...]:
    """The lengths of an average adult's parts in statures, in the order of BONES."""
    one, other = np.array(BONES).T
    lengths = []
    for number in range(
        256
    ):  # the median of many people is the model's average, whatever a person is made of
        adult = random_body(np.random.default_rng(number))
        standing = pose(adult, np.zeros((1, len(body.SEGMENTS), 3)))[0] / adult.stature
        lengths.append(np.linalg.norm(standing[one] - standing[other], axis=-1))
    return tuple(np.median(lengths, axis=0).tolist())


@cache
def average_lengths() -> tuple[float, ...]:
    """The same of the limbs alone; 0 for other parts, whose ends each detector puts elsewhere."""
    lengths = zip(BONE_NAMES, typical_lengths(), strict=True)
    return tuple(length if name.split("_", 1)[-1] in LIMBS else 0.0 for name, length in lengths)


def bone_scales(
    points: Float[Tensor, "*B M J 3"],
    estimated: Bool[Tensor, "*B M J"],
    lengths: Float[Tensor, " L"],
) -> Float[Tensor, "*B L"]:
    """For each part its known length over the median of its measured ones; NaN where unknown or
    never measured.
    """
    one, other = torch.tensor(BONES, device=points.device).T
    measured = (points[..., one, :] - points[..., other, :]).double().norm(dim=-1)
    both = estimated[..., one] & estimated[..., other] & torch.isfinite(measured)
    shown = torch.where(both, measured, torch.nan)
    shown = torch.nn.functional.pad(shown, (0, 0, 0, 1), value=torch.nan)  # of no poses, no median
    middle = shown.nanmedian(-2).values
    known = torch.where(lengths > 0, lengths.double(), torch.nan).to(points.device)
    return torch.where(middle > 0, known / middle, torch.nan)


def body_scale(
    points: Float[Tensor, "*B M J 3"],
    estimated: Bool[Tensor, "*B M J"],
    lengths: Float[Tensor, " L"],
) -> Float[Tensor, "*B"]:
    """mm per unit of ``points``: the median over the parts of known length (mm, in the order of
    BONES; NaN or 0 where unknown) of that length over the median measured one; 0 where no known
    part was measured.
    """
    return bone_scales(points, estimated, lengths).nanmedian(-1).values.nan_to_num(0.0)


def stature(
    points: Float[Tensor, "*B M J 3"], estimated: Bool[Tensor, "*B M J"]
) -> Float[Tensor, "*B"]:
    """The stature of the person in view from its limbs, in the unit of ``points``; 0 where no limb
    was measured.
    """
    scale = body_scale(points, estimated, torch.tensor(average_lengths(), dtype=torch.float64))
    return torch.where(scale > 0, 1 / torch.where(scale > 0, scale, 1.0), 0.0)


class Scale(ABC):
    """``scale(estimate, batch)``: mm per unit of each estimate's t, float64; 0 where nothing
    determines it.
    """

    @abstractmethod
    def __call__(
        self, estimate: RelativePoseEstimate, batch: PairObservations
    ) -> Float[Tensor, "*B"]: ...


class KnownScale(Scale):
    """The true length of the pair's t, as in the paper."""

    def __call__(
        self, estimate: RelativePoseEstimate, batch: PairObservations
    ) -> Float[Tensor, "*B"]:
        length = estimate.t.double().norm(dim=-1)
        baseline = batch.baseline.reshape(-1, *[1] * (length.ndim - 1)).expand(length.shape)
        scale = baseline / torch.where(length > 0, length, 1.0)
        return torch.where(estimate.estimated & (length > 0), scale, 0.0)


class BodyScale(Scale):
    """The person triangulated by the pair, against lengths (mm, in the order of BONES; 0:
    unknown)."""

    lengths: tuple[float, ...]

    @torch.no_grad()
    def __call__(
        self, estimate: RelativePoseEstimate, batch: PairObservations
    ) -> Float[Tensor, "*B"]:
        key_points = batch.select_pair(batch.key_points)
        valid = batch.select_pair(batch.valid)
        K = batch.select_pair(batch.K).double()
        lengths = torch.tensor(self.lengths, dtype=torch.float64)
        scales = [
            self._of_pair(
                estimate.R[i].double(),
                estimate.t[i].double(),
                K[i],
                key_points[i],
                valid[i],
                lengths,
            )
            for i in range(
                len(batch)
            )  # pair by pair: the memory of all hypotheses' people at once is gigabytes
        ]
        scale = (
            torch.stack(scales)
            if scales
            else estimate.t.new_zeros(estimate.t.shape[:-1], dtype=torch.float64)
        )
        return torch.where(estimate.estimated, scale, 0.0)

    @staticmethod
    def _of_pair(
        R: Float[Tensor, "*H 3 3"],
        t: Float[Tensor, "*H 3"],
        K: Float[Tensor, "2 3 3"],
        key_points: Float[Tensor, "2 M J 2"],
        valid: Bool[Tensor, "2 M J"],
        lengths: Float[Tensor, " L"],
    ) -> Float[Tensor, "*H"]:
        leading = R.shape[:-2]
        shape = valid.shape[1:]
        world = torch.eye(3, dtype=R.dtype, device=R.device).expand_as(R), torch.zeros_like(t)
        cameras = Cameras(
            K.expand(*leading, 2, 3, 3),
            torch.stack((world[0], R), dim=-3),
            torch.stack((world[1], t), dim=-2),
        )
        pixels = key_points.double().flatten(1, 2)
        weights = valid.all(0).flatten().double().expand(*leading, 2, -1)
        result = triangulate(cameras, pixels.expand(*leading, *pixels.shape), weights)
        return body_scale(
            result.points.unflatten(-2, shape), result.ok.unflatten(-1, shape), lengths
        )


class BodyHeight(BodyScale):
    """The limbs of an average adult of this height (mm): proportions differ by about 3 % between
    people.
    """

    def __init__(self, mm: float) -> None:
        low, high = HUMAN
        hint = f"Give the person's height in millimetres, {low:g} to {high:g}."
        check(low <= mm <= high, "mm", f"is {mm}, which is nobody's height", hint)
        self.lengths = tuple(mm * length for length in average_lengths())


class BoneLengths(BodyScale):
    """Measured lengths (mm) by name: ``BONE_NAMES``, or without the side for both (``thigh:
    430``)."""

    def __init__(self, lengths: Mapping[str, float]) -> None:
        hint = f"Choose from {', '.join(BONE_NAMES)}, or leave out right_ or left_ for both."
        check(len(lengths) > 0, "lengths", "is empty", hint)
        found = dict.fromkeys(BONE_NAMES, 0.0)
        for name, mm in lengths.items():
            own = [
                s
                for s in BONE_NAMES
                if s == name or s.removeprefix("right_").removeprefix("left_") == name
            ]
            check(bool(own), "lengths", f"names {name!r}, which is no part of the body", hint)
            check(mm > 0, "lengths", f"says {name} is {mm}", "Give lengths in millimetres.")
            found |= dict.fromkeys(own, float(mm))
        self.lengths = tuple(found[name] for name in BONE_NAMES)
