"""What makes millimetres of a rig: a body height, measured bones, a distance, or an assumption."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.calibration.findings import Finding
from ghpt.calibration.mistakes import SCALE_ASSUMED, SCALE_UNKNOWN
from ghpt.calibration.rig import RigEstimate
from ghpt.data.formats.names import chosen_name
from ghpt.errors import GhptConfigError, check
from ghpt.geometry.cameras import Cameras
from ghpt.models.relative_pose.scale import (
    BONE_NAMES,
    BodyHeight,
    BoneLengths,
    body_scale,
    typical_lengths,
)

UNITS = {"millimetres": 1.0, "centimetres": 10.0, "metres": 1000.0}
_HEIGHTS = (800.0, 2600.0)
"""mm. A height in inches lies below the least in centimetres, one in feet between the centimetres
and the metres.
"""
_STATURES = (1000.0, 2300.0)
"""mm: of people whose bones are measured."""
_PROPORTIONS = (0.7, 1.35)
"""By what a measured bone may differ from an average adult's of the same stature."""
_DISTANCES = (200.0, 20_000.0)
"""mm: between two cameras of a rig."""
_HEIGHT_HINT = "Give the person's height in millimetres: 1750, say."
_BONES_HINT = "Give lengths in millimetres: {thigh: 430}, say."
Person = tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J"]]
Measure = Callable[[Cameras], Person]
"""Returns the joints of the recording as a rig of all cameras gives them, in the rig's unit, and
which are estimated.
"""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScaleSettings:
    """What gives millimetres: at most one of the first three."""

    height: int | float | None = None
    """Of the person, mm."""
    segments: dict[str, Any] | None = None
    """The measured lengths (mm) of bones by name."""
    baseline: list[Any] | None = None
    """Two cameras and the distance of their centres, mm."""
    assumed_height: int | float = 1730.0
    """Of the person where nothing else is given, mm."""


@dataclass(frozen=True)
class KnownHeight:
    """The scale is that in which the person has this height."""

    mm: float
    assumed: bool

    @property
    def origin(self) -> str:
        return "assumed" if self.assumed else "height"

    @property
    def text(self) -> str:
        if self.assumed:
            return (
                "assumed: nothing gave one, so the person was taken for an adult of "
                f"{self.mm:g} mm; it may be 10 % off"
            )
        return (
            f"from a body height of {self.mm:g} mm (limbs of an average adult of that height, "
            "about 3 %)"
        )

    def factor(self, estimate: RigEstimate, measure: Measure) -> float:
        return _body_factor(estimate, BodyHeight(self.mm).lengths, measure)


@dataclass(frozen=True)
class KnownBones:
    """The scale is that in which the person's bones have these lengths."""

    mm: Mapping[str, float]
    """By the names of `ghpt.models.relative_pose.scale.BONE_NAMES`, or without the side."""
    origin: str = "segments"

    @property
    def text(self) -> str:
        lengths = [f"{name.replace('_', ' ')} {mm:g} mm" for name, mm in self.mm.items()]
        return f"from measured segments: {', '.join(lengths)}"

    def factor(self, estimate: RigEstimate, measure: Measure) -> float:
        return _body_factor(estimate, BoneLengths(self.mm).lengths, measure)


@dataclass(frozen=True)
class KnownDistance:
    """The scale is that in which two cameras have this distance."""

    names: tuple[str, str]
    mm: float
    origin: str = "baseline"

    @property
    def text(self) -> str:
        return f"from the distance of {self.names[0]} and {self.names[1]}, {self.mm:g} mm"

    def factor(self, estimate: RigEstimate, measure: Measure) -> float:
        views = [estimate.names.index(name) for name in self.names]
        if not bool(estimate.calibrated[views].all()):
            return 0.0
        first, second = estimate.cameras.centre[views]
        length = float((first - second).norm())
        return self.mm / length if length > 0 else 0.0


ScaleSource = KnownHeight | KnownBones | KnownDistance


@dataclass(frozen=True)
class RigScale:
    """The scale of a rig, and what it is from."""

    origin: str
    """height, segments, baseline or assumed."""
    text: str
    factor: float | None
    """mm per unit of the rig; None where the recording does not show it."""

    def plain(self) -> dict[str, Any]:
        """Return what calibration.json holds."""
        return {"from": self.origin, "text": self.text, "factor": self.factor}


def read_scale(settings: ScaleSettings, names: Sequence[str]) -> ScaleSource:
    """Return what gives the scale, with every length in millimetres.

    A length that can only be of centimetres or metres is taken for one, and that is logged. Raises
    GhptConfigError for more than one source of scale, or one that cannot be. ``names``: of the
    cameras.
    """
    sources = {
        "height": settings.height,
        "segments": settings.segments,
        "baseline": settings.baseline,
    }
    given = [key for key, value in sources.items() if value is not None]
    check(len(given) < 2, "scale", f"has {' and '.join(given)}", "Give one of them.")
    assumed = _read_height("scale.assumed_height", settings.assumed_height)
    if settings.height is not None:
        return KnownHeight(_read_height("scale.height", settings.height), assumed=False)
    if settings.segments is not None:
        return KnownBones(_read_bones(settings.segments))
    if settings.baseline is not None:
        return _read_distance(settings.baseline, names)
    return KnownHeight(assumed, assumed=True)


def _read_height(key: str, value: Any) -> float:
    check(_is_number(value), key, f"is {value}", _HEIGHT_HINT)
    low, high = _HEIGHTS
    fits = [unit for unit, mm in UNITS.items() if low <= float(value) * mm <= high]
    problem = f"is {value}, which is nobody's height in mm, cm or m"
    check(bool(fits), key, problem, _HEIGHT_HINT)
    return _in_mm(key, float(value), fits[0])


def _read_bones(lengths: Mapping[str, Any]) -> dict[str, float]:
    """Return the lengths in mm; all are in the unit in which each is a person's."""
    key = "scale.segments"
    for name, value in lengths.items():
        check(_is_number(value), key, f"says {name} is {value!r}", _BONES_HINT)
    try:
        BoneLengths({str(name): float(value) for name, value in lengths.items()})
    except GhptConfigError as error:
        raise GhptConfigError(key, error.problem, error.hint) from error
    units = set(UNITS)
    for name, value in lengths.items():
        own = _units_of_bone(str(name), float(value))
        problem = f"says {name} is {value}, which is nobody's in mm, cm or m"
        check(bool(own), key, problem, _BONES_HINT)
        units &= own
    problem = f"has lengths of different units: {dict(lengths)}"
    check(bool(units), key, problem, _BONES_HINT)
    (unit,) = units
    return {name: _in_mm(f"{key}.{name}", float(value), unit) for name, value in lengths.items()}


def _units_of_bone(name: str, length: float) -> set[str]:
    """Return the units in which a person may have a bone of this length."""
    typical = dict(zip(BONE_NAMES, typical_lengths(), strict=True))
    share = typical.get(name) or typical[f"right_{name}"]
    lowest = _STATURES[0] * _PROPORTIONS[0] * share
    highest = _STATURES[1] * _PROPORTIONS[1] * share
    return {unit for unit, mm in UNITS.items() if lowest <= length * mm <= highest}


def _read_distance(baseline: Sequence[Any], names: Sequence[str]) -> KnownDistance:
    key = "scale.baseline"
    hint = (
        f"Give two of {', '.join(names)} and their distance in mm: [{names[0]}, {names[-1]}, 3000]."
    )
    chosen = [chosen_name(name, names) for name in baseline[:2]]
    two = len(baseline) == 3 and len(set(chosen) & set(names)) == 2
    check(two and _is_number(baseline[-1]), key, f"is {baseline}", hint)
    length = float(baseline[2])
    least, most = _DISTANCES
    first, second = chosen
    if length >= least:
        return KnownDistance((first, second), length)
    in_metres = least <= length * UNITS["metres"] <= most
    problem = f"is {baseline}: two cameras are not {length:g} mm apart"
    check(in_metres, key, problem, hint)
    return KnownDistance((first, second), _in_mm(key, length, "metres"))


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number above 0; no truth value is."""
    return type(value) in (int, float) and 0 < value < math.inf


def _in_mm(key: str, value: float, unit: str) -> float:
    mm = value * UNITS[unit]
    if unit != "millimetres":
        _log.warning("%s: %g was taken for %s: %g mm.", key, value, unit, mm)
    return mm


def in_millimetres(
    estimate: RigEstimate, source: ScaleSource, measure: Measure
) -> tuple[RigEstimate, RigScale]:
    """Return the rig in millimetres, and its scale; the rig as it is, in a unit of its own, if the
    recording does not show the scale.

    A body is measured on what ``measure`` gives, so that every command that triangulates the
    recording with this rig measures the same stature.
    """
    factor = source.factor(estimate, measure)
    if not factor > 0:
        text = f"unknown: the recording does not show it ({source.text})"
        return estimate, RigScale(source.origin, text, None)
    return estimate.scale_by(factor), RigScale(source.origin, source.text, factor)


def _body_factor(estimate: RigEstimate, lengths: Sequence[float], measure: Measure) -> float:
    """Return mm per unit of the rig; 0 where no bone of known length is estimated."""
    known = torch.tensor(lengths, dtype=torch.float64)
    rough = float(body_scale(estimate.points, estimate.estimated, known))
    if not rough > 0:
        return 0.0
    # Estimators have tolerances in mm: they measure the rig in its rough scale.
    cameras = replace(estimate.cameras, t=estimate.cameras.t * rough)
    points, estimated = measure(cameras)
    rest = float(body_scale(points, estimated, known))
    return rough * rest if rest > 0 else rough


def scale_findings(scale: RigScale) -> tuple[Finding, ...]:
    """Return an error for a rig without a scale, a warning for an assumed one."""
    if scale.factor is None:
        return (SCALE_UNKNOWN.finding(source=scale.text),)
    if scale.origin == "assumed":
        return (SCALE_ASSUMED.finding(source=scale.text),)
    return ()
