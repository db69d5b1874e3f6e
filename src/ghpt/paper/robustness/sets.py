"""Every estimator on the five arrangements, trajectories beside those of single frames."""

from __future__ import annotations

from collections.abc import Mapping

from ghpt.paper.engine.artefact import Artefact, Claim, Results, Section, format_signed
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.pose.generalization import panoptic_name
from ghpt.paper.published import ARRANGEMENTS
from ghpt.paper.robustness.actions import OURS
from ghpt.paper.robustness.curve import CLEAN, CurveResult, curve_task, read_task
from ghpt.paper.robustness.figure import LABELS
from ghpt.report.document import Paragraph, Strong, Table, Text, prose

_DIGITS = 2
"""With fewer, the rows on Panoptic can hardly be told apart."""


def _tasks(setup: Setup) -> dict[str, Task]:
    """Return the measurements of the five arrangements as they are, by the arrangements' names.

    That of Human3.6M is the one of the robustness curves.
    """
    tasks = {}
    for data in ARRANGEMENTS:
        name = CLEAN if data == "h36m" else f"{CLEAN}-{data}"
        tasks[data] = curve_task(setup, name, data, [None])
    return tasks


def _section(results: Results) -> Section:
    found = {data: read_task(results, data) for data in ARRANGEMENTS}
    names = [name for name in found["h36m"].errors["relative"] if name != "best"]
    least = {data: min(one.mean(name, 0) for name in names) for data, one in found.items()}
    rows: list[list[Text]] = []
    for name in names:
        cells: list[Text] = []
        for data, one in found.items():
            error = one.errors["relative"][name][0].text(_DIGITS)
            cells.append(Strong(error) if one.mean(name, 0) == least[data] else error)
        rows.append([LABELS.get(name, name), *cells])
    frames = sum(one.frames for one in found.values())
    training = results.display_name(results.setup.sizes.robustness.trained_on)
    text = prose(
        "Not in the paper: pelvis-relative MPJPE in mm of every estimator on the same frames, "
        f"{frames} in all. The trajectory is that of the run of successive frames around each of "
        "them (`sizes.robustness.sequences`); it and the learned frames have seen none of the "
        f"five arrangements. The paper's selection is trained on {training}."
    )
    return Section(
        f"{panoptic_name(results)} and {results.display_name('h36m')}",
        [Paragraph(text), Table(["mm", *(data.upper() for data in ARRANGEMENTS)], rows)],
        claims=[_claim(found, name) for name in OURS if name in names],
    )


def _claim(found: Mapping[str, CurveResult], name: str) -> Claim:
    leads = {data: one.lead(name, 0) for data, one in found.items()}
    evidence = [f"{data.upper()} {format_signed(100 * lead)} %" for data, lead in leads.items()]
    return Claim(
        f"{LABELS[name]} are ahead of every classical estimator of single frames on all five",
        "not in the paper",
        min(leads.values()) > 0,
        ", ".join(evidence),
    )


ARTEFACTS = (
    Artefact(
        "five-arrangements",
        "table",
        "Every estimator on the five arrangements",
        _tasks,
        _section,
        of_paper=False,
    ),
)
