"""fig:comparison-to-8-point: E_3D against the number of frames (paper, section 4.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ghpt.paper.camera.tasks import camera_model, common_settings
from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, figure_block
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.report.document import Block, Heading, Paragraph
from ghpt.report.pair_tables import NAMES
from ghpt.report.sweep import (
    CLIP,
    Statistic,
    Statistics,
    Sweep,
    count_wins,
    frames_sweep,
    pairs_table,
    sweep_table,
)

BASELINES = ("eight_point", "ransac", "poselib")
PAPER_PAIR = (2, 3)
NAME = "comparison-to-8-point"


def _tasks(setup: Setup) -> dict[str, Task]:
    size = setup.sizes.frames_sweep
    whole = setup.configuration("test", "h36m", *setup.overrides.test)
    baselines = {name: whole["camera_baselines"][name] for name in BASELINES}
    config = {
        **common_settings(whole),
        "camera_baselines": baselines,
        "draws": size.draws,
        "pairs": None if size.all_pairs else [list(PAPER_PAIR)],
    }
    dependencies = {
        "model": camera_model(setup),
        "data": setup.preparation("h36m", whole["data"]["evaluate"]),
    }
    tasks = {}
    for frames in size.frames:
        tasks[str(frames)] = Task(
            f"frames-sweep-{frames}-seed{setup.seed}",
            "ghpt.paper.camera.sweep.errors_of_draws",
            config | {"frames": frames},
            dependencies,
            seconds=6.0,
        )
    return tasks


def _section(results: Results) -> Section:
    sweeps = _sweeps(results)
    pair = f"{PAPER_PAIR[0]}-{PAPER_PAIR[1]}"
    paper = sweeps[pair]
    frames = sorted(paper["weight"])
    draws = len(paper["weight"][frames[0]])
    data = results.display_name("h36m")
    heading = f"Cameras {pair} of {data}, {draws} draws of M frames"
    caption = (
        f"E_3D against the number of frames M: mean and standard deviation of {draws} draws, cut "
        f"at {CLIP:.0f} mm; the bands of RANSAC and PoseLib are the fainter ones"
    )
    blocks: list[Block] = [
        figure_block(NAME, caption),
        Paragraph(f"E_3D of pair {pair} in mm, mean ± deviation (median) of {draws} draws."),
        sweep_table(paper),
    ]
    if len(sweeps) > 1:
        table = pairs_table(sweeps, ("weight", *BASELINES))
        blocks += [Heading("All pairs", 3), Paragraph(_pairs_text(sweeps)), table]
    return Section(
        data, blocks, {NAME: frames_sweep(paper, heading)}, claims=_claims(paper, frames)
    )


def _sweeps(results: Results) -> dict[str, Sweep]:
    """Return the E_3D of the draws of all seeds by pair, method and M, inf where one failed."""
    sweeps: dict[str, dict[str, dict[int, list[float]]]] = {}
    for frames in results.setup.sizes.frames_sweep.frames:
        for content in results.read(str(frames)):
            for pair, errors in content.items():
                for method in ("weight", *BASELINES):
                    by_frames = sweeps.setdefault(pair, {}).setdefault(method, {})
                    values = by_frames.setdefault(frames, [])
                    values += [math.inf if error is None else error for error in errors[method]]
    return dict(sweeps)


def _claims(sweep: Sweep, frames: Sequence[int]) -> list[Claim]:
    count = len(frames)
    lower = count_wins([sweep], "weight", "eight_point", _mean)
    steadier = count_wins([sweep], "weight", "eight_point", _deviation)
    return [
        Claim(
            "consistently outperforms the 8-point algorithm on the pair (2, 3)",
            "4.4",
            lower == count,
            f"lower mean for {lower} of {count} numbers of frames; "
            f"{_at_ends(sweep, frames, _mean)}",
        ),
        Claim(
            "lower variance than the 8-point algorithm on the pair (2, 3)",
            "4.4",
            steadier == count,
            f"lower deviation for {steadier} of {count} numbers of frames; "
            f"{_at_ends(sweep, frames, _deviation)}",
        ),
    ]


def _mean(statistics: Statistics) -> float:
    return statistics.mean


def _deviation(statistics: Statistics) -> float:
    return statistics.deviation


def _median(statistics: Statistics) -> float:
    return statistics.median


def _at_ends(sweep: Sweep, frames: Sequence[int], statistic: Statistic) -> str:
    """Return a statistic beside the 8-point algorithm's at the least and at the most frames."""
    parts = []
    for m in dict.fromkeys((frames[0], frames[-1])):
        ours = statistic(Statistics.from_values(sweep["weight"][m]))
        theirs = statistic(Statistics.from_values(sweep["eight_point"][m]))
        sign = "<" if ours < theirs else "≥"
        parts.append(f"M = {m}: {ours:.1f} {sign} {theirs:.1f} mm")
    return "; ".join(parts)


def _pairs_text(sweeps: Mapping[str, Sweep]) -> str:
    count = sum(len(sweep["weight"]) for sweep in sweeps.values())
    wins = []
    for other in BASELINES:
        won = count_wins(sweeps.values(), "weight", other, _median)
        wins.append(f"below {NAMES[other]} in {won} of {count}")
    methods = " / ".join(("weight", *(NAMES[name] for name in BASELINES)))
    return (
        f"Median E_3D in mm, {methods}; a star where weight is not below all others. The median of "
        f"weight is {', '.join(wins)} cells."
    )


SWEEP = Artefact(NAME, "figure", "E_3D against the number of frames", _tasks, _section)
