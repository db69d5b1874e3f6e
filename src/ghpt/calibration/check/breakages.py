"""Good recordings spoilt on purpose, one mistake at a time: to demonstrate the doctor and to test
it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from ghpt.calibration.check.candidates import POSES
from ghpt.calibration.check.evidence import Evidence
from ghpt.calibration.check.setup import Setup, ideal
from ghpt.geometry.cameras import camera_centre
from ghpt.geometry.lens import distort
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.skeleton import MIRROR

Case = tuple[Evidence, Setup]
_LENS = (-0.25, 0.0, 0.0, 0.0, 0.0)


def _pose(case: Case, views: Sequence[int], code: str) -> Case:
    """The inverse of the mend of ``code``."""
    evidence, setup = case
    at = list(views)
    R = setup.R.clone()
    t = setup.t.clone()
    if code == "centre_for_translation":
        t[at] = camera_centre(R[at], t[at])
    elif code == "camera_to_world_flipped":
        R[at], t[at] = POSES["camera_to_world"][0](*POSES["axes_flipped"][0](R[at], t[at]))
    else:  # these undo themselves
        R[at], t[at] = POSES[code][0](R[at], t[at])
    return evidence, replace(setup, R=R, t=t)


def _unit(case: Case, views: Sequence[int], factor: float) -> Case:
    t = case[1].t.clone()
    t[list(views)] /= factor
    return case[0], replace(case[1], t=t)


def _resolution(case: Case, views: Sequence[int], ratio: float) -> Case:
    pixels = case[0].pixels.clone()
    pixels[list(views)] *= ratio
    return replace(case[0], pixels=pixels), case[1]


def _undistorted(case: Case, views: Sequence[int]) -> Case:
    evidence, setup = case
    pixels = evidence.pixels.clone()
    valid = evidence.valid.clone()
    for v in views:
        pixels[v], valid[v] = ideal(pixels[v], valid[v], setup.K[v], setup.lens[v])
    return replace(evidence, pixels=pixels, valid=valid), setup


def _lens_missing(case: Case, views: Sequence[int]) -> Case:
    """Images through a lens that the file does not have."""
    evidence, setup = _undistorted(case, views)
    pixels = evidence.pixels.clone()
    lens = setup.lens.clone()
    for v in views:
        flat = pixels[v].flatten(0, -2)
        pixels[v] = distort(flat, setup.K[v], torch.tensor(_LENS, dtype=torch.float64)).reshape(
            pixels[v].shape
        )
        lens[v] = 0.0
    return replace(evidence, pixels=pixels), replace(setup, lens=lens)


def _moved(case: Case, views: Sequence[int], degrees: float, millimetres: float) -> Case:
    evidence, setup = case
    turn = vector_to_matrix(
        torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64) * torch.pi / 180 * degrees
    )
    way = millimetres * torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
    for v in views:
        R = turn @ setup.R[v]
        setup = setup.changed(v, R=R, t=-R @ (way + camera_centre(setup.R[v], setup.t[v])))
    return evidence, setup


def _late(case: Case, views: Sequence[int], by: int) -> Case:
    """Their frame n + by shows what the others' frame n shows."""
    evidence, setup = case
    pixels = evidence.pixels.clone()
    valid = evidence.valid.clone()
    for v in views:
        pixels[v], valid[v] = pixels[v].roll(by, 0), valid[v].roll(by, 0)
        valid[v, slice(0, by) if by > 0 else slice(by, None)] = False
    return replace(evidence, pixels=pixels, valid=valid), setup


def _exchanged(case: Case, views: Sequence[int]) -> Case:
    """With the first view."""
    evidence, setup = case
    order = list(range(len(setup)))
    order[0], order[views[0]] = order[views[0]], order[0]
    return replace(evidence, pixels=evidence.pixels[order], valid=evidence.valid[order]), setup


def _mirrored(case: Case, views: Sequence[int], image: bool, sides: bool) -> Case:
    evidence, setup = case
    pixels = evidence.pixels.clone()
    valid = evidence.valid.clone()
    for v in views:
        if image:
            pixels[v, ..., 0] = setup.width[v] - 1 - pixels[v, ..., 0]
        if sides:
            pixels[v], valid[v] = pixels[v][..., list(MIRROR), :], valid[v][..., list(MIRROR)]
    return replace(evidence, pixels=pixels, valid=valid), setup


@dataclass(frozen=True)
class Breakage:
    """One way to spoil a recording; ``said``: the code of the finding that names it; ``every``:
    whether it is of all views or of the last alone.
    """

    said: str
    every: bool
    how: Callable[[Case, Sequence[int]], Case]

    def spoil(self, case: Case) -> Case:
        views = len(case[1])
        evidence = replace(case[0], at_rate=None)  # the recording itself is not spoilt
        return self.how((evidence, case[1]), range(views) if self.every else [views - 1])


def _of_one_or_all() -> dict[str, Breakage]:
    ways: dict[str, tuple[str, Callable[[Case, Sequence[int]], Case]]] = {
        **{code: (code, partial(_pose, code=code)) for code in POSES},
        "metres": ("unit", partial(_unit, factor=1e3)),
        "centimetres": ("unit", partial(_unit, factor=10.0)),
        "resolution": ("resolution", partial(_resolution, ratio=0.5)),
        "already_undistorted": ("already_undistorted", _undistorted),
        "lens_missing": ("lens", _lens_missing),
    }
    return {
        **{kind: Breakage(said, True, how) for kind, (said, how) in ways.items()},
        **{f"one_{kind}": Breakage(said, False, how) for kind, (said, how) in ways.items()},
    }


BREAKAGES: dict[str, Breakage] = {
    **_of_one_or_all(),
    "moved": Breakage("moved", False, partial(_moved, degrees=3.0, millimetres=100.0)),
    "late": Breakage("out_of_sync", False, partial(_late, by=5)),
    "early": Breakage("out_of_sync", False, partial(_late, by=-10)),
    "exchanged": Breakage("views_swapped", False, _exchanged),
    "mirrored_image": Breakage("mirrored_image", False, partial(_mirrored, image=True, sides=True)),
    "mirrored_key_points": Breakage(
        "mirrored_key_points", False, partial(_mirrored, image=True, sides=False)
    ),
    "sides_swapped": Breakage("sides_swapped", False, partial(_mirrored, image=False, sides=True)),
}
"""By kind."""
