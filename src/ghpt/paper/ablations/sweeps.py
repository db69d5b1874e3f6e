"""Ablations over a quantity, with a table and a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ghpt.paper.ablations.actions import PoolSetting
from ghpt.paper.ablations.tasks import (
    BASE,
    CHANCE,
    DEFAULT,
    NOTE,
    SPLITS,
    evaluate_model,
    read_error,
    train_variant,
)
from ghpt.paper.engine.artefact import (
    Claim,
    Number,
    Results,
    Section,
    Spread,
    figure_block,
    format_signed,
)
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.robustness.figure import LABELS, Line, Panel, draw_curves
from ghpt.report.document import Block, Paragraph, Table
from ghpt.report.tables import NAMES, NONE


@dataclass(frozen=True)
class Source:
    """Where an error stands: a task, a selection, and the number of the pool."""

    task: str
    selection: str
    pool: int = 0


@dataclass(frozen=True)
class SweepLine:
    """A column of the table and a line of the figure."""

    label: str
    sources: Mapping[Number, Source]
    """By the quantity, such as a number of hypotheses."""


@dataclass(frozen=True)
class Quantity:
    """What a sweep varies."""

    name: str
    """The name of its figure."""
    label: str
    """The head of its table and the label of the axis."""
    default: Number
    about: str


Errors = Mapping[str, Mapping[Number, Spread]]
"""Style -> quantity -> error (mm)."""


@dataclass(frozen=True)
class Defaults:
    """The defaults of training that the sweeps vary."""

    temperature: float
    hypotheses: int
    samples: int

    @classmethod
    def from_setup(cls, setup: Setup) -> Defaults:
        """Return the defaults in a setup's configuration of training."""
        config = setup.training(BASE).config
        model = config["model"]
        samples = config["data"]["train_samples"]
        return cls(float(model["temperature"]), model["hypotheses"], samples)


def temperature_tasks(setup: Setup) -> dict[str, Task]:
    """Return models trained with each temperature, and the default's tested with each."""
    default = Defaults.from_setup(setup).temperature
    values = _temperatures(setup)
    pools = [PoolSetting(temperature=value) for value in values]
    trainings = {DEFAULT: BASE, **{data: data for data in _novel(setup)}}
    tasks = {
        name: evaluate_model(setup, setup.training(data), pools) for name, data in trainings.items()
    }
    for value in values:
        if value != default:
            override = f"model.temperature={value}"
            model = train_variant(setup, BASE, override, name=f"temperature{value:g}")
            tasks[f"{value:g}"] = evaluate_model(setup, model)
    return tasks


def _temperatures(setup: Setup) -> list[float]:
    return sorted({*setup.sizes.ablation.temperature, Defaults.from_setup(setup).temperature})


def _novel(setup: Setup) -> Sequence[str]:
    """Return the first other training set, if any: what a temperature is worth depends on it."""
    return setup.sizes.ablation.also_trained_on[:1]


def temperature(results: Results) -> Section:
    """Return the section of the temperature."""
    setup = results.setup
    default = Defaults.from_setup(setup).temperature
    values = _temperatures(setup)
    trained = {value: Source(f"{value:g}", "weight") for value in values}
    trained[default] = Source(DEFAULT, "weight", values.index(default))
    lines = {
        "weight": SweepLine("trained and tested with it", trained),
        "tested": SweepLine(
            f"trained with {default:g}, tested with it", _pool_sources(DEFAULT, "weight", values)
        ),
        "average": SweepLine(LABELS["average"], _pool_sources(DEFAULT, "average", values)),
    }
    for data in _novel(setup):
        label = f"the same, trained on {NAMES[data]}"
        lines["trained"] = SweepLine(label, _pool_sources(data, "weight", values))
    about = (
        "The temperature divides the logits before the softmax. Low, the weights gather on the "
        "best-scored hypotheses; high, they become the average."
    )
    return _section(results, Quantity("temperature", "temperature", default, about), lines)


def _pool_sources(task: str, selection: str, values: Sequence[Number]) -> dict[Number, Source]:
    """Return the sources of a task that was tested with a pool for each value."""
    return {value: Source(task, selection, index) for index, value in enumerate(values)}


def hypotheses_tasks(setup: Setup) -> dict[str, Task]:
    """Return the default's model tested with each number, and models trained with some."""
    default = Defaults.from_setup(setup).hypotheses
    pools = [PoolSetting(hypotheses=value) for value in _hypotheses(setup)]
    tasks = {DEFAULT: evaluate_model(setup, setup.training(BASE), pools, seconds=30.0)}
    for value in setup.sizes.ablation.hypotheses_trained:
        if value != default:
            model = train_variant(
                setup,
                BASE,
                f"model.hypotheses={value}",
                name=f"hypotheses{value}",
                seconds=4 + 16 * value / default,
            )
            tasks[f"{value}"] = evaluate_model(setup, model, [PoolSetting(hypotheses=default)])
    return tasks


def _hypotheses(setup: Setup) -> list[int]:
    return sorted({*setup.sizes.ablation.hypotheses, Defaults.from_setup(setup).hypotheses})


def hypotheses(results: Results) -> Section:
    """Return the section of the number of hypotheses."""
    setup = results.setup
    default = Defaults.from_setup(setup).hypotheses
    values = _hypotheses(setup)
    weight = f"learned, trained with {default}, tested with it"
    labels = {"weight": weight, "average": LABELS["average"], "best": LABELS["best"]}
    lines = {
        name: SweepLine(label, _pool_sources(DEFAULT, name, values))
        for name, label in labels.items()
    }
    trained = sorted({*setup.sizes.ablation.hypotheses_trained, default})
    sources: dict[Number, Source] = {value: Source(f"{value}", "weight") for value in trained}
    sources[default] = Source(DEFAULT, "weight", values.index(default))
    lines["trained"] = SweepLine(f"learned, trained with it, tested with {default}", sources)
    about = (
        "Hypotheses in a pool. A smaller pool is the beginning of a larger one. The best "
        "hypothesis looks at the truth."
    )
    return _section(results, Quantity("hypotheses", "hypotheses", default, about), lines)


def samples_tasks(setup: Setup) -> dict[str, Task]:
    """Return models trained with each number of samples, in smaller pools."""
    defaults = Defaults.from_setup(setup)
    pool = setup.sizes.ablation.samples_hypotheses
    tasks = {"model": setup.training(BASE)}
    for value in _samples(setup):
        overrides = [f"model.hypotheses={pool}"]
        name = f"hypotheses{pool}"
        if value != defaults.samples:
            overrides.append(f"data.train_samples={value}")
            name = f"samples{value}-{name}"
        seconds = 4 + 25 * value / defaults.samples * pool / defaults.hypotheses
        model = train_variant(setup, BASE, *overrides, name=name, seconds=seconds)
        tested = [PoolSetting(hypotheses=defaults.hypotheses)]
        tasks[f"{value}"] = evaluate_model(setup, model, tested)
    return tasks


def _samples(setup: Setup) -> list[int]:
    return sorted({*setup.sizes.ablation.samples, Defaults.from_setup(setup).samples})


def samples(results: Results) -> Section:
    """Return the section of the number of training samples."""
    setup = results.setup
    defaults = Defaults.from_setup(setup)
    values = _samples(setup)
    pool = setup.sizes.ablation.samples_hypotheses
    lines = {}
    for name in ("weight", "average"):
        sources: dict[Number, Source] = {value: Source(f"{value}", name) for value in values}
        lines[name] = SweepLine(LABELS[name], sources)
    about = (
        "Training samples, each seen once, in batches of 16: a model trained on 50 has had four "
        "steps. More samples mean more steps too, as in appendix C, where an iteration is a "
        f"sample. All models of this sweep are trained with {pool} hypotheses, for the sake of "
        f"time, and tested with {defaults.hypotheses}; what that costs is in ablation-hypotheses."
    )
    quantity = Quantity("samples", "training samples", defaults.samples, about)
    claims = [_enough_claim(results, values, defaults.samples), _minutes_claim(results)]
    return _section(results, quantity, lines, claims)


def _enough_claim(results: Results, values: Sequence[int], default: int) -> Claim:
    """Return what appendix C says of the number of samples."""
    errors = {value: read_error(results, f"{value}", "test").mean for value in values}
    best = min(errors, key=errors.__getitem__)
    gain = format_signed(100 * (errors[best] / errors[default] - 1))
    tested = ", ".join(f"{value:g}" for value in values)
    return Claim(
        "best results with only 500 samples (held if within 1 % of the best)",
        "C",
        errors[default] <= 1.01 * errors[best],
        f"{errors[default]:.1f} mm of {default:g}; the best of {tested} is {best:g} with "
        f"{errors[best]:.1f} mm ({gain} %)",
    )


def _minutes_claim(results: Results) -> Claim:
    seconds = results.spread("model", "seconds", file="task.json").mean
    evidence = f"{seconds:.0f} s on a processor, beside other work"
    return Claim("about 3 minutes to train", "C", seconds <= 180, evidence)


def _section(
    results: Results,
    quantity: Quantity,
    lines: Mapping[str, SweepLine],
    claims: Sequence[Claim] = (),
) -> Section:
    """Return a table with a row for each value of the quantity, and a panel for each split."""
    labels = {style: line.label for style, line in lines.items()}
    errors = {split: _errors(results, lines, split) for split in SPLITS}
    panels = [_panel(quantity, split, errors[split]) for split in SPLITS]
    data = results.display_name(BASE)
    heading = f"{data}, trained on its training subjects unless said"
    figure = draw_curves(panels, heading, "pelvis-relative MPJPE, mm", labels, share=False)
    name = f"ablation_{quantity.name}"
    caption = f"Pelvis-relative MPJPE against {quantity.label}, {data}"
    blocks: list[Block] = [
        Paragraph(f"{quantity.about} Trained and tested on Human3.6M unless said."),
        figure_block(name, caption),
    ]
    for split, shown in SPLITS.items():
        blocks.append(Paragraph(f"Pelvis-relative MPJPE, mm, {shown}:"))
        blocks.append(_table(quantity, errors[split], labels))
    blocks.append(Paragraph(_choice(errors, quantity.default)))
    return Section(data, blocks, {name: figure}, claims=claims)


def _errors(
    results: Results, lines: Mapping[str, SweepLine], split: str
) -> dict[str, dict[Number, Spread]]:
    """Return the errors of each line on a split."""
    errors: dict[str, dict[Number, Spread]] = {}
    for style, line in lines.items():
        errors[style] = {
            value: read_error(results, source.task, split, source.selection, source.pool)
            for value, source in line.sources.items()
        }
    return errors


def _panel(quantity: Quantity, split: str, errors: Errors) -> Panel:
    lines = {
        style: Line(list(by_value), list(by_value.values())) for style, by_value in errors.items()
    }
    label = f"{quantity.label}; {SPLITS[split]}"
    return Panel(label, lines, logarithmic=True, mark=quantity.default)


def _table(quantity: Quantity, errors: Errors, labels: Mapping[str, str]) -> Table:
    """Return a table with a row for each value of the quantity and a column for each line."""
    values = sorted({value for by_value in errors.values() for value in by_value})
    rows = []
    for value in values:
        name = f"{value:g} (default)" if value == quantity.default else f"{value:g}"
        of_value = [by_value.get(value) for by_value in errors.values()]
        rows.append([name, *(NONE if error is None else error.text() for error in of_value)])
    return Table([quantity.label, *(labels[style] for style in errors)], rows)


def _choice(errors: Mapping[str, Errors], default: Number) -> str:
    """Return what the validation subject would choose, and what that is worth on the test."""
    validation = {value: error.mean for value, error in errors["validation"]["weight"].items()}
    test = {value: error.mean for value, error in errors["test"]["weight"].items()}
    best = min(validation, key=validation.__getitem__)
    gain = format_signed(100 * (validation[best] / validation[default] - 1))
    worth = format_signed(100 * (test[best] / test[default] - 1))
    if validation[best] > (1 - CHANCE) * validation[default]:
        least = "" if best == default else f" (the least error is at {best:g}, {gain} %)"
        return f"Validation keeps the default, {default:g}{least}. {NOTE}"
    return (
        f"Validation would choose {best:g} ({gain} % against the default); on the test subjects "
        f"that is {worth} %."
    )
