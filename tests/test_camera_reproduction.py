"""The camera problem's tables and figure: tasks on a small copy of the real layout, text on made-up
results.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import real_layout as layout
from ghpt.files import write_json
from ghpt.paper.camera.tables import ARTEFACTS, METHODS, Shape
from ghpt.paper.engine.artefact import Artefact, Results, Section
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task, perform, read_json, with_dependencies
from sections import markdown, setup

SIZES = {
    "frames_sweep": {"frames": [12, 24], "draws": 1, "all_pairs": True},
    "unknown_extrinsics": {"frames": 30, "draws": 1, "stride": 8},
}
SMALL = (
    "model.hypotheses=6",
    "model.scorer.layers=[4]",
    "data.train_samples=16",
    "trainer.max_epochs=1",
)
OF_CAMERAS = ("model.problem.draws=1", "model.problem.points=20")
BY_LABEL = {artefact.label: artefact for artefact in ARTEFACTS}
PAIRS = ("1-2", "1-3", "1-4", "2-3", "2-4", "3-4")


def synthetic(seed: int = 0) -> Setup:
    return setup(seed, **SIZES)


def sized(real: tuple[dict[str, str | None], Path], *overrides: str, **sizes: Any) -> Setup:
    return setup(0, real[0], (*SMALL, *overrides), **(SIZES | sizes))


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, str | None], Path]:
    """Human3.6M in the layout of the real one, with perfect detections; and a folder for tasks."""
    folder = tmp_path_factory.mktemp("real")
    rng = np.random.default_rng(0)
    takes = [
        (subject, "Walking-1", layout.person(rng, 40, (0, 0, 1000))) for subject in layout.SUBJECTS
    ]
    layout.write_human36m_layout(folder / "human36m", takes, chunk=40)
    return {"human36m": str(folder / "human36m"), "panoptic": None}, folder / "tasks"


def made(tasks: dict[str, Task], folder: Path) -> None:
    for task in with_dependencies(tasks.values()).values():
        perform(task, folder)


def made_up(
    setups: list[Setup], artefact: Artefact, folder: Path, contents: Any, file: str = "result.json"
) -> Section:
    """The artefact's section of tasks that hold ``contents(seed, name)``."""
    tasks = [artefact.tasks(one) for one in setups]
    for one, by_name in zip(setups, tasks, strict=True):
        for name, task in by_name.items():
            task.folder(folder).mkdir(parents=True, exist_ok=True)
            write_json(task.folder(folder) / file, contents(one.seed, name))
    return artefact.section(Results(setups, tasks, folder))


def test_sweep_of_perfect_detections_has_no_error(real):
    small = sized(real, *OF_CAMERAS)
    folder = real[1]
    artefact = BY_LABEL["comparison-to-8-point"]
    tasks = artefact.tasks(small)
    made(tasks, folder)
    result = read_json(tasks["12"].folder(folder) / "result.json")
    assert set(result) == set(PAIRS)
    assert all(
        len(values) == 2 for errors in result.values() for values in errors.values()
    )  # a draw of each rig
    assert max(result["2-3"]["eight_point"]) < 3
    section = artefact.section(Results([small], [tasks], folder))
    assert "Human3.6M from" in section.data
    assert (
        "synthetic"
        not in section.data + section.figures["comparison-to-8-point"].axes[0].get_title()
    )
    assert "of 12 cells" in markdown(section)
    assert "](figures/comparison-to-8-point.svg)" in markdown(section)


def test_sweep_of_one_pair_tests_no_other(real):
    folder = real[1]
    alone = sized(real, *OF_CAMERAS, frames_sweep={"frames": [12], "draws": 1, "all_pairs": False})
    tasks = BY_LABEL["comparison-to-8-point"].tasks(alone)
    made(tasks, folder)
    assert set(read_json(tasks["12"].folder(folder) / "result.json")) == {"2-3"}
    section = BY_LABEL["comparison-to-8-point"].section(Results([alone], [tasks], folder))
    assert "All pairs" not in markdown(section)


def test_tables_of_perfect_detections(real):
    small = sized(real, *OF_CAMERAS)
    folder = real[1]
    tasks = BY_LABEL["fundamental-evaluation"].tasks(small)
    made(tasks, folder)
    results = Results([small], [tasks], folder)
    evaluation, dissection = (
        BY_LABEL[f"fundamental-{name}"].section(results) for name in ("evaluation", "dissection")
    )
    assert (len(evaluation.comparisons), len(dissection.comparisons)) == (24, 24)
    first = evaluation.comparisons[0]
    assert (first.label, first.paper) == ("1-3 E_R", pytest.approx(17.0))
    for row in ("1-3 paper", "1-3 ours", "1-3 difference", "PoseLib", "rig (all views)"):
        assert f"| {row} " in markdown(evaluation)
    assert [claim.holds for claim in evaluation.claims[:2]] == [True, True]  # subpixel, few pixels
    narrow, wide = (_shape(markdown(evaluation), pair) for pair in ("1-3", "1-4"))
    assert narrow == pytest.approx((3.7, 43), rel=0.1)  # m, degrees
    assert wide == pytest.approx((9.5, 170), rel=0.1)
    assert "estimated t" in dissection.comparisons[-1].label


def _shape(body: str, pair: str) -> tuple[float, ...]:
    """Baseline and angle in the table."""
    row = next(line for line in body.splitlines() if line.startswith(f"| {pair} ours"))
    return tuple(float(task) for task in row.split("|")[-3:-1])


def test_estimated_extrinsics_of_perfect_detections_cost_nothing(real):
    small = sized(real)
    folder = real[1]
    tasks = BY_LABEL["unknown-extrinsics-evaluation"].tasks(small)
    tasks = {name: tasks[name] for name in ("h36m", "h36m poselib", "h36m rig")}
    made(tasks, folder)
    known = read_json(tasks["h36m"].folder(folder) / "result.json")["known"]
    for source in ("poselib", "rig"):
        estimated = read_json(tasks[f"h36m {source}"].folder(folder) / "result.json")
        assert set(estimated) == {"both"}
        assert estimated["both"] == pytest.approx(known, abs=1)
    rigs = read_json(tasks["h36m rig"].dependencies["extrinsics"].folder(folder) / "result.json")
    assert sorted(index for rig in rigs for index in rig["recordings"]) == [0, 1]
    assert np.shape(rigs[0]["draws"][0]["R"]) == (4, 3, 3)


def sweep_cells(seed: int, name: str) -> dict[str, Any]:
    """8-point: 30, 40 mm; weight: 10, 12 mm, but 50, 90 for M = 24 on the pair 2-3 with the first
    seed.
    """
    return {
        pair: {
            "weight": [50.0, 90.0] if (name, pair, seed) == ("24", "2-3", 0) else [10.0, 12.0],
            "eight_point": [30.0, 40.0],
            "ransac": [9.0, None],
            "poselib": [5.0, 5.0],
        }
        for pair in PAIRS
    }


def test_sweep_claims_count_the_numbers_of_frames(tmp_path):
    section = made_up([synthetic()], BY_LABEL["comparison-to-8-point"], tmp_path, sweep_cells)
    better, steadier = section.claims
    assert not better.holds
    assert "lower mean for 1 of 2" in better.evidence
    assert "M = 24: 70.0 ≥ 35.0" in better.evidence
    assert not steadier.holds
    assert (
        "below 8-point in 11 of 12, below RANSAC in 12 of 12, below PoseLib in 0 of 12 cells"
        in markdown(section)
    )
    assert "synthetic Human3.6M" in section.figures["comparison-to-8-point"].axes[0].get_title()
    several = made_up(
        [synthetic(1), synthetic(2)], BY_LABEL["comparison-to-8-point"], tmp_path, sweep_cells
    )
    assert [claim.holds for claim in several.claims] == [True, True]
    assert "4 draws" in markdown(several)


def metrics(e3d: dict[str, float | None], alone: tuple[float, float]) -> dict[str, Any]:
    """metrics.json of one draw with these E_3D of every method, E_2D a tenth of it."""
    parts = dict(
        zip(
            ("estimated_R", "estimated_t"),
            ({"E_2D": x / 10, "E_3D": x} for x in alone),
            strict=True,
        )
    )
    pairs = {
        pair: {"E_R": 0.001, "E_t": 5.0, "E_2D": None if x is None else x / 10, "E_3D": x} | parts
        for pair, x in e3d.items()
    }
    worse = {pair: numbers | {"E_3D": 100.0} for pair, numbers in pairs.items()}
    names = [*METHODS, "best"]
    return {
        "draws": 1,
        "selections": {
            "eight_point": {"pairs": worse},
            **{name: {"pairs": pairs} for name in names if name != "eight_point"},
        },
    }


@pytest.mark.parametrize(
    ("e3d", "alone", "evaluated", "dissected"),
    [
        ((9, 40, 8, 9, 30, 8), (4, 5), [True, True, True, True], [True]),
        ((11, 60, 8, 9, 7, 8), (5, 4), [False, False, False, True], [False]),
        ((None, 60, 8, 9, 61, 8), (5, 5), [False, False, False, False], [False]),
    ],
)
def test_claims_of_the_tables(tmp_path, monkeypatch, e3d, alone, evaluated, dissected):
    monkeypatch.setattr(
        "ghpt.paper.camera.tables._shapes", lambda results: dict.fromkeys(PAIRS, Shape(1.0, 2.0))
    )
    content = metrics(dict(zip(PAIRS, e3d, strict=True)), alone)
    sections = [
        made_up(
            [synthetic()],
            BY_LABEL[f"fundamental-{name}"],
            tmp_path,
            lambda *_: content,
            "metrics.json",
        )
        for name in ("evaluation", "dissection")
    ]
    assert [claim.holds for claim in sections[0].claims] == evaluated
    assert [claim.holds for claim in sections[1].claims] == dissected
    assert [c.label for c in sections[0].comparisons if c.ours is None] == (
        [] if e3d[0] else ["1-2 E_2D", "1-2 E_3D"]
    )


def poses(known: float, R: float, t: float, both: float) -> dict[str, dict[str, float]]:
    """What a model's tasks hold."""
    numbers = {"known": known, "R": R, "t": t, "both": both}
    return {part: {"relative": x, "absolute": 2 * x} for part, x in numbers.items()}


@pytest.mark.parametrize(
    ("base", "inter", "held"),
    [
        (poses(20.0, 20.2, 20.8, 20.9), poses(24.0, 24.1, 24.5, 26.0), [True, True, True, False]),
        (poses(20.0, 20.9, 20.8, 30.0), poses(24.0, 24.1, 24.5, 24.6), [False, False, False, True]),
    ],
)
def test_claims_on_unknown_extrinsics(tmp_path, base, inter, held):
    artefact = BY_LABEL["unknown-extrinsics-evaluation"]
    section = made_up(
        [synthetic(0), synthetic(1)],
        artefact,
        tmp_path,
        lambda _, name: base if "h36m" in name else inter,
    )
    assert [claim.holds for claim in section.claims] == held
    assert len(section.comparisons) == 8
    assert section.comparisons[3].ours.values == (base["both"]["relative"],) * 2
    share = 100 * (base["both"]["relative"] / 20 - 1)
    assert f" {base['both']['relative']:.1f} ± 0.0 (+{share:.1f} %) " in markdown(section)
