"""fig:comparison-to-8-point: E_3D against the number of frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ghpt.paper.camera.tasks import camera_model, of_test
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.report.pair_tables import NAMES
from ghpt.report.sweep import (
    CLIP,
    Sweep,
    frames_sweep,
    pairs_table,
    statistics_of,
    sweep_table,
    wins,
)

BASELINES = ("eight_point", "ransac", "poselib")
PAPER_PAIR = (2, 3)
MEAN, DEVIATION, MEDIAN = range(3)
"""Places in `statistics_of`."""


def _tasks(setup: Setup) -> dict[str, Task]:
    size = setup.sizes["frames_sweep"]
    whole = setup.composed("test", "h36m", *setup.overrides["test"])
    config = of_test(whole)
    config |= {
        "camera_baselines": {name: whole["camera_baselines"][name] for name in BASELINES},
        "draws": size["draws"],
        "pairs": None if size["all_pairs"] else [list(PAPER_PAIR)],
    }
    dependencies = {
        "model": camera_model(setup),
        "data": setup.prepared("h36m", whole["data"]["evaluate"]),
    }
    work = "ghpt.paper.camera.sweep.errors_of_draws"
    return {
        str(frames): Task(
            f"frames-sweep-{frames}-seed{setup.seed}",
            work,
            config | {"frames": frames},
            dependencies,
            seconds=6.0,
        )
        for frames in size["frames"]
    }


def _section(results: Results) -> Section:
    sweeps = _sweeps(results)
    name = f"{PAPER_PAIR[0]}-{PAPER_PAIR[1]}"
    paper = sweeps[name]
    frames = sorted(sweeps[name]["weight"])
    draws = len(paper["weight"][frames[0]])
    words = results.display_name("h36m")
    heading = f"Cameras {name} of {words}, {draws} draws of M frames"
    caption = (
        f"E_3D against the number of frames M: mean and standard deviation of {draws} draws, cut at {CLIP:.0f} mm; "
        "the bands of RANSAC and PoseLib are the fainter ones"
    )
    body = [
        f"![{caption}](comparison-to-8-point.svg)",
        f"E_3D of pair {name} in mm, mean ± deviation (median) of {draws} draws.",
        sweep_table(paper),
    ]
    if len(sweeps) > 1:
        body += ["### All pairs", _counted(sweeps), pairs_table(sweeps, ("weight", *BASELINES))]
    figures = {"comparison-to-8-point": frames_sweep(paper, heading)}
    return Section(words, "\n\n".join(body), figures, (), _claims(paper, frames))


def _sweeps(results: Results) -> dict[str, dict[str, dict[int, list[float]]]]:
    """Pair -> method -> M -> E_3D of the draws of all seeds."""
    sweeps: dict[str, dict[str, dict[int, list[float]]]] = {}
    for frames in results.setup.sizes["frames_sweep"]["frames"]:
        for content in results.read(str(frames)):
            for pair, errors in content.items():
                for method in ("weight", *BASELINES):
                    values = (
                        sweeps.setdefault(pair, {}).setdefault(method, {}).setdefault(frames, [])
                    )
                    values += [math.inf if error is None else error for error in errors[method]]
    return sweeps


def _claims(sweep: Sweep, frames: Sequence[int]) -> list[Claim]:
    lower = wins([sweep], "weight", "eight_point", MEAN)
    steadier = wins([sweep], "weight", "eight_point", DEVIATION)
    means, deviations = (
        "; ".join(
            f"M = {m}: {_against(sweep, m, statistic)} mm"
            for m in dict.fromkeys((frames[0], frames[-1]))
        )
        for statistic in (MEAN, DEVIATION)
    )
    return [
        Claim(
            "consistently outperforms the 8-point algorithm on the pair (2, 3)",
            "4.4",
            all(lower),
            f"lower mean for {sum(lower)} of {len(lower)} numbers of frames; {means}",
        ),
        Claim(
            "lower variance than the 8-point algorithm on the pair (2, 3)",
            "4.4",
            all(steadier),
            f"lower deviation for {sum(steadier)} of {len(steadier)} numbers of frames; {deviations}",
        ),
    ]


def _against(sweep: Sweep, frames: int, statistic: int) -> str:
    ours, theirs = (
        statistics_of(sweep[method][frames])[statistic] for method in ("weight", "eight_point")
    )
    return f"{ours:.1f} {'<' if ours < theirs else '≥'} {theirs:.1f}"


def _counted(sweeps: dict[str, Sweep]) -> str:
    counts = []
    for other in BASELINES:
        won = wins(sweeps.values(), "weight", other, MEDIAN)
        counts.append(f"below {NAMES[other]} in {sum(won)} of {len(won)}")
    return (
        f"Median E_3D in mm, {' / '.join(('weight', *(NAMES[name] for name in BASELINES)))}; a star where weight is "
        f"not below all others. The median of weight is {', '.join(counts)} cells."
    )


SWEEP = Artefact(
    "comparison-to-8-point", "figure", "E_3D against the number of frames", _tasks, _section
)
