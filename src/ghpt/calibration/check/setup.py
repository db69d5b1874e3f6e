"""How key points and cameras belong together: as the files say, or with a mistake undone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.check.evidence import Evidence
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import undistort
from ghpt.models.estimators.classical import person_scale
from ghpt.skeleton import MIRROR

_FAR = 1e5
"""Pixels."""


@dataclass(frozen=True)
class Setup:
    """V cameras and what each is shown."""

    K: Float[Tensor, "V 3 3"]
    lens: Float[Tensor, "V 5"]
    R: Float[Tensor, "V 3 3"]
    t: Float[Tensor, "V 3"]
    source: tuple[int, ...]
    """Whose key points each camera gets."""
    shift: tuple[int, ...]
    """By how many frames these are taken later."""
    mirrored: tuple[bool, ...]
    """Whether u is counted from the image's right edge."""
    sides: tuple[bool, ...]
    """Whether left and right joints are exchanged."""
    width: tuple[float, ...]
    """Of the images, pixels."""
    rate: tuple[float, ...]
    """How many times as fast as the others' the numbers of its frames count."""
    unit_mm: float | None
    """mm: what the file's unit was taken for, where it does not say; else None."""

    def __len__(self) -> int:
        return len(self.shift)

    def changed(self, view: int, **values: Any) -> Setup:
        """With other values for one camera."""
        new: dict[str, Any] = {}
        for name, value in values.items():
            old = getattr(self, name)
            if isinstance(old, Tensor):
                new[name] = old.clone()
                new[name][view] = value
            else:
                new[name] = (*old[:view], value, *old[view + 1 :])
        return replace(self, **new)


def as_filed(cameras: CameraSet) -> Setup:
    """What the files say."""
    rig = cameras.cameras
    views = len(cameras)
    width = 2 * cameras.K[:, 0, 2] + 1 if cameras.size is None else cameras.size[:, 0].double()
    off = (False,) * views
    return Setup(
        cameras.K,
        cameras.distortion,
        rig.R,
        rig.t,
        tuple(range(views)),
        (0,) * views,
        off,
        off,
        tuple(width.tolist()),
        (1.0,) * views,
        None if cameras.unit_known else cameras.unit_mm,
    )


@dataclass(frozen=True)
class Rays:
    """What cameras see in normalised image coordinates, x_cam / z_cam."""

    xy: Float[Tensor, "*B F J 2"]
    valid: Bool[Tensor, "*B F J"]
    size: Float[Tensor, "*B F"]
    """The person's, the unit of all errors; 0 where it is not seen."""


@dataclass
class Look:
    """Rays of the evidence, each view's kept, because a search asks for the same ones again."""

    evidence: Evidence
    _kept: dict[tuple, Rays] = field(default_factory=dict)

    def view(self, setup: Setup, view: int) -> Rays:
        """One view of a setup."""
        return self._one(setup, view, setup.shift[view])

    def all(self, setup: Setup) -> Rays:
        """All views of a setup: leading dimension V."""
        return _stack([self.view(setup, view) for view in range(len(setup))])

    def prepare(self, setup: Setup, view: int) -> None:
        """Look at one view at all shifts at once, which is many times faster than one by one."""
        shifts = range(-self.evidence.max_shift, self.evidence.max_shift + 1)
        if all(self._key(setup, view, shift) in self._kept for shift in shifts):
            return
        pixels, valid = self._pixels(setup, view, slice(None))
        whole = rays(pixels.flatten(0, 1), valid.flatten(0, 1), setup.K[view], setup.lens[view])
        parts = (x.unflatten(0, valid.shape[:2]) for x in (whole.xy, whole.valid, whole.size))
        for shift, part in zip(shifts, zip(*parts, strict=True), strict=True):
            self._kept[self._key(setup, view, shift)] = Rays(*part)

    def _one(self, setup: Setup, view: int, shift: int) -> Rays:
        if abs(shift) > self.evidence.max_shift:
            raise ValueError(
                f"a shift of {shift} frames is beyond the evidence's {self.evidence.max_shift}"
            )
        key = self._key(setup, view, shift)
        if key not in self._kept:
            pixels, valid = self._pixels(setup, view, self.evidence.max_shift + shift)
            self._kept[key] = rays(pixels, valid, setup.K[view], setup.lens[view])
        return self._kept[key]

    @staticmethod
    def _key(setup: Setup, view: int, shift: int) -> tuple:
        how = setup.source[view], shift, setup.mirrored[view], setup.sides[view], setup.rate[view]
        return (*how, *setup.K[view].flatten().tolist(), *setup.lens[view].tolist())

    def _pixels(self, setup: Setup, view: int, at: int | slice) -> tuple[Tensor, Tensor]:
        source = setup.source[view]
        evidence = self.evidence
        if setup.rate[view] == 1 or evidence.at_rate is None:
            pixels = evidence.pixels[source][at]
            valid = evidence.valid[source][at]
        else:
            pixels, valid = (values[at] for values in evidence.at_rate(source, setup.rate[view]))
        if setup.mirrored[view]:
            pixels = torch.stack((setup.width[view] - 1 - pixels[..., 0], pixels[..., 1]), dim=-1)
        if setup.sides[view]:
            pixels = pixels[..., list(MIRROR), :]
            valid = valid[..., list(MIRROR)]
        return pixels, valid


def rays(
    pixels: Float[Tensor, "F J 2"],
    valid: Bool[Tensor, "F J"],
    K: Float[Tensor, "3 3"],
    lens: Float[Tensor, " 5"],
) -> Rays:
    """Pixels out of the lens; those that no ray reaches are not seen."""
    straight, valid = ideal(pixels, valid, K, lens)
    xy = torch.linalg.solve(K, torch.nn.functional.pad(straight, (0, 1), value=1.0).mT).mT[..., :2]
    xy = torch.where(valid[..., None], xy, 0.0)
    return Rays(xy, valid, person_scale(xy, valid))


def ideal(
    pixels: Float[Tensor, "*B J 2"],
    valid: Bool[Tensor, "*B J"],
    K: Float[Tensor, "3 3"],
    lens: Float[Tensor, " 5"],
) -> tuple[Float[Tensor, "*B J 2"], Bool[Tensor, "*B J"]]:
    """Pinhole pixels of pixels seen through a lens, and which of them are seen and exist."""
    valid = valid & (pixels.abs() < _FAR).all(-1)
    if not lens.any():
        return pixels, valid
    safe = torch.where(valid[..., None], pixels, K[:2, 2])
    straight, exists = undistort(safe.flatten(0, -2), K, lens)
    return straight.reshape(pixels.shape), valid & exists.reshape(valid.shape)


def _stack(each: list[Rays]) -> Rays:
    return Rays(
        *(torch.stack([getattr(one, name) for one in each]) for name in ("xy", "valid", "size"))
    )
