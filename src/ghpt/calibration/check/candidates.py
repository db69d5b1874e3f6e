"""The mistakes that people make with cameras and views, each undone: what the doctor tries."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.calibration.check.setup import Setup
from ghpt.calibration.repair import RESOLUTIONS
from ghpt.geometry.cameras import camera_centre

UNITS = {
    1e3: "metres for millimetres",
    1e2: "decimetres for millimetres",
    1e1: "centimetres for millimetres",
    1e-1: "ten times too large",
    1e-2: "a hundred times too large",
    1e-3: "millimetres for metres",
}
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
_FPS = (24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0)
RADIAL = tuple(k / 20 for k in range(-9, 10) if k)
"""k1 of the lenses that are tried."""


RATES = tuple(sorted({a / b for a in _FPS for b in _FPS if a != b and 0.2 < a / b < 5}))
"""Ratios of the frame rates that cameras offer."""


@dataclass(frozen=True)
class Candidate:
    """A setup with one mistake undone."""

    code: str
    views: tuple[int, ...]
    """Those it changes; empty: all alike."""
    text: str
    """What is wrong, with {camera} and {other} for names, and the mend."""
    setup: Setup
    value: float
    """The mistake's own number: frames, ratio, k1; 0 where it has none."""
    fitted: bool = False
    """Whether it was fitted to the key points rather than being one of few possibilities."""


def _transposed(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    return R.mT, t


def _from_centre(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    return R, -(R @ t[..., None])[..., 0]


def _inverse(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    return R.mT, camera_centre(R, t)


def _flipped(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    return _FLIP @ R, t @ _FLIP


def _flipped_inverse(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    return _flipped(*_inverse(R, t))


POSES: dict[str, tuple[Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], str]] = {
    "rotation_transposed": (
        _transposed,
        "R of {camera} is camera to world where world to camera is wanted; transpose R",
    ),
    "centre_for_translation": (
        _from_centre,
        "t of {camera} is the camera's centre C; give t = -R C",
    ),
    "camera_to_world": (
        _inverse,
        "R and t of {camera} are camera to world; invert them: R^T and -R^T t",
    ),
    "axes_flipped": (
        _flipped,
        "the axes of {camera} are y up, z backward (OpenGL); turn them: y down, z forward",
    ),
    "camera_to_world_flipped": (
        _flipped_inverse,
        "R and t of {camera} are camera to world with y up and z backward "
        "(OpenGL, Blender); invert them, then turn y and z",
    ),
}


def of_file(setup: Setup) -> Iterator[Candidate]:
    """Mistakes that concern all cameras alike."""
    every = "all cameras"
    for code, (hint, text) in POSES.items():
        R, t = hint(setup.R, setup.t)
        yield Candidate(code, (), text.replace("{camera}", every), replace(setup, R=R, t=t), 0.0)
    for ratio in RESOLUTIONS:
        text = f"intrinsics of all cameras fit the key points when scaled by {ratio:.3g}; give both at one resolution"
        yield Candidate("resolution", (), text, replace(setup, K=_scaled(setup.K, ratio)), ratio)
    if setup.lens.any():
        text = "key points of all cameras are undistorted already; give no distortion with them"
        yield Candidate(
            "already_undistorted", (), text, replace(setup, lens=torch.zeros_like(setup.lens)), 0.0
        )
    for k1 in RADIAL:
        yield Candidate(
            "lens",
            (),
            f"lenses of all cameras do not fit: k1 = {k1:g} fits better; calibrate them",
            replace(setup, lens=_radial(k1).expand_as(setup.lens).clone()),
            k1,
            True,
        )
    mirrored = replace(setup, mirrored=tuple(not m for m in setup.mirrored))
    text = "the images of all cameras are mirrored; give u as width - 1 - u"
    yield Candidate("mirrored_key_points", (), text, mirrored, 0.0)
    yield Candidate(
        "mirrored_image",
        (),
        f"{text}, with left and right joints exchanged",
        replace(mirrored, sides=tuple(not s for s in setup.sides)),
        0.0,
    )


def of_view(setup: Setup, view: int) -> Iterator[Candidate]:
    """Mistakes that concern one camera, but for shifts, exchanges and its place."""
    R = setup.R[view]
    t = setup.t[view]
    K = setup.K[view]
    for code, (hint, text) in POSES.items():
        turned, moved = hint(R, t)
        yield Candidate(code, (view,), text, setup.changed(view, R=turned, t=moved), 0.0)
    for factor, words in UNITS.items():
        text = f"t of {{camera}} is in another unit than the others' ({words}); multiply it by {factor:g}"
        yield Candidate("unit", (view,), text, setup.changed(view, t=factor * t), factor)
    for ratio in RESOLUTIONS:
        text = f"intrinsics of {{camera}} fit its key points when scaled by {ratio:.3g}; give both at one resolution"
        yield Candidate(
            "resolution", (view,), text, setup.changed(view, K=_scaled(K, ratio)), ratio
        )
    if setup.lens[view].any():
        text = "key points of {camera} are undistorted already; give no distortion with them"
        yield Candidate(
            "already_undistorted",
            (view,),
            text,
            setup.changed(view, lens=torch.zeros_like(setup.lens[view])),
            0.0,
        )
    for k1 in RADIAL:
        text = f"the lens of {{camera}} does not fit: k1 = {k1:g} fits better; calibrate its intrinsics"
        yield Candidate("lens", (view,), text, setup.changed(view, lens=_radial(k1)), k1, True)
    mirrored = not setup.mirrored[view]
    sides = not setup.sides[view]
    text = "left and right joints of {camera} are exchanged; exchange them back"
    yield Candidate("sides_swapped", (view,), text, setup.changed(view, sides=sides), 0.0)
    text = "key points of {camera} are those of a mirrored image; give u as width - 1 - u"
    yield Candidate(
        "mirrored_key_points", (view,), text, setup.changed(view, mirrored=mirrored), 0.0
    )
    text = "the image of {camera} is mirrored; give u as width - 1 - u with left and right joints exchanged"
    yield Candidate(
        "mirrored_image", (view,), text, setup.changed(view, mirrored=mirrored, sides=sides), 0.0
    )


def shifted(setup: Setup, view: int, by: int) -> Candidate:
    """Out of step: ``by`` frames later than now."""
    total = setup.shift[view] + by
    way = "late" if total > 0 else "early"
    text = (
        f"{{camera}} is {abs(total)} frames {way}: its frame n{total:+d} goes with frame n of the others; "
        "shift its frames"
    )
    return Candidate("out_of_sync", (view,), text, setup.changed(view, shift=total), float(total))


def at_rate(setup: Setup, view: int, ratio: float) -> Candidate:
    """Of another frame rate than the others."""
    text = (
        f"{{camera}} has another frame rate: {ratio:.3g} of its frames go with one of the others' "
        "(frame numbers must be of one clock)"
    )
    return Candidate("frame_rate", (view,), text, setup.changed(view, rate=ratio), ratio)


def exchanged(setup: Setup, one: int, other: int) -> Candidate:
    """Two cameras with each other's key points, and all that goes with these."""
    new = setup
    for a, b in ((one, other), (other, one)):
        new = new.changed(
            a,
            source=setup.source[b],
            shift=setup.shift[b],
            sides=setup.sides[b],
            rate=setup.rate[b],
        )
    text = "key points of {camera} are those of {other}, and the reverse; exchange the two names"
    return Candidate("views_swapped", (one, other), text, new, 0.0)


def _scaled(K: Float[Tensor, "*B 3 3"], ratio: float) -> Float[Tensor, "*B 3 3"]:
    return K * torch.tensor([ratio, ratio, 1.0], dtype=K.dtype)[:, None]


def _radial(k1: float) -> Float[Tensor, " 5"]:
    return torch.tensor([k1, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
