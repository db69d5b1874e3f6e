"""The table across camera arrangements (paper, section 4.1)."""

from __future__ import annotations

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
)
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.published import (
    ARRANGEMENTS,
    GENERALIZATION,
    GENERALIZATION_MAX_DIFFERENCE,
)
from ghpt.report.tables import markdown, max_difference

PANOPTIC = ARRANGEMENTS[:4]


def grid(
    setup: Setup, trained: Sequence[str] = ARRANGEMENTS, tested: Sequence[str] = ARRANGEMENTS
) -> dict[str, Task]:
    """Every training set with every test set: ``"cmu1 on h36m"``; classical estimators where the
    two are the same.
    """
    models = {data: setup.trained(data) for data in trained}
    return {
        f"{train} on {test}": setup.tested(models[train], test, baselines=train == test)
        for train, test in product(trained, tested)
    }


def _generalization(results: Results) -> Section:
    rows = []
    compared = []
    for test in ARRANGEMENTS:
        numbers = [
            Comparison(
                f"{a.upper()} on {test.upper()}",
                GENERALIZATION[a, test],
                results.relative(f"{a} on {test}"),
            )
            for a in ARRANGEMENTS
        ]
        last = [
            f"{GENERALIZATION_MAX_DIFFERENCE[test]:.1f} %",
            f"{_difference(results, test).text()} %",
            "",
        ]
        columns = zip(*(number.cells() for number in numbers), strict=True)
        for kind, cells, end in zip(("paper", "ours", "difference"), columns, last, strict=True):
            rows.append([f"{test.upper()}, {kind}", *cells, end])
        rows.append(
            [
                f"{test.upper()}, average of the pool",
                *(results.relative(f"{a} on {test}", "average").text() for a in ARRANGEMENTS),
                "",
            ]
        )
        compared += numbers
    header = ["test, mm \\ train", *(name.upper() for name in ARRANGEMENTS), "max. diff."]
    text = (
        "A row is a test set, a column a training set, as the paper's text reads the table. The last column is "
        "(largest - smallest) / smallest of a row. The average of the pool needs no training."
    )
    intra = max(_difference(results, test).mean for test in PANOPTIC)
    inter = _difference(results, "h36m").mean
    claims = [
        Claim(
            "intra-dataset: performance on Panoptic within 5 %, whatever the training set",
            "4.1",
            intra < 5,
            f"largest difference {intra:.1f} % (4.4 %)",
        ),
        Claim(
            "inter-dataset, to Human3.6M: at most 15.1 % apart",
            "4.1",
            inter <= 15.15,
            f"{inter:.1f} % (15.1 %)",
        ),
    ]
    averages = [results.relative(f"{test} on {test}", "average").mean for test in PANOPTIC]
    weights = [results.relative(f"{a} on {b}").mean for a, b in product(ARRANGEMENTS, PANOPTIC)]
    explained = (
        f"The pools differ: where the paper's plain average has 25.9 mm on Panoptic, the synthetic one has "
        f"{min(averages):.1f} to {max(averages):.1f}, nearly all of it a difference in the definition of the joints "
        f"that no selection can remove; our learned numbers are {min(weights):.1f} to {max(weights):.1f} mm."
    )
    data = f"{four(results)} and {results.display_name('h36m')}"
    return Section(data, f"{text}\n\n{markdown(header, rows)}", {}, compared, claims, explained)


def four(results: Results) -> str:
    """Panoptic's arrangements in words."""
    return results.display_name("cmu1").replace(" CMU1", " CMU1 to CMU4")


def _difference(results: Results, test: str) -> Spread:
    return over_seeds(
        lambda *row: max_difference(row),
        *(results.relative(f"{a} on {test}") for a in ARRANGEMENTS),
    )


ARTEFACTS = (
    Artefact(
        "generalization-evaluation",
        "table",
        "Generalisation between camera arrangements",
        grid,
        _generalization,
    ),
)
