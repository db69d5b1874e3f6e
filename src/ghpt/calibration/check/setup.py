"""How key points and cameras belong together: as the files say, or with a mistake undone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.calibration.check.evidence import Evidence
from ghpt.geometry.cameras import CameraSet
from ghpt.geometry.lens import is_fisheye, undistort
from ghpt.models.estimators.classical import person_scale
from ghpt.skeleton import MIRROR

_QUARTER = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""The rotation of a camera whose image is turned clockwise by 90 degrees."""
_FAR = 1e5
"""Pixels; a key point beyond is none."""


@dataclass(frozen=True)
class Setup:
    """V cameras, and which key points each of them is given, and how."""

    K: Float[Tensor, "V 3 3"]
    lens: Float[Tensor, "V C"]
    R: Float[Tensor, "V 3 3"]
    t: Float[Tensor, "V 3"]
    source: tuple[int, ...]
    """The view whose key points each camera is given."""
    shift: tuple[int, ...]
    """The number of frames by which these are taken later."""
    mirrored: tuple[bool, ...]
    """Whether u is counted from the image's right edge."""
    sides: tuple[bool, ...]
    """Whether left and right joints are exchanged."""
    width: tuple[float, ...]
    """Of the images, pixels."""
    height: tuple[float, ...]
    """The same."""
    rate: tuple[float, ...]
    """How many times as fast as the others' the numbers of its frames count."""
    unit_mm: float | None
    """The length (mm) that the file's unit was taken for, where it does not say it; else None."""

    def __len__(self) -> int:
        return len(self.shift)

    def replace_camera(self, view: int, **values: Any) -> Setup:
        """Return the setup with other values for one camera."""
        new: dict[str, Any] = {}
        for name, value in values.items():
            old = getattr(self, name)
            if isinstance(old, Tensor):
                new[name] = old.clone()
                new[name][view] = value
            else:
                new[name] = (*old[:view], value, *old[view + 1 :])
        return replace(self, **new)

    def turn_images(self, views: tuple[int, ...], degrees: int) -> Setup:
        """Return the cameras whose images are those of ``views`` turned clockwise by a multiple of
        90 degrees. A K with skew stays as it is.
        """
        setup = self
        for _ in range(degrees // 90):
            for view in views:
                setup = setup._turn_once(view)
        return setup

    def _turn_once(self, view: int) -> Setup:
        """Return one camera with an image turned by 90 degrees: (u, v) is at (height - 1 - v, u)
        then, and (x, y) at (-y, x).
        """
        K = self.K[view]
        if K[0, 1] != 0:
            return self
        turned_K = K.clone()
        turned_K[0, 0] = K[1, 1]
        turned_K[1, 1] = K[0, 0]
        turned_K[0, 2] = self.height[view] - 1 - K[1, 2]
        turned_K[1, 2] = K[0, 2]
        turn = torch.tensor(_QUARTER, dtype=K.dtype)
        lens = self.lens[view].clone()
        if not bool(is_fisheye(lens)):  # (p2, p1) is a vector of the image
            lens[3] = -self.lens[view, 2]
            lens[2] = self.lens[view, 3]
        return self.replace_camera(
            view,
            K=turned_K,
            R=turn @ self.R[view],
            t=turn @ self.t[view],
            lens=lens,
            width=self.height[view],
            height=self.width[view],
        )

    def transform_as(
        self,
        view: int,
        pixels: Float[Tensor, "*B J 2"],
        valid: Bool[Tensor, "*B J"],
    ) -> tuple[Float[Tensor, "*B J 2"], Bool[Tensor, "*B J"]]:
        """Return the key points of its source as a camera is given them: mirrored, or with left
        and right joints exchanged, where the setup says so.
        """
        if self.mirrored[view]:
            u = self.width[view] - 1 - pixels[..., 0]
            pixels = torch.stack((u, pixels[..., 1]), dim=-1)
        if self.sides[view]:
            pixels = pixels[..., list(MIRROR), :]
            valid = valid[..., list(MIRROR)]
        return pixels, valid


def setup_of(cameras: CameraSet) -> Setup:
    """Return what a camera file says. Raises GhptDataError where it has no extrinsics."""
    setup = setup_of_intrinsics(cameras.K, cameras.size)
    rig = cameras.cameras
    unit = None if cameras.unit_known else cameras.unit_mm
    return replace(setup, lens=cameras.distortion, R=rig.R, t=rig.t, unit_mm=unit)


def setup_of_intrinsics(K: Float[Tensor, "V 3 3"], size: Int[Tensor, "V 2"] | None) -> Setup:
    """Return cameras without lenses that all stand at the world's zero.

    ``size``: of the images; None where it is not known, and twice the principal point then.
    """
    views = len(K)
    image = 2 * K[:, :2, 2] + 1 if size is None else size.double()
    no = (False,) * views
    return Setup(
        K=K,
        lens=torch.zeros(views, 5, dtype=torch.float64),
        R=torch.eye(3, dtype=torch.float64).repeat(views, 1, 1),
        t=torch.zeros(views, 3, dtype=torch.float64),
        source=tuple(range(views)),
        shift=(0,) * views,
        mirrored=no,
        sides=no,
        width=tuple(image[:, 0].tolist()),
        height=tuple(image[:, 1].tolist()),
        rate=(1.0,) * views,
        unit_mm=None,
    )


@dataclass(frozen=True)
class Rays:
    """What cameras see in normalised image coordinates, x_cam / z_cam."""

    xy: Float[Tensor, "*B F J 2"]
    valid: Bool[Tensor, "*B F J"]
    size: Float[Tensor, "*B F"]
    """The person's, the unit of all errors; 0 where it is not seen."""


@dataclass
class RayCache:
    """The rays of the evidence. Each view's are kept: a search asks for the same ones again.

    Raises ValueError for a shift that is larger than the evidence's largest.
    """

    evidence: Evidence
    _kept: dict[tuple[object, ...], Rays] = field(default_factory=dict)

    def view(self, setup: Setup, view: int) -> Rays:
        """Return the rays of one view."""
        shift = setup.shift[view]
        largest = self.evidence.max_shift
        if abs(shift) > largest:
            raise ValueError(f"a shift of {shift} frames is beyond the evidence's {largest}")
        key = self._key(setup, view, shift)
        if key not in self._kept:
            pixels, valid = self._pixels(setup, view, largest + shift)
            self._kept[key] = rays_of(pixels, valid, setup.K[view], setup.lens[view])
        return self._kept[key]

    def all(self, setup: Setup) -> Rays:
        """Return the rays of all views, with leading dimension V."""
        each = [self.view(setup, view) for view in range(len(setup))]
        xy = torch.stack([rays.xy for rays in each])
        valid = torch.stack([rays.valid for rays in each])
        size = torch.stack([rays.size for rays in each])
        return Rays(xy, valid, size)

    def prepare(self, setup: Setup, view: int) -> None:
        """Compute one view's rays at all shifts at once, many times faster than one by one."""
        shifts = range(-self.evidence.max_shift, self.evidence.max_shift + 1)
        if all(self._key(setup, view, shift) in self._kept for shift in shifts):
            return
        pixels, valid = self._pixels(setup, view, slice(None))
        shape = valid.shape[:2]
        flat = rays_of(pixels.flatten(0, 1), valid.flatten(0, 1), setup.K[view], setup.lens[view])
        xy = flat.xy.unflatten(0, shape)
        seen = flat.valid.unflatten(0, shape)
        size = flat.size.unflatten(0, shape)
        for number, shift in enumerate(shifts):
            key = self._key(setup, view, shift)
            self._kept[key] = Rays(xy[number], seen[number], size[number])

    @staticmethod
    def _key(setup: Setup, view: int, shift: int) -> tuple[object, ...]:
        return (
            setup.source[view],
            shift,
            setup.mirrored[view],
            setup.sides[view],
            setup.rate[view],
            *setup.K[view].flatten().tolist(),
            *setup.lens[view].tolist(),
        )

    def _pixels(self, setup: Setup, view: int, at: int | slice) -> tuple[Tensor, Tensor]:
        source = setup.source[view]
        evidence = self.evidence
        if setup.rate[view] == 1 or evidence.at_rate is None:
            pixels = evidence.pixels[source]
            valid = evidence.valid[source]
        else:
            pixels, valid = evidence.at_rate(source, setup.rate[view])
        return setup.transform_as(view, pixels[at], valid[at])


def rays_of(
    pixels: Float[Tensor, "F J 2"],
    valid: Bool[Tensor, "F J"],
    K: Float[Tensor, "3 3"],
    lens: Float[Tensor, " C"],
) -> Rays:
    """Return the rays of pixels through a lens; a pixel that no ray reaches is not valid."""
    straight, valid = ideal(pixels, valid, K, lens)
    homogeneous = torch.nn.functional.pad(straight, (0, 1), value=1.0)
    xy = torch.linalg.solve(K, homogeneous.mT).mT[..., :2]
    xy = torch.where(valid[..., None], xy, 0.0)
    return Rays(xy, valid, person_scale(xy, valid))


def ideal(
    pixels: Float[Tensor, "*B J 2"],
    valid: Bool[Tensor, "*B J"],
    K: Float[Tensor, "3 3"],
    lens: Float[Tensor, " C"],
) -> tuple[Float[Tensor, "*B J 2"], Bool[Tensor, "*B J"]]:
    """Return the pinhole pixels of pixels through a lens, and which of them exist."""
    valid = valid & (pixels.abs() < _FAR).all(-1)
    if not lens.any():
        return pixels, valid
    safe = torch.where(valid[..., None], pixels, K[:2, 2])
    straight, exists = undistort(safe.flatten(0, -2), K, lens)
    return straight.reshape(pixels.shape), valid & exists.reshape(valid.shape)
