"""The unit of camera files that do not say it, told by the size of the person in view."""

from __future__ import annotations

import logging
from dataclasses import replace

from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.relative_pose.scale import HUMAN, STATURES, stature
from ghpt.observations import Observations

UNITS_MM = {1.0: "millimetres", 10.0: "centimetres", 1000.0: "metres"}
_ADULT = 1730.0
"""mm: whose size is suggested where no unit fits."""
_AGREE = 0.5
"""Share of the joints that two views must explain for the person to have a size."""
_EXPLAINS = Rejection(0.1)
_log = logging.getLogger(__name__)


def unit_of(height: float) -> float | None:
    """Return the unit (mm) in which a stature is a person's; None where there is none.

    It is never more than one: human statures span less than a factor of ten.
    """
    low, high = HUMAN
    fits = (mm for mm in UNITS_MM if low <= mm * height <= high)
    return next(fits, None)


def unit_for(height: float) -> float:
    """Return the unit (mm) to suggest for a person of this height in it: one that rulers have, or
    that of an adult.
    """
    low, high = STATURES
    rulers = (*UNITS_MM, 100.0, 25.4, 304.8)
    fits = (mm for mm in rulers if low <= mm * height <= high)
    return next(fits, float(f"{_ADULT / height:.4g}"))


def decide_unit(
    cameras: CameraSet, batch: Observations, estimator: Estimator, ask: bool
) -> CameraSet:
    """Return the cameras in mm, by the size of the person whom they show in these frames.

    They stay as they are where the file says its unit, and where the views do not agree on a
    person, which is another mistake. Raises GhptDataError where no bone is seen or no unit fits,
    unless ``ask`` is false.
    """
    if cameras.unit_known or cameras.t is None:
        return cameras
    found = estimator.triangulate(batch)
    explained = _EXPLAINS.find_explained(batch, found.points, found.has_position)
    if float(explained.sum()) < _AGREE * float(found.has_position.sum()):
        return cameras
    height = float(stature(found.points, explained)) / cameras.unit_mm
    unit = unit_of(height)
    if unit is not None:
        metres = height * unit / 1000
        text = (
            f"the file does not say its unit: {UNITS_MM[unit]}, by the person, "
            f"who then measures {metres:.2f} m"
        )
        _log.info("%s: %s (unit_mm=%g).", cameras.path, text, unit)
        t = cameras.t * (unit / cameras.unit_mm)
        return replace(cameras, t=t, unit_known=True, unit_mm=unit)
    if ask:
        raise _unknown_unit(cameras.path, height)
    return cameras


def _unknown_unit(path: str, height: float) -> GhptDataError:
    if height:
        adult = f"{_ADULT / height:.4g}"
        problem = (
            f"the file does not say its unit of length, and the person measures {height:.3g} "
            "of it, which is nobody's size in mm, cm or m"
        )
        hint = f"Give the length of the unit in mm: unit_mm={adult} makes the person 1.73 m tall."
    else:
        problem = (
            "the file does not say its unit of length, and the person's size, of whom no limb "
            "is seen, does not tell"
        )
        hint = (
            "Give the length of the unit in mm: unit_mm=1000 for metres, unit_mm=1 for millimetres."
        )
    return GhptDataError(path, "unit_mm", problem, hint)
