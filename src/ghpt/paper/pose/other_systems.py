"""The tables beside other systems (paper, section 4.1)."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from itertools import permutations

from ghpt.paper.engine.artefact import (
    Artefact,
    Claim,
    Comparison,
    Results,
    Section,
    Spread,
    format_signed,
    over_seeds,
)
from ghpt.paper.pose.generalization import PANOPTIC, grid, panoptic_name
from ghpt.paper.published import ARRANGEMENTS, ISKAKOV, REMELLI, REMELLI_INTER, REMELLI_OURS, SOTA
from ghpt.report.document import Paragraph, Table
from ghpt.report.tables import NAMES, NONE

SAME_DETECTIONS = (
    "frame_learned",
    "ransac",
    "adaptive_ransac",
    "weighted_linear",
    "lo_ransac",
    "m_estimator",
    "linear",
)


def _iskakov(results: Results) -> Section:
    theirs = ISKAKOV["theirs"]
    test = "cmu3 on h36m"
    all_joints = Comparison("ours, 17 joints", ISKAKOV["ours"], results.relative(test))
    six = results.spread(test, "selections", "weight", "mpjpe_6_joints")
    six_joints = Comparison("ours, 6 joints", None, six)
    rows = [[row.label, *row.cells()] for row in (all_joints, six_joints)]
    rows.append(["Iskakov et al., 6 joints (as published)", f"{theirs:.1f}", NONE, NONE])
    text = (
        "Iskakov et al. measured their 34.0 mm on the joints whose definitions the two data sets "
        "share, elbows, wrists and knees, and the paper set its 17-joint number beside it. These "
        "six are harder than the mean of all (in which the pelvis counts with an error of 0), so "
        "the fair row is the second."
    )
    return Section(
        f"{results.display_name('cmu3')} to {results.display_name('h36m')}",
        [Paragraph(text), Table(["CMU3 to H36M", "paper, mm", "ours, mm", "difference"], rows)],
        comparisons=[all_joints],
        claims=_iskakov_claims(results, results.relative(test).mean, six.mean),
    )


def _iskakov_claims(results: Results, all_joints: float, six: float) -> list[Claim]:
    theirs = ISKAKOV["theirs"]
    gain = 100 * (1 - all_joints / theirs)
    gain_six = 100 * (1 - six / theirs)
    return [
        Claim(
            "better than Iskakov et al. from CMU to Human3.6M (on 17 joints, against their 6)",
            "4.1",
            results.on_real("h36m", all_joints < theirs),
            f"{gain:.1f} % (8.8 %)",
        ),
        Claim(
            "the same on the 6 joints that they measured",
            "not in the paper",
            results.on_real("h36m", six < theirs),
            f"{gain_six:.1f} %",
        ),
    ]


def _remelli(results: Results) -> Section:
    rows = []
    for name, (base, novel) in REMELLI.items():
        published = _range_text(base, novel)
        rows.append([f"Remelli et al. ({name}; as published)", published, NONE, NONE, NONE])
    comparisons = []
    intra = []
    for train, published_range in REMELLI_OURS.items():
        errors = [results.relative(f"{train} on {test}") for test in PANOPTIC]
        base_error = results.relative(f"{train} on {train}")
        others = [results.relative(f"{train} on {test}") for test in PANOPTIC if test != train]
        honest = _mean_drop(base_error, others)
        rows.append(_remelli_row(f"ours ({train.upper()})", published_range, errors, honest))
        comparisons += _compare_ends(train, published_range, errors)
        intra.append(_largest_drop(errors).mean)
    to_human36m = [results.relative(f"{train} on h36m") for train in ARRANGEMENTS]
    honest = _mean_drop(to_human36m[-1], to_human36m[:-1])
    rows.append(_remelli_row("ours (to H36M)", REMELLI_INTER, to_human36m, honest))
    text = (
        "The paper's base and novel test of a training set are the smallest and the largest number "
        "of its column; we take the same. The last column is the drop from the trained arrangement "
        "to the mean of the others, which can be negative."
    )
    explanation = (
        "The level is that of the synthetic Panoptic (see tab:generalization-evaluation); the "
        "drops, which this table is about, do not depend on it."
    )
    header = ["trained on", "paper, mm", "ours, mm", "our drop", "base to mean of novel"]
    return Section(
        f"{panoptic_name(results)} and {results.display_name('h36m')}",
        [Paragraph(text), Table(header, rows)],
        comparisons=comparisons,
        claims=_remelli_claims(max(intra), _largest_drop(to_human36m)),
        explanation=explanation,
    )


def _remelli_claims(intra: float, inter: Spread) -> list[Claim]:
    theirs = _drop(*REMELLI["TC1, baseline"])
    return [
        Claim(
            "intra-dataset drop below Remelli et al.'s 22.6 %",
            "4.1",
            intra < theirs,
            f"{intra:.1f} % (3.6 %)",
        ),
        Claim(
            "inter-dataset drop below it too",
            "4.1",
            inter.mean < theirs,
            f"{inter.text()} % (15.1 %)",
        ),
    ]


def _compare_ends(
    train: str, published: tuple[float, float], errors: Sequence[Spread]
) -> list[Comparison]:
    base, novel = published
    return [
        Comparison(f"{train.upper()} base", base, over_seeds(min, *errors)),
        Comparison(f"{train.upper()} novel", novel, over_seeds(max, *errors)),
    ]


def _remelli_row(
    name: str, published: tuple[float, float], errors: Sequence[Spread], honest: Spread
) -> list[str]:
    low = over_seeds(min, *errors)
    high = over_seeds(max, *errors)
    return [
        name,
        _range_text(*published),
        f"{low.text()} to {high.text()}",
        f"{_largest_drop(errors).text()} %",
        f"{format_signed(honest.mean)} %",
    ]


def _largest_drop(errors: Sequence[Spread]) -> Spread:
    """Return the drop from the smallest to the largest error, percent."""
    return over_seeds(lambda *of_seed: _drop(min(of_seed), max(of_seed)), *errors)


def _mean_drop(base: Spread, novel: Sequence[Spread]) -> Spread:
    """Return the drop from the trained arrangement to the mean of the others, percent."""
    return over_seeds(lambda own, *others: _drop(own, statistics.fmean(others)), base, *novel)


def _range_text(base: float, novel: float) -> str:
    return f"{base:.1f} to {novel:.1f}, {_drop(base, novel):.1f} %"


def _drop(base: float, novel: float) -> float:
    return 100 * (novel / base - 1)


def _sota(results: Results) -> Section:
    ours = _novel_mean(results, "weight")
    label = "ours (mean of the 12 novel arrangements)"
    comparison = Comparison(label, SOTA["ours"], ours)
    rows = [
        [f"{name} (as published)", f"{SOTA[name]:.1f}", NONE, NONE]
        for name in ("RANSAC", "algebraic", "VoxelPose")
    ]
    rows.append([label, *comparison.cells()])
    beside = {
        "average of the same 12 pools": _novel_mean(results, "average"),
    }
    for name in SAME_DETECTIONS:
        errors = [results.relative(f"{test} on {test}", name) for test in PANOPTIC]
        beside[f"{NAMES.get(name, name)} on our detections"] = over_seeds(_mean, *errors)
    rows += [[name, NONE, error.text(), NONE] for name, error in beside.items()]
    text = (
        "The published rows are other systems' on real images. Below ours, classical estimators on "
        "the same detections: the mean of CMU1 to CMU4."
    )
    ransac = beside["RANSAC on our detections"].mean
    explanation = (
        "The paper's RANSAC on Panoptic, 39.5 mm, is worse than the worst hypothesis of its own "
        "pools (31.0 mm), so it can hardly be of the same detections; on the synthetic ones it has "
        f"{ransac:.1f} mm."
    )
    return Section(
        panoptic_name(results),
        [Paragraph(text), Table(["method", "paper, mm", "ours, mm", "difference"], rows)],
        comparisons=[comparison],
        claims=_sota_claims(results, ours.mean, ransac),
        explanation=explanation,
    )


def _sota_claims(results: Results, ours: float, ransac: float) -> list[Claim]:
    return [
        Claim(
            "better than RANSAC on Panoptic by a large margin",
            "4.1",
            ours < 0.9 * ransac,
            f"{ours:.1f} against {ransac:.1f} mm on the same detections (25.4 against 39.5)",
        ),
        Claim(
            "on a par with VoxelPose",
            "4.1",
            results.on_real("cmu1", ours < 1.05 * SOTA["VoxelPose"]),
            f"{ours:.1f} against its published 25.5 mm, which is of real images (25.4)",
        ),
    ]


def _novel_mean(results: Results, selection: str) -> Spread:
    """Return the mean over the 12 novel arrangements."""
    pairs = permutations(PANOPTIC, 2)
    errors = [results.relative(f"{train} on {test}", selection) for train, test in pairs]
    return over_seeds(_mean, *errors)


def _mean(*values: float) -> float:
    return statistics.fmean(values)


ARTEFACTS = (
    Artefact(
        "iskakov-comparison",
        "table",
        "From Panoptic to Human3.6M, beside Iskakov et al.",
        lambda setup: grid(setup, ("cmu3",), ("h36m",)),
        _iskakov,
    ),
    Artefact(
        "remelli-comparison",
        "table",
        "Drop from base to novel arrangement, beside Remelli et al.",
        grid,
        _remelli,
    ),
    Artefact(
        "sota-comparison",
        "table",
        "Panoptic, novel arrangements, beside other systems",
        lambda setup: grid(setup, PANOPTIC, PANOPTIC),
        _sota,
    ),
)
