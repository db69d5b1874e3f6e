"""Good recordings spoilt on purpose, one mistake at a time, to demonstrate the camera check and to
test it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.check.evidence import Evidence
from ghpt.calibration.check.setup import Setup, ideal
from ghpt.calibration.mistakes import flip_axes, invert, radial_lens, transpose
from ghpt.geometry.cameras import camera_centre
from ghpt.geometry.lens import distort
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.skeleton import MIRROR

Views = tuple[int, ...]
Pose = tuple[Float[Tensor, "*B 3 3"], Float[Tensor, "*B 3"]]
_K1 = -0.25
_ROTATION_AXIS = (0.6, 0.8, 0.0)
_DIRECTION = (0.48, 0.6, 0.64)


@dataclass(frozen=True)
class Case:
    """What the camera check is given."""

    evidence: Evidence
    setup: Setup


def _centre_for_translation(R: Tensor, t: Tensor) -> Pose:
    return R, camera_centre(R, t)


def _camera_to_world_flipped(R: Tensor, t: Tensor) -> Pose:
    return invert(*flip_axes(R, t))


POSE_BREAKAGES: Mapping[str, Callable[[Tensor, Tensor], Pose]] = {
    "rotation_transposed": transpose,
    "centre_for_translation": _centre_for_translation,
    "camera_to_world": invert,
    "axes_flipped": flip_axes,
    "camera_to_world_flipped": _camera_to_world_flipped,
}
"""How a true pose becomes a wrong one, by the code of the mistake."""


def _spoil_pose(case: Case, views: Views, code: str) -> Case:
    at = list(views)
    R = case.setup.R.clone()
    t = case.setup.t.clone()
    R[at], t[at] = POSE_BREAKAGES[code](R[at], t[at])
    return replace(case, setup=replace(case.setup, R=R, t=t))


def _divide_translation(case: Case, views: Views, factor: float) -> Case:
    t = case.setup.t.clone()
    t[list(views)] /= factor
    return replace(case, setup=replace(case.setup, t=t))


def _scale_key_points(case: Case, views: Views, ratio: float) -> Case:
    pixels = case.evidence.pixels.clone()
    pixels[list(views)] *= ratio
    return replace(case, evidence=replace(case.evidence, pixels=pixels))


def _undistort(case: Case, views: Views) -> Case:
    setup = case.setup
    pixels = case.evidence.pixels.clone()
    valid = case.evidence.valid.clone()
    for view in views:
        pixels[view], valid[view] = ideal(
            pixels[view], valid[view], setup.K[view], setup.lens[view]
        )
    return replace(case, evidence=replace(case.evidence, pixels=pixels, valid=valid))


def _use_unknown_lens(case: Case, views: Views) -> Case:
    """Return the images through a lens that the file does not have."""
    ideal_case = _undistort(case, views)
    pixels = ideal_case.evidence.pixels.clone()
    lens = case.setup.lens.clone()
    for view in views:
        flat = pixels[view].flatten(0, -2)
        distorted = distort(flat, case.setup.K[view], radial_lens(_K1))
        pixels[view] = distorted.reshape(pixels[view].shape)
        lens[view] = 0.0
    evidence = replace(ideal_case.evidence, pixels=pixels)
    return Case(evidence, replace(case.setup, lens=lens))


def _move(case: Case, views: Views, degrees: float, millimetres: float) -> Case:
    axis = torch.tensor(_ROTATION_AXIS, dtype=torch.float64)
    rotation = vector_to_matrix(axis * torch.pi / 180 * degrees)
    displacement = millimetres * torch.tensor(_DIRECTION, dtype=torch.float64)
    setup = case.setup
    for view in views:
        centre = camera_centre(setup.R[view], setup.t[view]) + displacement
        R = rotation @ setup.R[view]
        setup = setup.replace_camera(view, R=R, t=-R @ centre)
    return replace(case, setup=setup)


def _delay(case: Case, views: Views, by: int) -> Case:
    """Return views whose frame n + by shows what the others' frame n shows."""
    pixels = case.evidence.pixels.clone()
    valid = case.evidence.valid.clone()
    empty = slice(0, by) if by > 0 else slice(by, None)
    for view in views:
        pixels[view] = pixels[view].roll(by, 0)
        valid[view] = valid[view].roll(by, 0)
        valid[view, empty] = False
    return replace(case, evidence=replace(case.evidence, pixels=pixels, valid=valid))


def _exchange_with_first(case: Case, views: Views) -> Case:
    order = list(range(len(case.setup)))
    order[0] = views[0]
    order[views[0]] = 0
    evidence = case.evidence
    return replace(
        case,
        evidence=replace(evidence, pixels=evidence.pixels[order], valid=evidence.valid[order]),
    )


def _turn(case: Case, views: Views, quarters: int) -> Case:
    """Return images that are turned clockwise."""
    pixels = case.evidence.pixels.clone()
    for view in views:
        sides = (case.setup.height[view], case.setup.width[view])
        for quarter in range(quarters):
            u, v = pixels[view].unbind(-1)
            pixels[view] = torch.stack((sides[quarter % 2] - 1 - v, u), dim=-1)
    return replace(case, evidence=replace(case.evidence, pixels=pixels))


def _mirror(case: Case, views: Views, image: bool, sides: bool) -> Case:
    pixels = case.evidence.pixels.clone()
    valid: Bool[Tensor, "V S F J"] = case.evidence.valid.clone()
    for view in views:
        if image:
            pixels[view, ..., 0] = case.setup.width[view] - 1 - pixels[view, ..., 0]
        if sides:
            pixels[view] = pixels[view][..., list(MIRROR), :]
            valid[view] = valid[view][..., list(MIRROR)]
    return replace(case, evidence=replace(case.evidence, pixels=pixels, valid=valid))


Spoil = Callable[[Case, Views], Case]


@dataclass(frozen=True)
class Breakage:
    """One way to spoil a recording."""

    code: str
    """The code of the finding that names it."""
    of_all: bool
    """Whether it is of all views, or of the last one alone."""
    spoil_views: Spoil

    def spoil(self, case: Case) -> Case:
        """Return the spoilt case; the recording that other frame rates are read from is dropped."""
        views = tuple(range(len(case.setup))) if self.of_all else (len(case.setup) - 1,)
        evidence = replace(case.evidence, at_rate=None)
        return self.spoil_views(replace(case, evidence=evidence), views)


def _of_all_or_one() -> dict[str, Breakage]:
    poses = {code: (code, partial(_spoil_pose, code=code)) for code in POSE_BREAKAGES}
    kinds: dict[str, tuple[str, Spoil]] = {
        **poses,
        "metres": ("unit", partial(_divide_translation, factor=1e3)),
        "centimetres": ("unit", partial(_divide_translation, factor=10.0)),
        "resolution": ("resolution", partial(_scale_key_points, ratio=0.5)),
        "already_undistorted": ("already_undistorted", _undistort),
        "lens_missing": ("lens", _use_unknown_lens),
        "turned_90": ("image_turned", partial(_turn, quarters=1)),
        "turned_180": ("image_turned", partial(_turn, quarters=2)),
        "turned_270": ("image_turned", partial(_turn, quarters=3)),
    }
    of_all = {kind: Breakage(code, True, spoil) for kind, (code, spoil) in kinds.items()}
    of_one = {f"one_{kind}": Breakage(code, False, spoil) for kind, (code, spoil) in kinds.items()}
    return of_all | of_one


BREAKAGES: Mapping[str, Breakage] = {
    **_of_all_or_one(),
    "moved": Breakage("moved", False, partial(_move, degrees=3.0, millimetres=100.0)),
    "late": Breakage("out_of_sync", False, partial(_delay, by=5)),
    "early": Breakage("out_of_sync", False, partial(_delay, by=-10)),
    "exchanged": Breakage("views_swapped", False, _exchange_with_first),
    "mirrored_image": Breakage("mirrored_image", False, partial(_mirror, image=True, sides=True)),
    "mirrored_key_points": Breakage(
        "mirrored_key_points", False, partial(_mirror, image=True, sides=False)
    ),
    "sides_swapped": Breakage("sides_swapped", False, partial(_mirror, image=False, sides=True)),
}
"""By kind."""
