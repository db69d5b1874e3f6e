"""What makes millimetres of a calibrated rig: a body height, measured segments, a known distance,
or an assumption.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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
    SEGMENTS,
    BodyHeight,
    SegmentLengths,
    body_scale,
    typical_lengths,
)

UNITS = {"millimetres": 1.0, "centimetres": 10.0, "metres": 1000.0}
_HEIGHTS = (800.0, 2600.0)
"""mm. A height in inches lies below the least in centimetres, one in feet between the centimetres
and the metres.
"""
_STATURES = (1000.0, 2300.0)
_PROPORTIONS = (0.7, 1.35)
"""Of measured segments: whose (mm), and by what they differ from an average adult's."""
_APART = (200.0, 20_000.0)
"""mm: how far two cameras of a rig are apart."""
Person = tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J"]]
Measure = Callable[[Cameras], Person]
"""The joints of the recording as a rig of all cameras gives them, in the rig's unit, and which are
estimated.
"""
_log = logging.getLogger(__name__)


def read_scale(scale: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The scale with every length in millimetres. A length that can only be of centimetres or
    metres is taken for one, and that is logged. Raises GhptConfigError for more than one source of
    scale, or one that cannot be.
    """
    given = [key for key in ("height", "segments", "baseline") if scale[key] is not None]
    check(len(given) < 2, "scale", f"has {' and '.join(given)}", "Give one of them.")
    found = dict(scale)
    for key in ("height", "assumed_height"):
        if scale[key] is not None:
            found[key] = _height(f"scale.{key}", scale[key])
    if given == ["segments"]:
        found["segments"] = _segments(scale["segments"])
    if given == ["baseline"]:
        found["baseline"] = _baseline(scale["baseline"], names)
    return found


def _height(key: str, value: Any) -> float:
    hint = "Give the person's height in millimetres: 1750, say."
    check(_is_number(value), key, f"is {value}", hint)
    low, high = _HEIGHTS
    fits = [unit for unit, mm in UNITS.items() if low <= float(value) * mm <= high]
    check(bool(fits), key, f"is {value}, which is nobody's height in mm, cm or m", hint)
    return _in_mm(key, float(value), fits[0])


def _segments(lengths: Mapping[str, Any]) -> dict[str, float]:
    """All in one unit: that in which each of them is the length of such a part of a person."""
    key = "scale.segments"
    hint = "Give lengths in millimetres: {thigh: 430}, say."
    for name, value in lengths.items():
        check(_is_number(value), key, f"says {name} is {value!r}", hint)
    try:
        SegmentLengths({str(name): float(value) for name, value in lengths.items()})
    except GhptConfigError as error:
        raise GhptConfigError(key, error.problem, error.hint) from error
    typical = dict(zip(SEGMENTS, typical_lengths(), strict=True))
    low, high = (stature * part for stature, part in zip(_STATURES, _PROPORTIONS, strict=True))
    fits = set(UNITS)
    for name, value in lengths.items():
        share = typical.get(str(name)) or typical[f"right_{name}"]
        own = {
            unit for unit, mm in UNITS.items() if low * share <= float(value) * mm <= high * share
        }
        check(bool(own), key, f"says {name} is {value}, which is nobody's in mm, cm or m", hint)
        fits &= own
    check(bool(fits), key, f"has lengths of different units: {dict(lengths)}", hint)
    (unit,) = fits
    return {name: _in_mm(f"{key}.{name}", float(value), unit) for name, value in lengths.items()}


def _baseline(baseline: Sequence[Any], names: Sequence[str]) -> list[Any]:
    key = "scale.baseline"
    hint = (
        f"Give two of {', '.join(names)} and their distance in mm: [{names[0]}, {names[-1]}, 3000]."
    )
    good = (
        len(baseline) == 3
        and len({chosen_name(name, names) for name in baseline[:2]} & set(names)) == 2
    )
    check(good and _is_number(baseline[2]), key, f"is {baseline}", hint)
    length = float(baseline[2])
    (least, most) = _APART
    if length >= least:
        return [*baseline[:2], length]
    metres = least <= length * UNITS["metres"] <= most
    check(metres, key, f"is {baseline}: two cameras are not {length:g} mm apart", hint)
    return [*baseline[:2], _in_mm(key, length, "metres")]


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number above 0; no truth value is."""
    return type(value) in (int, float) and 0 < value < math.inf


def _in_mm(key: str, value: float, unit: str) -> float:
    mm = value * UNITS[unit]
    if unit != "millimetres":
        _log.warning("%s: %g was taken for %s: %g mm.", key, value, unit, mm)
    return mm


def in_millimetres(
    estimate: RigEstimate, scale: Mapping[str, Any], measure: Measure
) -> tuple[RigEstimate, dict[str, Any]]:
    """The rig in millimetres, and what its scale is from; as it was, in a unit of its own, if
    nothing gives one.

    ``scale`` is what ``read_scale`` gives. A body is measured on what ``measure`` gives, so that
    every command that triangulates the recording with this rig measures the same stature.
    """
    if scale["baseline"] is not None:
        a, b = (
            estimate.names.index(chosen_name(name, estimate.names))
            for name in scale["baseline"][:2]
        )
        centre = estimate.cameras.centre
        mm = float(scale["baseline"][2])
        length = (
            float((centre[a] - centre[b]).norm())
            if bool(estimate.calibrated[[a, b]].all())
            else 0.0
        )
        factor = mm / length if length > 0 else 0.0
        found = {
            "from": "baseline",
            "text": f"from the distance of {estimate.names[a]} and {estimate.names[b]}, {mm:g} mm",
        }
    elif scale["segments"] is not None:
        lengths = SegmentLengths(scale["segments"]).lengths
        listed = ", ".join(
            f"{name.replace('_', ' ')} {mm:g} mm" for name, mm in scale["segments"].items()
        )
        found = {"from": "segments", "text": f"from measured segments: {listed}"}
        factor = _body_factor(estimate, lengths, measure)
    else:
        mm = float(scale["assumed_height"] if scale["height"] is None else scale["height"])
        given = scale["height"] is not None
        text = "from a body height of {:g} mm (limbs of an average adult of that height, about 3 %)"
        if not given:
            text = "assumed: nothing gave one, so the person was taken for an adult of {:g} mm; it may be 10 % off"
        found = {"from": "height" if given else "assumed", "text": text.format(mm)}
        factor = _body_factor(estimate, BodyHeight(mm).lengths, measure)
    if not factor > 0:
        text = f"unknown: the recording does not show it ({found['text']})"
        return estimate, found | {"factor": None, "text": text}
    return estimate.scaled(factor), found | {"factor": factor}


def _body_factor(estimate: RigEstimate, lengths: Sequence[float], measure: Measure) -> float:
    """mm per unit of the rig; 0 where no part of known length is estimated."""
    known = torch.tensor(lengths, dtype=torch.float64)
    rough = float(body_scale(estimate.points, estimate.estimated, known))
    if not rough > 0:
        return 0.0
    # estimators have tolerances in mm
    cameras = replace(estimate.cameras, t=estimate.cameras.t * rough)
    rest = float(body_scale(*measure(cameras), known))
    return rough * rest if rest > 0 else rough


def scale_findings(scale: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return an error for a rig without a scale, a warning for an assumed one."""
    if scale["factor"] is None:
        return (SCALE_UNKNOWN.finding(source=scale["text"]),)
    if scale["from"] == "assumed":
        return (SCALE_ASSUMED.finding(source=scale["text"]),)
    return ()
