"""Ablations over a quantity: temperature, hypotheses, training samples; a table and a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ghpt.paper.ablations.tasks import BASE, CHANCE, DEFAULT, NOTE, SETS, evaluated, number, trained
from ghpt.paper.engine.artefact import Claim, Results, Section, Spread, signed
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.robustness.figure import LABELS, Panel, curves
from ghpt.report.tables import NAMES, NONE, markdown

Place = float | int
"""A number of hypotheses, say."""
Row = tuple[str, str, int]
"""Task, selection, number of the setting."""
Lines = Mapping[str, Mapping[Place, Row]]
"""Style -> place -> what stands there."""


def default(setup: Setup, *keys: str) -> Any:
    """Of the configuration of training."""
    value: Any = setup.trained(BASE).config
    for key in keys:
        value = value[key]
    return value


def levels(setup: Setup, name: str, *keys: str) -> list[Place]:
    """Of ``sizes.ablation``, and the default, which ``keys`` lead to."""
    return sorted({*setup.sizes["ablation"][name], default(setup, *keys)})


def temperature_tasks(setup: Setup) -> dict[str, Task]:
    values = levels(setup, "temperature", "model", "temperature")
    tasks = {
        name: evaluated(setup, setup.trained(data), [(None, value) for value in values])
        for name, data in {DEFAULT: BASE, **{novel: novel for novel in _novel(setup)}}.items()
    }
    for value in values:
        if value != default(setup, "model", "temperature"):
            model = trained(setup, BASE, f"model.temperature={value}", name=f"temperature{value:g}")
            tasks[f"{value:g}"] = evaluated(setup, model)
    return tasks


def _novel(setup: Setup) -> list[str]:
    """The first other training set, if there is one: what a temperature is worth depends on it."""
    return setup.sizes["ablation"]["also_trained_on"][:1]


def temperature(results: Results) -> Section:
    setup = results.setup
    values, usual = (
        f(setup, *x, "model", "temperature") for f, x in ((levels, ("temperature",)), (default, ()))
    )
    lines: dict[str, Mapping[Place, Row]] = {
        "weight": {
            v: (DEFAULT, "weight", i) if v == usual else (f"{v:g}", "weight", 0)
            for i, v in enumerate(values)
        },
        "tested": {v: (DEFAULT, "weight", i) for i, v in enumerate(values)},
        "average": {v: (DEFAULT, "average", i) for i, v in enumerate(values)},
    }
    labels = LABELS | {
        "weight": "trained and tested with it",
        "tested": f"trained with {usual:g}, tested with it",
    }
    for novel in _novel(setup):
        lines["trained"] = {v: (novel, "weight", i) for i, v in enumerate(values)}
        labels["trained"] = f"the same, trained on {NAMES[novel]}"
    text = (
        "The temperature divides the logits before the softmax. Low, the weights gather on the best-scored hypotheses; "
        "high, they become the average."
    )
    return _section(results, "temperature", "temperature", lines, labels, text, usual)


def hypotheses_tasks(setup: Setup) -> dict[str, Task]:
    values = levels(setup, "hypotheses", "model", "hypotheses")
    usual = default(setup, "model", "hypotheses")
    tasks = {
        DEFAULT: evaluated(
            setup, setup.trained(BASE), [(value, None) for value in values], seconds=30.0
        )
    }
    for value in setup.sizes["ablation"]["hypotheses_trained"]:
        if value != usual:
            seconds = 4 + 16 * value / usual
            model = trained(
                setup, BASE, f"model.hypotheses={value}", name=f"hypotheses{value}", seconds=seconds
            )
            tasks[f"{value}"] = evaluated(setup, model, [(usual, None)])
    return tasks


def hypotheses(results: Results) -> Section:
    setup = results.setup
    values, usual = (
        f(setup, *x, "model", "hypotheses") for f, x in ((levels, ("hypotheses",)), (default, ()))
    )
    lines: dict[str, Mapping[Place, Row]] = {
        name: {v: (DEFAULT, name, i) for i, v in enumerate(values)}
        for name in ("weight", "average", "best")
    }
    taught = sorted({*setup.sizes["ablation"]["hypotheses_trained"], usual})
    lines["trained"] = {
        v: (DEFAULT, "weight", values.index(usual)) if v == usual else (f"{v}", "weight", 0)
        for v in taught
    }
    labels = LABELS | {
        "weight": f"learned, trained with {usual}, tested with it",
        "trained": f"learned, trained with it, tested with {usual}",
    }
    text = "Hypotheses in a pool. A smaller pool is the beginning of a larger one. The best hypothesis looks at the truth."
    return _section(results, "hypotheses", "hypotheses", lines, labels, text, usual)


def samples_tasks(setup: Setup) -> dict[str, Task]:
    usual = default(setup, "data", "train_samples")
    hypotheses = default(setup, "model", "hypotheses")
    pool = setup.sizes["ablation"]["samples_hypotheses"]
    tasks = {"model": setup.trained(BASE)}
    for value in levels(setup, "samples", "data", "train_samples"):
        changes = [f"model.hypotheses={pool}"]
        seconds = 4 + 25 * value / usual * pool / hypotheses
        name = f"hypotheses{pool}"
        if value != usual:
            changes = [*changes, f"data.train_samples={value}"]
            name = f"samples{value}-{name}"
        model = trained(setup, BASE, *changes, name=name, seconds=seconds)
        tasks[f"{value}"] = evaluated(setup, model, [(hypotheses, None)])
    return tasks


def samples(results: Results) -> Section:
    setup = results.setup
    values, usual = (
        f(setup, *x, "data", "train_samples") for f, x in ((levels, ("samples",)), (default, ()))
    )
    name = {v: f"{v}" for v in values}
    pool = setup.sizes["ablation"]["samples_hypotheses"]
    tested = default(setup, "model", "hypotheses")
    lines: Lines = {
        "weight": {v: (name[v], "weight", 0) for v in values},
        "average": {v: (name[v], "average", 0) for v in values},
    }
    text = (
        "Training samples, each seen once, in batches of 16: a model trained on 50 has had four steps. More samples "
        f"mean more steps too, as in appendix C, where an iteration is a sample. All models of this sweep are trained "
        f"with {pool} hypotheses, for the sake of time, and tested with {tested}; what that costs is in "
        "ablation-hypotheses."
    )
    claims = [_enough(results, name, usual), _minutes(results)]
    return _section(results, "samples", "training samples", lines, LABELS, text, usual, claims)


def _enough(results: Results, tasks: Mapping[Place, str], usual: Place) -> Claim:
    """Appendix C on the number of samples."""
    errors = {n: number(results, task, "test").mean for n, task in tasks.items()}
    best = min(errors, key=lambda n: errors[n])
    by = (
        f"{errors[usual]:.1f} mm of {usual:g}; the best of {', '.join(f'{n:g}' for n in tasks)} is {best:g} with "
        f"{errors[best]:.1f} mm ({signed(100 * (errors[best] / errors[usual] - 1))} %)"
    )
    return Claim(
        "best results with only 500 samples (held if within 1 % of the best)",
        "C",
        errors[usual] <= 1.01 * errors[best],
        by,
    )


def _minutes(results: Results) -> Claim:
    seconds = Spread(tuple(about["seconds"] for about in results.read("model", "task.json")))
    return Claim(
        "about 3 minutes to train",
        "C",
        seconds.mean <= 180,
        f"{seconds.mean:.0f} s on a processor, beside other work",
    )


def _section(
    results: Results,
    name: str,
    head: str,
    lines: Lines,
    labels: Mapping[str, str],
    text: str,
    usual: Place,
    claims: Sequence[Claim] = (),
) -> Section:
    """A table with a row for each place, and a panel for each set."""
    numbers = {
        split: {
            style: {
                x: number(results, task, split, selection, i)
                for x, (task, selection, i) in row.items()
            }
            for style, row in lines.items()
        }
        for split in SETS
    }
    panels = [
        Panel(
            f"{head}; {SETS[split]}",
            {style: (list(row), list(row.values())) for style, row in rows.items()},
            logarithmic=True,
            mark=usual,
        )
        for split, rows in numbers.items()
    ]
    data = results.display_name(BASE)
    figure = curves(
        panels,
        f"{data}, trained on its training subjects unless said",
        "pelvis-relative MPJPE, mm",
        labels,
        False,
    )
    body = [
        f"{text} Trained and tested on Human3.6M unless said.",
        f"![Pelvis-relative MPJPE against {head}, {data}](ablation_{name}.svg)",
        *(
            f"Pelvis-relative MPJPE, mm, {SETS[split]}:\n\n{_table(head, numbers[split], labels, usual)}"
            for split in SETS
        ),
        _chosen(numbers["validation"]["weight"], numbers["test"]["weight"], usual),
    ]
    return Section(data, "\n\n".join(body), {f"ablation_{name}": figure}, claims=claims)


def _table(
    head: str, lines: Mapping[str, Mapping[Place, Spread]], labels: Mapping[str, str], usual: Place
) -> str:
    """A row for each place, a column for each line."""
    places = sorted({x for row in lines.values() for x in row})
    return markdown(
        [head, *(labels.get(name, name) for name in lines)],
        [
            [f"{x:g}{' (default)' * (x == usual)}", *(_text(row.get(x)) for row in lines.values())]
            for x in places
        ],
    )


def _chosen(validation: Mapping[Place, Spread], test: Mapping[Place, Spread], usual: Place) -> str:
    """What the validation subject would choose, and what that is worth on the test."""
    best = min(validation, key=lambda x: validation[x].mean)
    gain, worth = (
        signed(100 * (errors[best].mean / errors[usual].mean - 1)) for errors in (validation, test)
    )
    if validation[best].mean > (1 - CHANCE) * validation[usual].mean:
        least = "" if best == usual else f" (the least error is at {best:g}, {gain} %)"
        return f"Validation keeps the default, {usual:g}{least}. {NOTE}"
    return f"Validation would choose {best:g} ({gain} % against the default); on the test subjects that is {worth} %."


def _text(spread: Spread | None) -> str:
    return NONE if spread is None else spread.text()
