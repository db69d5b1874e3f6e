"""The tables beside other systems (paper, section 4.1)."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from itertools import product

from ghpt.paper.engine.artefact import (
    Artefact,
    Claim,
    Comparison,
    Results,
    Section,
    Spread,
    over_seeds,
    signed,
)
from ghpt.paper.pose.generalization import PANOPTIC, four, grid
from ghpt.paper.published import ARRANGEMENTS, ISKAKOV, REMELLI, REMELLI_INTER, REMELLI_OURS, SOTA
from ghpt.report.tables import NAMES, NONE, markdown

SAME_DETECTIONS = (
    "ransac",
    "adaptive_ransac",
    "weighted_linear",
    "lo_ransac",
    "m_estimator",
    "linear",
)


def _iskakov(results: Results) -> Section:
    all_joints = results.relative("cmu3 on h36m")
    six = results.spread("cmu3 on h36m", "selections", "weight", "mpjpe_6_joints")
    rows = [
        Comparison("ours, 17 joints", ISKAKOV["ours"], all_joints),
        Comparison("ours, 6 joints", None, six),
    ]
    theirs = [["Iskakov et al., 6 joints (as published)", f"{ISKAKOV['theirs']:.1f}", NONE, NONE]]
    table = markdown(
        ["CMU3 to H36M", "paper, mm", "ours, mm", "difference"],
        [*([row.what, *row.cells()] for row in rows), *theirs],
    )
    text = (
        "Iskakov et al. measured their 34.0 mm on the joints whose definitions the two data sets share, elbows, wrists "
        "and knees, and the paper set its 17-joint number beside it. These six are harder than the mean of all (in "
        "which the pelvis counts with an error of 0), so the fair row is the second."
    )
    claims = [
        Claim(
            "better than Iskakov et al. from CMU to Human3.6M (on 17 joints, against their 6)",
            "4.1",
            results.on_real("h36m", all_joints.mean < ISKAKOV["theirs"]),
            f"{_gain(all_joints):.1f} % (8.8 %)",
        ),
        Claim(
            "the same on the 6 joints that they measured",
            "not in the paper",
            results.on_real("h36m", six.mean < ISKAKOV["theirs"]),
            f"{_gain(six):.1f} %",
        ),
    ]
    return Section(_to_human36m(results, "cmu3"), f"{text}\n\n{table}", {}, rows[:1], claims)


def _gain(ours: Spread) -> float:
    return 100 * (1 - ours.mean / ISKAKOV["theirs"])


def _to_human36m(results: Results, train: str) -> str:
    return f"{results.display_name(train)} to {results.display_name('h36m')}"


def _remelli(results: Results) -> Section:
    rows = [
        [
            f"Remelli et al. ({name}; as published)",
            _range(base, novel),
            NONE,
            NONE,
            NONE,
        ]
        for name, (base, novel) in REMELLI.items()
    ]
    drops = []
    compared = []
    for train, published in REMELLI_OURS.items():
        column = [results.relative(f"{train} on {test}") for test in PANOPTIC]
        novel = [results.relative(f"{train} on {test}") for test in PANOPTIC if test != train]
        base = results.relative(f"{train} on {train}")
        drops.append(over_seeds(lambda *values: _drop(min(values), max(values)), *column))
        honest = over_seeds(lambda b, *n: _drop(b, statistics.fmean(n)), base, *novel)
        rows.append(_remelli_row(f"ours ({train.upper()})", published, column, drops[-1], honest))
        ends = (over_seeds(min, *column), over_seeds(max, *column))
        compared += [
            Comparison(f"{train.upper()} {end}", paper, ours)
            for end, paper, ours in zip(("base", "novel"), published, ends, strict=True)
        ]
    row = [results.relative(f"{train} on h36m") for train in ARRANGEMENTS]
    inter = over_seeds(lambda *values: _drop(min(values), max(values)), *row)
    honest = over_seeds(lambda b, *n: _drop(b, statistics.fmean(n)), row[-1], *row[:-1])
    rows.append(_remelli_row("ours (to H36M)", REMELLI_INTER, row, inter, honest))
    text = (
        "The paper's base and novel test of a training set are the smallest and the largest number of its column; we "
        "take the same. The last column is the drop from the trained arrangement to the mean of the others, which can "
        "be negative."
    )
    header = ["trained on", "paper, mm", "ours, mm", "our drop", "base to mean of novel"]
    best = _drop(*REMELLI["TC1, baseline"])
    intra = max(drop.mean for drop in drops)
    claims = [
        Claim(
            "intra-dataset drop below Remelli et al.'s 22.6 %",
            "4.1",
            intra < best,
            f"{intra:.1f} % (3.6 %)",
        ),
        Claim(
            "inter-dataset drop below it too",
            "4.1",
            inter.mean < best,
            f"{inter.text()} % (15.1 %)",
        ),
    ]
    data = f"{four(results)} and {results.display_name('h36m')}"
    return Section(
        data, f"{text}\n\n{markdown(header, rows)}", {}, compared, claims, _EXPLAINED_LEVEL
    )


_EXPLAINED_LEVEL = (
    "The level is that of the synthetic Panoptic (see tab:generalization-evaluation); the drops, which this table is "
    "about, do not depend on it."
)


def _remelli_row(
    name: str, published: tuple[float, float], row: Sequence[Spread], drop: Spread, honest: Spread
) -> list[str]:
    low = over_seeds(min, *row)
    high = over_seeds(max, *row)
    return [
        name,
        _range(*published),
        f"{low.text()} to {high.text()}",
        f"{drop.text()} %",
        f"{signed(honest.mean)} %",
    ]


def _range(base: float, novel: float) -> str:
    return f"{base:.1f} to {novel:.1f}, {_drop(base, novel):.1f} %"


def _drop(base: float, novel: float) -> float:
    return 100 * (novel / base - 1)


def _sota(results: Results) -> Section:
    def novel(selection: str) -> Spread:
        """Mean of the 12 novel arrangements."""
        spreads = (
            results.relative(f"{a} on {b}", selection)
            for a, b in product(PANOPTIC, PANOPTIC)
            if a != b
        )
        return over_seeds(_mean, *spreads)

    ours = Comparison("ours (mean of the 12 novel arrangements)", SOTA["ours"], novel("weight"))
    rows = [
        [f"{name} (as published)", f"{SOTA[name]:.1f}", NONE, NONE]
        for name in ("RANSAC", "algebraic", "VoxelPose")
    ]
    rows.append([ours.what, *ours.cells()])
    rows.append(
        ["view weights (the same 12; not in the paper)", NONE, novel("view_weights").text(), NONE]
    )
    rows.append(["average of the same 12 pools", NONE, novel("average").text(), NONE])
    same = {}
    for name in SAME_DETECTIONS:
        same[name] = over_seeds(
            _mean, *(results.relative(f"{test} on {test}", name) for test in PANOPTIC)
        )
        rows.append([f"{NAMES.get(name, name)} on our detections", NONE, same[name].text(), NONE])
    text = (
        "The published rows are other systems' on real images. Below ours, classical estimators on the same "
        "detections: the mean of CMU1 to CMU4."
    )
    ransac = same["ransac"].mean
    claims = [
        Claim(
            "better than RANSAC on Panoptic by a large margin",
            "4.1",
            ours.ours.mean < 0.9 * ransac,
            f"{ours.ours.mean:.1f} against {ransac:.1f} mm on the same detections (25.4 against 39.5)",
        ),
        Claim(
            "on a par with VoxelPose",
            "4.1",
            results.on_real("cmu1", ours.ours.mean < 1.05 * SOTA["VoxelPose"]),
            f"{ours.ours.mean:.1f} against its published 25.5 mm, which is of real images (25.4)",
        ),
    ]
    explained = (
        "The paper's RANSAC on Panoptic, 39.5 mm, is worse than the worst hypothesis of its own pools (31.0 mm), so it "
        f"can hardly be of the same detections; on the synthetic ones it has {ransac:.1f} mm."
    )
    data = four(results)
    body = f"{text}\n\n{markdown(['method', 'paper, mm', 'ours, mm', 'difference'], rows)}"
    return Section(data, body, {}, [ours], claims, explained)


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
