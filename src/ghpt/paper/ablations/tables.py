"""Ablations: one setting of the pose model changed at a time; validation chooses, the test says
what it is worth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from ghpt.paper.ablations import sweeps
from ghpt.paper.ablations.tasks import BASE, CHANCE, NOTE, SETS, evaluated, number, trained
from ghpt.paper.engine.artefact import Artefact, Results, Section, Spread, signed
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.report.tables import NAMES, markdown

Variants = Mapping[str, str]
"""Name -> experiment of conf/experiment; none for the default."""
GUMBEL: Variants = {"with Gumbel noise (default)": "", "without": "no_gumbel"}
FEATURES: Variants = {
    "coordinates and lengths (default)": "",
    "coordinates only": "coordinates_only",
    "lengths only": "lengths_only",
}
SELECTION: Variants = {
    "weighted average (default)": "",
    "one drawn, straight through": "selection_stochastic",
}


def _tasks(setup: Setup, variants: Variants) -> dict[str, Task]:
    def model(data: str, experiment: str) -> Task:
        if not experiment:
            return setup.trained(data)
        return trained(setup, data, f"experiment={experiment}", name=experiment)

    splits = dict.fromkeys(setup.sizes["ablation"]["also_trained_on"], ("test",)) | {
        BASE: tuple(SETS)
    }
    return {
        f"{data}: {name}": evaluated(setup, model(data, experiment), splits=of_data)
        for data, of_data in splits.items()
        for name, experiment in variants.items()
    }


def _section(results: Results, variants: Variants, about: str) -> Section:
    novel = [(data, "test") for data in results.setup.sizes["ablation"]["also_trained_on"]]
    columns = [*((BASE, split) for split in SETS), *novel]
    numbers = {
        name: [number(results, f"{data}: {name}", split) for data, split in columns]
        for name in variants
    }
    usual = next(iter(variants))
    average = [number(results, f"{data}: {usual}", split, "average") for data, split in columns]
    rows = [[name, *(s.text() for s in spreads)] for name, spreads in numbers.items()]
    rows.append(["average of the same pool", *(s.text() for s in average)])
    head = [
        "MPJPE, mm",
        *(
            SETS[split] if data == BASE else f"test, trained on {NAMES[data]}"
            for data, split in columns
        ),
    ]
    table = "Pelvis-relative MPJPE of the weighted selection on Human3.6M, trained on Human3.6M unless said."
    body = [f"{about} {table}", markdown(head, rows), _chosen(numbers)]
    return Section(results.display_name(BASE), "\n\n".join(body))


def _chosen(numbers: Mapping[str, Sequence[Spread]]) -> str:
    """What the validation subject would choose, and what each other setting changes."""
    usual = next(iter(numbers))
    best = min(numbers, key=lambda name: numbers[name][0].mean)
    tied = numbers[best][0].mean > (1 - CHANCE) * numbers[usual][0].mean
    parts = ["Validation keeps the default." if tied else f"Validation would choose: {best}."]
    for name, spreads in numbers.items():
        if name != usual:
            changes = (
                100 * (a.mean / b.mean - 1) for a, b in zip(spreads, numbers[usual], strict=True)
            )
            parts.append(
                f"Against the default, {name}: {', '.join(f'{signed(change)} %' for change in changes)}."
            )
    return " ".join([*parts, NOTE])


def _training(label: str, title: str, variants: Variants, about: str) -> Artefact:
    return Artefact(
        label,
        "ablation",
        title,
        partial(_tasks, variants=variants),
        partial(_section, variants=variants, about=about),
    )


ARTEFACTS = (
    _training(
        "ablation-gumbel",
        "Gumbel noise in training",
        GUMBEL,
        "With the noise the weights of training are drawn from the Gumbel-softmax, without it they are the plain "
        "softmax of the test.",
    ),
    _training(
        "ablation-features",
        "What the scorer sees",
        FEATURES,
        "The scorer sees the normalised coordinates of the 17 joints and the 16 body part lengths.",
    ),
    _training(
        "ablation-selection",
        "The hypothesis of the estimation loss",
        SELECTION,
        "The estimation loss is that of the weighted average, or of one hypothesis drawn from the weights (its "
        "gradient is that of the weights).",
    ),
    Artefact(
        "ablation-temperature",
        "ablation",
        "Temperature of the softmax",
        sweeps.temperature_tasks,
        sweeps.temperature,
    ),
    Artefact(
        "ablation-hypotheses",
        "ablation",
        "Number of hypotheses",
        sweeps.hypotheses_tasks,
        sweeps.hypotheses,
    ),
    Artefact(
        "ablation-samples",
        "ablation",
        "Number of training samples",
        sweeps.samples_tasks,
        sweeps.samples,
    ),
)
