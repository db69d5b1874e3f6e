"""The numbers of a calibration as plain data, its table in the terminal and its Markdown report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table
from rich.text import Text
from torch import Tensor

from ghpt.models.estimators.classical import Estimator
from ghpt.models.relative_pose.scale import BONE_NAMES
from ghpt.observations import Recording
from ghpt.report.escape import escaped, plain
from ghpt.report.rig_comparison import (
    held_out_errors,
    rig_difference,
    bone_variation,
    triangulate_recording,
)
from ghpt.report.tables import NONE, markdown

Numbers = dict[str, Any]
_COLOURS = {"error": "red", "warning": "yellow"}


def explains(recordings: Mapping[str, Recording], estimator: Estimator, frames: int) -> Numbers:
    """How well each calibration of the same key points explains them: name -> held-out-view errors
    (pixels) over the joints that all of them estimate, overall and by view, and the variation of
    the segments' lengths; over at most so many ``frames``, evenly spread.
    """
    recordings = {name: spread(recording, frames) for name, recording in recordings.items()}
    if not recordings:
        return {}
    held_out = {
        name: held_out_errors(recording, estimator) for name, recording in recordings.items()
    }
    measured = torch.stack([counted for _, counted in held_out.values()]).all(0)
    result = {}
    for name, recording in recordings.items():
        errors = held_out[name][0]
        variation, known = bone_variation(*triangulate_recording(recording, estimator))
        views = {
            view: _quantiles(errors[:, v][measured[:, v]])
            for v, view in enumerate(recording.camera_names)
        }
        lengths = dict(zip(BONE_NAMES, _known(variation, known), strict=True))
        result[name] = {
            "held_out": _quantiles(errors[measured]) | {"views": views},
            "segments": {
                "median": float(variation[known].median()) if known.any() else None,
                "each": lengths,
            },
        }
    return result


def differences(recording: Recording, reference: Recording) -> Numbers:
    """From the reference's calibration of the same cameras, after the similarity between the
    worlds.
    """
    apart = rig_difference(recording.cameras, reference.cameras)
    names = recording.camera_names
    return {
        "rotation_deg": dict(zip(names, apart.rotation_deg.tolist(), strict=True)),
        "centre_mm": dict(zip(names, apart.centre_mm.tolist(), strict=True)),
        "scale": apart.scale,
    }


def print_calibration(numbers: Numbers, console: Console | None = None) -> None:
    """The table of the cameras, then what was found, in 80 columns."""
    console = console or Console()
    header, rows = camera_rows(numbers)
    title = plain(f"Calibration of {numbers['data']}", "table.title")
    caption = plain(_caption(numbers), "table.caption")
    table = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    for i, column in enumerate(header):
        table.add_column(column, justify="right" if i else "left")
    for row in rows:
        table.add_row(*map(plain, row))
    console.print(table)
    for line in summary_lines(numbers):
        console.print(plain(line))
    for found in numbers["diagnoses"]:
        severity = found["severity"]
        line = Text.assemble((severity, _COLOURS.get(severity, "")), ": ", plain(found["text"]))
        console.print(line, soft_wrap=True)


def camera_rows(numbers: Numbers) -> tuple[list[str], list[list[str]]]:
    """Header and a row for each camera; what is not known is a dash."""
    header = ["camera", "error px", "inliers %", "turn ± °", "centre ± mm"]
    apart = numbers.get("difference")
    header += ["Δ turn °", "Δ centre mm"] if apart else []
    rows = []
    for camera in numbers["cameras"]:
        name = camera["name"]
        row = [name, _number(camera["reprojection_px"], 1), _number(camera["inliers"], 0, 100)]
        row += [_number(camera["rotation_sd_deg"], 2), _number(camera["centre_sd_mm"], 1)]
        if apart:
            row += [
                _number(apart["rotation_deg"].get(name), 2),
                _number(apart["centre_mm"].get(name), 1),
            ]
        rows.append(row if camera["calibrated"] else [name, *[NONE] * (len(header) - 1)])
    return header, rows


def summary_lines(numbers: Numbers) -> list[str]:
    """What one sentence each says of the rig as a whole."""
    lines = [f"Scale: {numbers['scale']['text']}."]
    if numbers.get("difference"):
        scale = numbers["difference"]["scale"]
        lines.append(f"Size: {numbers['reference']} is {scale:.4f} times as large.")
    for name, found in numbers["explains"].items():
        errors = found["held_out"]
        if errors["median"] is not None:
            lines.append(
                f"{name}: held-out view {errors['median']:.1f} px median, {errors['p90']:.1f} px 90 %; "
                f"segments vary by {_number(found['segments']['median'], 1, 100)} %."
            )
    return lines


def calibration_report(numbers: Numbers) -> str:
    """The Markdown report."""
    explained = numbers["explains"]
    parts = [
        f"# Calibration of {escaped(numbers['data'])}",
        f"{numbers['frames']} frames, {len(numbers['cameras'])} views, seed {numbers['seed']}, "
        f"ghpt {numbers['provenance']['ghpt']}, commit `{numbers['provenance']['commit'] or NONE}`.",
        "\n".join(f"- {escaped(line)}" for line in summary_lines(numbers)),
        "## Diagnoses",
        "\n".join(_diagnosis(found) for found in numbers["diagnoses"]) or "None.",
        "## Cameras",
        markdown(*camera_rows(numbers)),
        "\n".join(map(escaped, _caption(numbers).split("\n"))),
    ]
    if explained:
        names = list(explained)
        views = explained[names[0]]["held_out"]["views"]
        rows = [
            [
                view,
                *(
                    _number(explained[n]["held_out"]["views"][view][q], 1)
                    for n in names
                    for q in _QUANTILES
                ),
            ]
            for view in views
        ]
        rows.append(
            ["all", *(_number(explained[n]["held_out"][q], 1) for n in names for q in _QUANTILES)]
        )
        parts += [
            "## Held-out views",
            "Each joint is triangulated from the other views and projected into the one left out, on the same joints "
            f"for all; pixels. Triangulation: {numbers['triangulation']}.",
            markdown(["view", *(f"{n}, {q}" for n in names for q in ("median", "90 %"))], rows),
            "## Segments",
            "Variation of their lengths over the frames, % (1.4826 x median deviation over median).",
            markdown(["segment", *names], _segment_rows(explained)),
        ]
    return "\n\n".join(parts) + "\n"


def _diagnosis(found: Mapping[str, Any]) -> str:
    return f"- **{found['severity']}** ({found['code']}): {escaped(found['text'])}"


_QUANTILES = ("median", "p90")


def _segment_rows(explained: Numbers) -> list[list[str]]:
    each = [found["segments"]["each"] for found in explained.values()]
    return [
        [name.replace("_", " "), *(_number(of[name], 1, 100) for of in each)] for name in BONE_NAMES
    ]


def spread(recording: Recording, frames: int) -> Recording:
    """At most so many of its frames, evenly spread."""
    rows = np.unique(np.linspace(0, len(recording) - 1, min(frames, len(recording))).astype(int))
    return recording.frames(rows)


def _caption(numbers: Numbers) -> str:
    caption = "error: median reprojection; ±: standard deviation from the recording itself"
    if numbers.get("difference"):
        caption += f"\nΔ: from {numbers['reference']}, after the similarity between the two worlds"
    return caption


def _quantiles(errors: Float[Tensor, " N"]) -> Numbers:
    if not len(errors):
        return {"median": None, "p90": None, "count": 0}
    ordered = errors.sort().values
    return {
        "median": float(ordered[(len(errors) - 1) // 2]),
        "p90": float(ordered[int(0.9 * (len(errors) - 1))]),
        "count": len(errors),
    }


def _known(values: Float[Tensor, " N"], known: Bool[Tensor, " N"]) -> Sequence[float | None]:
    return [v if k else None for v, k in zip(values.tolist(), known.tolist(), strict=True)]


def _number(value: float | None, digits: int, factor: int = 1) -> str:
    return NONE if value is None else f"{factor * value:.{digits}f}"
