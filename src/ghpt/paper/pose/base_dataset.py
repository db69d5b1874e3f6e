"""The tables of one data set (paper, section 4.2, appendices C and D)."""

from __future__ import annotations

from typing import Any

from ghpt.paper.engine.artefact import (
    Artefact,
    Claim,
    Comparison,
    Results,
    Section,
    Spread,
    comparison_table,
)
from ghpt.paper.engine.setup import Setup, compose
from ghpt.paper.engine.tasks import Task
from ghpt.paper.published import (
    HYPERPARAMETERS,
    LIMITATION,
    QUANTITATIVE,
    QUANTITATIVE_COLUMNS,
    QUANTITATIVE_HYPOTHESES,
    QUANTITATIVE_MEAN,
    QUANTITATIVE_OTHERS,
)
from ghpt.report.escape import escaped
from ghpt.report.tables import NAMES, NONE, markdown

PANOPTIC = "cmu3"
"""Which of the four arrangements stands for Panoptic, of which the paper prints one column: its
24.9 mm occurs in tab:generalization-evaluation with CMU3's cameras alone.
"""
SELF = {"h36m": "h36m on h36m", PANOPTIC: f"{PANOPTIC} on {PANOPTIC}"}
SCORED = ("weight", "most", "stochastic")
"""The selections that a better scorer makes better; the others need none, look at the truth, or are
bad on purpose.
"""
BASELINES = ("ransac", "adaptive_ransac", "linear", "weighted_linear", "m_estimator", "lo_ransac")
VIEW_WEIGHTS = "view weights (not in the paper)"


def on_itself(setup: Setup, *names: str) -> dict[str, Task]:
    """Models tested on the arrangement that they were trained on, with all classical estimators."""
    return {SELF[data]: setup.tested(setup.trained(data), data) for data in names}


def _quantitative(results: Results) -> Section:
    def actions(name: str, selection: str) -> list[Spread]:
        found = [
            results.spread(name, "selections", selection, "per_action", action)
            for action in QUANTITATIVE
        ]
        return [*found, results.relative(name, selection)]

    ours = actions(SELF["h36m"], "weight")
    paper = [*QUANTITATIVE.values(), QUANTITATIVE_MEAN]
    compared = [
        Comparison(a, p, o) for a, p, o in zip([*QUANTITATIVE, "mean"], paper, ours, strict=True)
    ]
    columns = list(zip(*(number.cells() for number in compared), strict=True))
    rows = [
        [f"{name} (as published)", *map("{:.1f}".format, values)]
        for name, values in QUANTITATIVE_OTHERS.items()
    ]
    kinds = ("weight, the paper's", "weight, ours", "difference")
    rows += [[kind, *cells] for kind, cells in zip(kinds, columns, strict=True)]
    rows.append([VIEW_WEIGHTS, *(s.text() for s in actions(SELF["h36m"], "view_weights"))])
    rows += [
        [
            f"{NAMES.get(name, name)} on our detections",
            *(s.text() for s in actions(SELF["h36m"], name)),
        ]
        for name in BASELINES
    ]
    header = ["MPJPE, mm", *(QUANTITATIVE_COLUMNS[action] for action in QUANTITATIVE), "Avg"]
    text = (
        "The published rows are other systems' on real images. The synthetic actions carry Human3.6M's names and are "
        "synthetic motions: their numbers compare methods, not actions with the paper's."
    )
    mean = ours[-1].mean
    beaten = [name for name, values in QUANTITATIVE_OTHERS.items() if mean < values[-1]]
    claim = Claim(
        "2.2 mm behind epipolar transformers, and ahead of most other methods without additional data",
        "4.2",
        results.on_real("h36m", len(beaten) >= 4),
        f"{mean:.1f} mm: ahead of {len(beaten)} of 5 (29.1 mm: 4 of 5)",
    )
    return Section(
        results.display_name("h36m"),
        f"{text}\n\n{markdown(header, rows)}",
        {},
        compared,
        [claim],
        _ACTIONS,
    )


_ACTIONS = (
    "Synthetic motion and self-occlusion of an action are not those of the recorded one, so single actions differ in "
    "both directions; the mean is what was fitted in its learning-free rows."
)


def _hypotheses(results: Results) -> Section:
    tables = []
    compared = []
    claims = []
    for data, test in SELF.items():
        name = "Human3.6M" if data == "h36m" else "Panoptic Studio"
        paper = QUANTITATIVE_HYPOTHESES["h36m" if data == "h36m" else "panoptic"]
        rows = [
            Comparison(
                NAMES.get(s, s),
                value,
                results.relative(test, s),
                "lower" if s in SCORED else "same",
            )
            for s, value in paper.items()
        ]
        others = [Comparison(VIEW_WEIGHTS, None, results.relative(test, "view_weights"))]
        others += [
            Comparison(NAMES.get(s, s), None, results.relative(test, s)) for s in BASELINES[1:]
        ]
        about = f"**{escaped(results.display_name(data))}**, trained on the same"
        tables.append(f"{about}\n\n{comparison_table([*rows, *others], 'hypothesis')}")
        compared += [
            Comparison(f"{name}, {row.what}", row.paper, row.ours, row.better) for row in rows
        ]
        claims += _hypotheses_claims(
            name, {s: results.relative(test, s).mean for s in paper}, paper
        )
    gaps = {
        data: results.relative(t, "worst").mean - results.relative(t, "best").mean
        for data, t in SELF.items()
    }
    claims.append(
        Claim(
            "hypotheses on Panoptic are more alike than on Human3.6M (worst - best)",
            "4.2",
            gaps[PANOPTIC] < 0.5 * gaps["h36m"],
            f"{gaps[PANOPTIC]:.1f} against {gaps['h36m']:.1f} mm (6.6 against 76.6)",
        )
    )
    return Section(
        f"{results.display_name('h36m')} and {results.display_name(PANOPTIC)}",
        "\n\n".join(tables),
        {},
        compared,
        claims,
        _explained_hypotheses(results),
    )


def _explained_hypotheses(results: Results) -> str:
    def ours(data: str, selection: str) -> str:
        return f"{results.relative(SELF[data], selection).mean:.1f}"

    h36m, panoptic = (
        {s: ours(data, s) for s in ("weight", "average", "most", "least", "stochastic", "random")}
        for data in SELF
    )
    return (
        "The synthetic detector was fitted to the learning-free rows (random, average, best, worst; RANSAC on "
        "Human3.6M), so these agree by construction and the learned rows are results. There our scorer tells "
        f"hypotheses apart more sharply than the paper's: on Human3.6M *most* has {h36m['most']} mm, {h36m['least']} "
        f"mm has *least*; on Panoptic *stochastic* ({panoptic['stochastic']}) is better than *random* "
        f"({panoptic['random']}), where the paper's is worse, and *most* ({panoptic['most']}) is better than *weight* "
        f"({panoptic['weight']}), which the temperature keeps near the *average* ({panoptic['average']}) of hypotheses "
        "that hardly differ. The paper's RANSAC on Panoptic, 39.5 mm, is worse than the worst hypothesis of its own "
        "pools."
    )


def _hypotheses_claims(name: str, ours: dict[str, float], paper: dict[str, float]) -> list[Claim]:
    """The sentences of section 4.2 on one data set."""

    def order(statement: str, low: str, high: str) -> Claim:
        by = (
            f"{ours[low]:.1f} < {ours[high]:.1f}"
            if ours[low] < ours[high]
            else f"{ours[low]:.1f} >= {ours[high]:.1f}"
        )
        return Claim(
            f"{name}: {statement}",
            "4.2",
            ours[low] < ours[high],
            f"{by} mm ({paper[low]} and {paper[high]})",
        )

    without_truth = {s: e for s, e in ours.items() if s not in ("best", "worst", "ransac")}
    second = min(e for s, e in without_truth.items() if s != "weight")
    claims = [
        Claim(
            f"{name}: the weighted hypothesis is the best of those that do not look at the truth",
            "4.2",
            ours["weight"] < second,
            f"{ours['weight']:.1f} mm, the next one {second:.1f}",
        ),
        order("most < least", "most", "least"),
        order("average < stochastic", "average", "stochastic"),
    ]
    if name == "Human3.6M":
        claims.append(order("RANSAC < weight (the paper's one loss)", "ransac", "weight"))
    else:
        claims += [
            order("weight < RANSAC", "weight", "ransac"),
            order("most < average", "most", "average"),
            order("random < stochastic", "random", "stochastic"),
        ]
    return claims


def _limitation_tasks(setup: Setup) -> dict[str, Task]:
    model = setup.trained("h36m")
    splits = {
        split: setup.tested(
            model, "h36m", f"data.evaluate={split}", name=split, baselines=False, view_weights=False
        )
        for split in ("train", "validation")
    }
    return splits | {"test": setup.tested(model, "h36m")}


def _limitation(results: Results) -> Section:
    rows = [
        Comparison(split, value, results.relative(split)) for split, value in LIMITATION.items()
    ]
    train, validation, test = (row.ours.mean for row in rows)
    claim = Claim(
        "validation is as good as training and the test subjects are far worse: the detector has not seen them",
        "D",
        abs(validation / train - 1) < 0.1 and test > 1.5 * train,
        f"{train:.1f}, {validation:.1f}, {test:.1f} mm (13.8, 14.2, 29.1)",
    )
    note = (
        "The synthetic detector is twice as precise on training and validation subjects by design, for the paper's was "
        "trained on them."
    )
    text = comparison_table(rows, "split of Human3.6M")
    synthetic = results.setup.root("h36m") is None
    return Section(
        results.display_name("h36m"), f"{text}\n\n{note}" if synthetic else text, {}, rows, [claim]
    )


def _hyperparameters(results: Results) -> Section:
    pose, camera = (_settings(results.setup, model) for model in ("pose", "camera"))
    rows = [
        [what, paper[0] or NONE, pose[what], paper[1] or NONE, camera[what]]
        for what, paper in HYPERPARAMETERS.items()
    ]
    text = (
        "Read from the composed configuration. The paper prints the learning rates as 5\\*10e-4 and 10e-5; the "
        "authors' code has 0.0005 for the pose."
    )
    table = markdown(["", "3D pose, paper", "3D pose, ours", "camera, paper", "camera, ours"], rows)
    return Section("settings, no data", f"{text}\n\n{table}")


def _settings(setup: Setup, name: str) -> dict[str, str]:
    """tab:hyperparameters' rows of one model's configuration."""
    config: dict[str, Any] = compose(
        setup.conf, "train", (f"model={name}", "data=h36m", *setup.overrides["train"])
    )
    model = config["model"]
    loss = config["model"]["loss"]
    samples = config["data"]["train_samples"]
    epochs = config["trainer"]["max_epochs"]
    return {
        "learning rate": f"{model['optimizer']['lr']:g}",
        "temperature": str(model["temperature"]),
        "alpha, beta, gamma": ", ".join(str(loss[key]) for key in ("alpha", "beta", "gamma")),
        "layers": ", ".join(map(str, model["scorer"]["layers"])),
        "hypotheses": str(model["hypotheses"]),
        "batch size": str(config["data"]["batch_size"]),
        "frames M": str(model["problem"].get("frames", NONE)),
        "training samples": f"{samples}" if epochs == 1 else f"{samples}, {epochs} times",
    }


ARTEFACTS = (
    Artefact(
        "quantitative",
        "table",
        "Human3.6M, action by action",
        lambda setup: on_itself(setup, "h36m"),
        _quantitative,
    ),
    Artefact(
        "quantitative-hypotheses",
        "table",
        "The hypotheses compared",
        lambda setup: on_itself(setup, *SELF),
        _hypotheses,
    ),
    Artefact(
        "limitation-table",
        "table",
        "Train, validation and test subjects",
        _limitation_tasks,
        _limitation,
    ),
    Artefact("hyperparameters", "table", "Hyper-parameters", lambda setup: {}, _hyperparameters),
)
