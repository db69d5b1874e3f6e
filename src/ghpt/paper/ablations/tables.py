"""Ablations: one setting of the pose model changed at a time.

Validation chooses, and the test says what the choice is worth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from ghpt.paper.ablations import sweeps
from ghpt.paper.ablations.tasks import (
    BASE,
    CHANCE,
    NOTE,
    SPLITS,
    evaluate_model,
    read_error,
    train_variant,
)
from ghpt.paper.engine.artefact import Artefact, Results, Section, Spread, format_signed
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.report.document import Paragraph, Table
from ghpt.report.tables import NAMES

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
    splits: dict[str, tuple[str, ...]] = {}
    for data in setup.sizes.ablation.also_trained_on:
        splits[data] = ("test",)
    splits[BASE] = tuple(SPLITS)
    tasks = {}
    for data, of_data in splits.items():
        for name, experiment in variants.items():
            model = _train(setup, data, experiment)
            tasks[f"{data}: {name}"] = evaluate_model(setup, model, splits=of_data)
    return tasks


def _train(setup: Setup, data: str, experiment: str) -> Task:
    if not experiment:
        return setup.training(data)
    return train_variant(setup, data, f"experiment={experiment}", name=experiment)


def _section(results: Results, variants: Variants, about: str) -> Section:
    novel = [(data, "test") for data in results.setup.sizes.ablation.also_trained_on]
    columns = [*((BASE, split) for split in SPLITS), *novel]
    errors = {}
    for name in variants:
        errors[name] = [read_error(results, f"{data}: {name}", split) for data, split in columns]
    default = next(iter(variants))
    average = [
        read_error(results, f"{data}: {default}", split, "average") for data, split in columns
    ]
    rows = errors | {"average of the same pool": average}
    header = [
        SPLITS[split] if data == BASE else f"test, trained on {NAMES[data]}"
        for data, split in columns
    ]
    text = (
        f"{about} Pelvis-relative MPJPE of the weighted selection on Human3.6M, trained on "
        "Human3.6M unless said."
    )
    table = Table(
        ["MPJPE, mm", *header],
        [[name, *(error.text() for error in of_row)] for name, of_row in rows.items()],
    )
    return Section(results.display_name(BASE), [Paragraph(text), table, Paragraph(_choice(errors))])


def _choice(errors: Mapping[str, Sequence[Spread]]) -> str:
    """Return what the validation subject would choose, and what each other setting changes."""
    default = next(iter(errors))
    best = min(errors, key=lambda name: errors[name][0].mean)
    tied = errors[best][0].mean > (1 - CHANCE) * errors[default][0].mean
    sentences = ["Validation keeps the default." if tied else f"Validation would choose: {best}."]
    for name, of_variant in errors.items():
        if name != default:
            changes = _changes(of_variant, errors[default])
            sentences.append(f"Against the default, {name}: {changes}.")
    return " ".join([*sentences, NOTE])


def _changes(errors: Sequence[Spread], default: Sequence[Spread]) -> str:
    """Return the changes against the default in each column."""
    pairs = zip(errors, default, strict=True)
    changes = [100 * (error.mean / usual.mean - 1) for error, usual in pairs]
    return ", ".join(f"{format_signed(change)} %" for change in changes)


def _training(label: str, title: str, variants: Variants, about: str) -> Artefact:
    tasks = partial(_tasks, variants=variants)
    section = partial(_section, variants=variants, about=about)
    return Artefact(label, "ablation", title, tasks, section)


ARTEFACTS = (
    _training(
        "ablation-gumbel",
        "Gumbel noise in training",
        GUMBEL,
        "With the noise the weights of training are drawn from the Gumbel-softmax, without it they "
        "are the plain softmax of the test.",
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
        "The estimation loss is that of the weighted average, or of one hypothesis drawn from the "
        "weights (its gradient is that of the weights).",
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
