"""tab:fundamental-dissection: the errors of one part of the pose (appendix A)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean

from ghpt.models.relative_pose.evaluation import ALONE
from ghpt.paper.camera.tasks import PAIRS, pair_error, pair_tests, rescale
from ghpt.paper.engine.artefact import (
    Artefact,
    Claim,
    Comparison,
    Results,
    Section,
    comparison_rows,
)
from ghpt.paper.published import FUNDAMENTAL_DISSECTION
from ghpt.report.document import Paragraph, Table

HEADER = ["pair", "R: E_2D, px", "R: E_3D, mm", "t: E_2D, px", "t: E_3D, mm", "both: E_3D, mm"]


@dataclass(frozen=True)
class PartErrors:
    """The errors of a pair with its rotation or its translation estimated, the other one true."""

    rotation: float
    translation: float

    @property
    def smaller(self) -> float:
        return min(self.rotation, self.translation)


def _part_errors(results: Results, error: str) -> dict[str, PartErrors]:
    """Return the errors of each pair; E_2D in pixels, E_3D in mm."""
    errors = {}
    for pair in PAIRS:
        parts = [pair_error(results, "weight", pair, part, error).mean for part in ALONE]
        errors[pair] = PartErrors(*parts)
    return errors


def _dissection(results: Results) -> Section:
    rows = []
    comparisons = []
    for (a, b), printed in FUNDAMENTAL_DISSECTION.items():
        pair = f"{a}-{b}"
        of_pair = [
            Comparison(
                f"{pair} {error}, {part.replace('_', ' ')}",
                printed[part][error],
                rescale(pair_error(results, "weight", pair, part, error)),
            )
            for part in ALONE
            for error in ("E_2D", "E_3D")
        ]
        paper, ours, difference = comparison_rows(f"{pair} ", of_pair)
        both = pair_error(results, "weight", pair, "E_3D").text()
        rows += [[*paper, ""], [*ours, both], [*difference, ""]]
        comparisons += of_pair
    text = (
        "Errors of the weighted hypothesis when one part of the pose is estimated and the other "
        "one is true; medians."
    )
    return Section(
        results.display_name("h36m"),
        [Paragraph(text), Table(HEADER, rows)],
        comparisons=comparisons,
        claims=[_translation_claim(results)],
        explanation=_compensation(results),
    )


def _translation_claim(results: Results) -> Claim:
    space = _part_errors(results, "E_3D")
    image = _part_errors(results, "E_2D")
    count_3d = sum(errors.translation > errors.rotation for errors in space.values())
    count_2d = sum(errors.translation > errors.rotation for errors in image.values())
    return Claim(
        "errors of estimated translations are always higher than those of estimated rotations",
        "appendix A",
        count_3d + count_2d == 2 * len(PAIRS),
        f"in {count_3d} of {len(PAIRS)} pairs in E_3D, in {count_2d} in E_2D "
        f"(largest opposite: {_largest_opposite(space)})",
    )


def _largest_opposite(errors: Mapping[str, PartErrors]) -> str:
    """Return the pair whose rotation costs most beyond its translation, with its errors."""
    pair = max(errors, key=lambda name: errors[name].rotation - errors[name].translation)
    rotation = errors[pair].rotation
    translation = errors[pair].translation
    if translation > rotation:
        return "none"
    return f"{pair}, R {rotation:.1f} mm, t {translation:.1f} mm"


def _compensation(results: Results) -> str:
    """Return what there is to say of the errors of R and t of one estimate: they depend."""
    alone = _part_errors(results, "E_3D")
    both = {pair: pair_error(results, "weight", pair, "E_3D").mean for pair in PAIRS}
    smaller = [pair for pair in PAIRS if both[pair] < alone[pair].smaller]
    if not smaller:
        return (
            "With both parts estimated E_3D is larger than with one of them, as in the paper's "
            "tables."
        )
    with_both = fmean(both[pair] for pair in smaller)
    rotation = fmean(alone[pair].rotation for pair in smaller)
    translation = fmean(alone[pair].translation for pair in smaller)
    return (
        "An estimate's rotation and translation err together and make up for one another: on "
        f"{', '.join(smaller)} E_3D is smaller with both of them (mean {with_both:.1f} mm) than "
        f"with R ({rotation:.1f} mm) or t ({translation:.1f} mm) alone, and to take one part from "
        "the truth undoes that. In the paper's tables the errors of the parts are the smaller ones "
        "on all pairs."
    )


DISSECTION = Artefact(
    "fundamental-dissection",
    "table",
    "Relative camera poses, one part estimated",
    pair_tests,
    _dissection,
)
