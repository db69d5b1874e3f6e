"""The sweep over the number of frames (fig:comparison-to-8-point), as a figure and a table."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ghpt.report.figures import wrapped
from ghpt.report.pair_figures import METHOD_STYLES, OTHER_STYLE
from ghpt.report.pair_tables import NAMES
from ghpt.report.tables import NONE, markdown

_BANDS = ("weight", "eight_point")
"""The two of the paper's figure; the bands of others are fainter, so that many can be told apart.
"""
CLIP = 80.0
"""mm at which fig:comparison-to-8-point is cut."""

Sweep = Mapping[str, Mapping[int, Sequence[float]]]
"""Method -> M -> E_3D (mm; inf where it failed) of the repeats."""


def frames_sweep(results: Sweep, heading: str) -> Figure:
    """fig:comparison-to-8-point: mean E_3D over the repeats against M, with bands of one standard
    deviation, cut at ``CLIP`` mm.
    """
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    for name, by_frames in results.items():
        style = METHOD_STYLES.get(name, OTHER_STYLE)
        frames = sorted(by_frames)
        mean, deviation, _ = np.array([statistics_of(by_frames[m]) for m in frames]).T
        low, high = (
            np.clip(np.nan_to_num(mean + s * deviation, nan=np.inf, posinf=np.inf), 0, CLIP)
            for s in (-1, 1)
        )
        axes.fill_between(
            frames,
            low,
            high,
            color=style.colour,
            alpha=0.2 if name in _BANDS else 0.08,
            linewidth=0,
        )
        axes.plot(
            frames,
            np.minimum(mean, CLIP),
            color=style.colour,
            linestyle=style.dashes,
            marker=style.marker,
            markersize=5,
            markeredgecolor="white",
            markeredgewidth=0.6,
            linewidth=1.8,
            label=NAMES.get(name, name),
            zorder=4 if name == "weight" else 3,
        )
    ticks = sorted({m for by_frames in results.values() for m in by_frames})
    axes.set(
        xlabel="frames M",
        ylabel=f"$E_{{3D}}$, mm (cut at {CLIP:.0f})",
        xticks=ticks,
        ylim=(0, CLIP * 1.02),
    )
    axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(wrapped(heading, 75), fontsize=10)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def sweep_table(results: Sweep) -> str:
    """The sweep in Markdown: M x method, mean ± deviation (median) of E_3D, mm; a dash where a
    repeat failed.
    """
    rows = []
    for frames in sorted({m for by_frames in results.values() for m in by_frames}):
        cells = [_cell(by_frames.get(frames, ())) for by_frames in results.values()]
        rows.append([str(frames), *cells])
    return markdown(["M", *(NAMES.get(name, name) for name in results)], rows)


def _cell(values: Sequence[float]) -> str:
    mean, deviation, median = (
        NONE if not np.isfinite(x) else f"{x:.1f}" for x in statistics_of(values)
    )
    return NONE if not len(values) else f"{mean} ± {deviation} ({median})"


def pairs_table(results: Mapping[str, Sweep], methods: Sequence[str]) -> str:
    """Medians of E_3D (mm) of some methods, by M and pair; a star where the first is not below all
    others.
    """
    rows = []
    for frames in sorted({m for sweep in results.values() for m in sweep[methods[0]]}):
        cells = []
        for sweep in results.values():
            ours, *others = (statistics_of(sweep[method][frames])[2] for method in methods)
            star = "" if all(ours < other for other in others) else " *"
            cells.append(
                " / ".join(f"{x:.1f}" if np.isfinite(x) else NONE for x in (ours, *others)) + star
            )
        rows.append([str(frames), *cells])
    return markdown(["M", *results], rows)


def wins(sweeps: Iterable[Sweep], ours: str, other: str, statistic: int) -> list[bool]:
    """For each sweep and M, whether a statistic (its place in `statistics_of`) of one method is
    below another's.
    """
    return [
        statistics_of(sweep[ours][m])[statistic] < statistics_of(sweep[other][m])[statistic]
        for sweep in sweeps
        for m in sorted(sweep[ours])
    ]


def statistics_of(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean, deviation (of a sample; NaN where there is none) and median."""
    array = np.array(values, dtype=np.float64)
    if not len(array):
        return np.nan, np.nan, np.nan
    finite = bool(np.isfinite(array).all())
    deviation = float(array.std(ddof=1)) if finite and len(array) > 1 else 0.0 if finite else np.nan
    return float(array.mean()), deviation, float(np.median(array))
