"""What makes millimetres of a calibrated rig: a body height, measured segments, a known distance, or an assumption."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ghpt.calibration.diagnosis import Diagnosis
from ghpt.calibration.rig import RigEstimate
from ghpt.data.names import chosen_name
from ghpt.errors import GhptConfigError, check
from ghpt.models.scale import BodyHeight, SegmentLengths, body_scale


def check_scale(scale: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise GhptConfigError for more than one source of scale, or one that cannot be."""
    given = [key for key in ("height", "segments", "baseline") if scale[key] is not None]
    check(len(given) < 2, "scale", f"has {' and '.join(given)}", "Give one of them.")
    for key in ("height", "assumed_height"):
        check(scale[key] is None or scale[key] > 0, f"scale.{key}", f"is {scale[key]}", "Give it in millimetres.")
    if given == ["segments"]:
        try:
            _segments(scale["segments"])
        except GhptConfigError as error:
            raise GhptConfigError("scale.segments", error.problem, error.mend) from error
    if given == ["baseline"]:
        baseline = scale["baseline"]
        mend = f"Give two of {', '.join(names)} and their distance in mm: [{names[0]}, {names[-1]}, 3000]."
        good = len(baseline) == 3 and len({chosen_name(name, names) for name in baseline[:2]} & set(names)) == 2
        check(good and type(baseline[2]) in (int, float) and 0 < baseline[2] < math.inf, "scale.baseline",
              f"is {baseline}", mend)  # fmt: skip


def in_millimetres(estimate: RigEstimate, scale: Mapping[str, Any]) -> tuple[RigEstimate, dict[str, Any]]:
    """The rig in millimetres, and what its scale is from; as it was, in a unit of its own, if nothing gives one."""
    if scale["baseline"] is not None:
        a, b = (estimate.names.index(chosen_name(name, estimate.names)) for name in scale["baseline"][:2])
        centre, mm = estimate.cameras.centre, float(scale["baseline"][2])
        length = float((centre[a] - centre[b]).norm()) if bool(estimate.calibrated[[a, b]].all()) else 0.0
        factor = mm / length if length > 0 else 0.0
        found = {
            "from": "baseline",
            "text": f"from the distance of {estimate.names[a]} and {estimate.names[b]}, {mm:g} mm",
        }
    elif scale["segments"] is not None:
        lengths = _segments(scale["segments"]).lengths
        listed = ", ".join(f"{name.replace('_', ' ')} {mm:g} mm" for name, mm in scale["segments"].items())
        found = {"from": "segments", "text": f"from measured segments: {listed}"}
        factor = _body_factor(estimate, lengths)
    else:
        mm = float(scale["assumed_height"] if scale["height"] is None else scale["height"])
        given = scale["height"] is not None
        text = "from a body height of {:g} mm (limbs of an average adult of that height, about 3 %)"
        if not given:
            text = "assumed: nothing gave one, so the person was taken for an adult of {:g} mm; it may be 10 % off"
        found = {"from": "height" if given else "assumed", "text": text.format(mm)}
        factor = _body_factor(estimate, BodyHeight(mm).lengths)
    if not factor > 0:
        text = f"unknown: the recording does not show it ({found['text']})"
        return estimate, found | {"factor": None, "text": text}
    return estimate.scaled(factor), found | {"factor": factor}


def _segments(lengths: Mapping[str, Any]) -> SegmentLengths:
    for name, mm in lengths.items():
        check(type(mm) in (int, float), "lengths", f"says {name} is {mm!r}", "Give lengths in millimetres.")
    return SegmentLengths({str(name): float(mm) for name, mm in lengths.items()})


def _body_factor(estimate: RigEstimate, lengths: Sequence[float]) -> float:
    return float(body_scale(estimate.points, estimate.estimated, torch.tensor(lengths, dtype=torch.float64)))


def of_scale(scale: Mapping[str, Any]) -> tuple[Diagnosis, ...]:
    """An error for a rig without a scale, a warning for an assumed one."""
    if scale["factor"] is None:
        return (Diagnosis("scale_unknown", "error", (), f"Scale {scale['text']}", 0.0),)
    if scale["from"] != "assumed":
        return ()
    text = f"Scale {scale['text']}: give scale.height, scale.segments or scale.baseline"
    return (Diagnosis("scale_assumed", "warning", (), text, 0.0),)
