"""tab:unknown-extrinsics-evaluation: poses from estimated cameras (appendix A)."""

from __future__ import annotations

from ghpt.paper.camera.extrinsics import KINDS, PARTS
from ghpt.paper.camera.tasks import camera_model, common_settings
from ghpt.paper.engine.artefact import (
    Artefact,
    Claim,
    Comparison,
    Results,
    Section,
    Spread,
    comparison_rows,
    format_signed,
    over_seeds,
)
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.published import UNKNOWN_EXTRINSICS
from ghpt.report.document import Heading, Paragraph, Table
from ghpt.report.tables import NONE

SOURCES = {"weight": "pairs, learned", "poselib": "pairs, PoseLib", "rig": "whole rig"}
MODELS = {"h36m": "base dataset", "cmu3": "CMU3 → H36M"}
COLUMNS = {
    "known": "known R and t",
    "R": "estimated R",
    "t": "estimated t",
    "both": "estimated R and t",
}
GOAL = 0.05
"""What estimated cameras may cost: the goal of this project."""
ESTIMATION = "ghpt.paper.camera.extrinsics.estimate_extrinsics"
POSES = "ghpt.paper.camera.extrinsics.poses_from_extrinsics"


def _tasks(setup: Setup) -> dict[str, Task]:
    stride = f"data.stride={setup.sizes.unknown_extrinsics.stride}"
    whole = setup.configuration("test", "h36m", *setup.overrides.test, stride)
    config = common_settings(whole)
    data = setup.preparation("h36m", whole["data"]["evaluate"])
    baselines = whole["camera_baselines"]
    estimators = {"poselib": baselines["poselib"], "rig": baselines["rig"]["calibration"]}
    extrinsics = {"weight": _learned_extrinsics(setup, config, data)}
    for source, estimator in estimators.items():
        extrinsics[source] = _classical_extrinsics(setup, config, data, source, estimator)
    tasks = {}
    for trained in MODELS:
        dependencies = {"model": setup.training(trained), "data": data}
        name = f"{trained}-seed{setup.seed}"
        tasks[trained] = Task(f"poses-known-{name}", POSES, config, dependencies, seconds=7.0)
        for source, estimated in extrinsics.items():
            parts = list(PARTS) if source == "weight" else ["both"]
            tasks[f"{trained} {source}"] = Task(
                f"poses-{source}-{name}",
                POSES,
                config | {"parts": parts},
                dependencies | {"extrinsics": estimated},
                seconds=7.0 * len(parts),
            )
    return tasks


def _learned_extrinsics(setup: Setup, config: dict[str, object], data: Task) -> Task:
    size = setup.sizes.unknown_extrinsics
    return Task(
        f"extrinsics-weight-seed{setup.seed}",
        ESTIMATION,
        {**config, "frames": size.frames, "draws": size.draws, "source": "weight"},
        {"data": data, "model": camera_model(setup)},
        seconds=12.0,
    )


def _classical_extrinsics(
    setup: Setup, config: dict[str, object], data: Task, source: str, estimator: object
) -> Task:
    size = setup.sizes.unknown_extrinsics
    scale = camera_model(setup).config["model"]["problem"]["scale"]
    own = {
        "frames": size.frames,
        "draws": size.draws,
        "source": source,
        "estimator": estimator,
        "scale": scale,
    }
    name = f"extrinsics-{source}-seed{setup.seed}"
    return Task(name, ESTIMATION, {**config, **own}, {"data": data}, seconds=12.0)


def _section(results: Results) -> Section:
    size = results.setup.sizes.unknown_extrinsics
    rows = []
    comparisons = []
    for trained, name in MODELS.items():
        of_model = _compare(results, trained)
        rows += comparison_rows(f"{name}, ", of_model)
        comparisons += of_model
    text = (
        "Pelvis-relative MPJPE of the weighted hypothesis in mm. Camera 1 is the true one, the "
        f"others come from {size.frames} frames of each rig, in {size.draws} draws that take turns "
        "over the poses. As in the paper, each comes from its pair with camera 1, by the learned "
        "selection, and its distance is the true one."
    )
    estimation = (
        "MPJPE in mm, in brackets the increase over known cameras. The whole rig is calibrated "
        "from all views together; its one scale is the median ratio of true to estimated distances."
    )
    return Section(
        _data_name(results),
        [
            Paragraph(text),
            Table(["mm", *COLUMNS.values()], rows),
            Heading("How the cameras were estimated", 3),
            Paragraph(estimation),
            _increases_table(results),
        ],
        comparisons=comparisons,
        claims=_claims(results),
        explanation=_explanation(results),
    )


def _compare(results: Results, trained: str) -> list[Comparison]:
    comparisons = []
    for part, head in COLUMNS.items():
        label = f"{MODELS[trained]}, {head}"
        ours = _error(results, trained, "weight", part)
        comparisons.append(Comparison(label, UNKNOWN_EXTRINSICS[trained][part], ours))
    return comparisons


def _data_name(results: Results) -> str:
    """Return the name of the test data, and of CMU3 where only one of the two is real."""
    tested = results.display_name("h36m")
    trained = results.display_name("cmu3")
    if trained.startswith("synthetic") == tested.startswith("synthetic"):
        return tested
    return f"{tested}, CMU3 model trained on {trained}"


def _error(
    results: Results, trained: str, source: str, part: str, kind: str = "relative"
) -> Spread:
    """Return the MPJPE (mm) of a model with some part of the cameras estimated."""
    task = trained if part == "known" else f"{trained} {source}"
    return results.spread(task, part, kind, file="result.json")


def _increase(
    results: Results, trained: str, source: str, part: str, kind: str = "relative"
) -> Spread:
    """Return by how many percent the error is above that with known cameras."""
    estimated = _error(results, trained, source, part, kind)
    known = _error(results, trained, source, "known", kind)
    return over_seeds(lambda one, other: 100 * (one / other - 1), estimated, known)


def _paper_increase(trained: str, part: str) -> float:
    """Return the same of the paper's numbers."""
    paper = UNKNOWN_EXTRINSICS[trained]
    return 100 * (paper[part] / paper["known"] - 1)


def _increases_table(results: Results) -> Table:
    rows = []
    for trained, name in MODELS.items():
        paper = UNKNOWN_EXTRINSICS[trained]
        increase = format_signed(_paper_increase(trained, "both"))
        both = f"{paper['both']} ({increase} %)"
        rows.append([f"{name}, the paper's pairs", str(paper["known"]), both, NONE, NONE])
        for source, how in SOURCES.items():
            cells = _increase_cells(results, trained, source)
            rows.append([f"{name}, {how}", *cells])
    header = [f"{kind}, {COLUMNS[part]}" for kind in KINDS for part in ("known", "both")]
    return Table(["cameras", *header], rows)


def _increase_cells(results: Results, trained: str, source: str) -> list[str]:
    cells = []
    for kind in KINDS:
        known = _error(results, trained, source, "known", kind).text()
        both = _error(results, trained, source, "both", kind).text()
        increase = format_signed(_increase(results, trained, source, "both", kind).mean)
        cells += [known, f"{both} ({increase} %)"]
    return cells


def _claims(results: Results) -> list[Claim]:
    return [
        _translation_claim(results),
        _base_claim(results),
        *(_goal_claim(results, trained) for trained in MODELS),
    ]


def _translation_claim(results: Results) -> Claim:
    holds = True
    increases = []
    for trained, name in MODELS.items():
        translation = _increase(results, trained, "weight", "t").mean
        rotation = _increase(results, trained, "weight", "R").mean
        holds = holds and translation > rotation
        paper_translation = _paper_increase(trained, "t")
        paper_rotation = _paper_increase(trained, "R")
        increases.append(
            f"{name}: t {translation:+.1f} % ({paper_translation:+.1f} %), "
            f"R {rotation:+.1f} % ({paper_rotation:+.1f} %)"
        )
    reason = "" if holds else "; R and t of a pair err together, see fundamental-dissection"
    return Claim(
        "unknown translations cost more than unknown rotations",
        "appendix A",
        holds,
        f"{'; '.join(increases)}{reason}",
    )


def _base_claim(results: Results) -> Claim:
    holds = True
    orders = []
    for part in COLUMNS:
        base = _error(results, "h36m", "weight", part).mean
        inter = _error(results, "cmu3", "weight", part).mean
        holds = holds and base < inter
        sign = "<" if base < inter else "≥"
        orders.append(f"{base:.1f} {sign} {inter:.1f}")
    statement = "the base dataset is better than inter-dataset"
    return Claim(statement, "appendix A", holds, f"{', '.join(orders)} mm")


def _goal_claim(results: Results, trained: str) -> Claim:
    increase = _increase(results, trained, "weight", "both").mean
    rig = format_signed(_increase(results, trained, "rig", "both").mean)
    paper = _paper_increase(trained, "both")
    goal = 100 * GOAL
    return Claim(
        f"estimated R and t cost at most {goal:.0f} % on {MODELS[trained]} (the goal of ghpt)",
        "appendix A",
        increase <= goal,
        f"pairs {increase:+.1f} % ({paper:+.0f} %), rig {rig} %",
    )


def _explanation(results: Results) -> str:
    increases = [_increase(results, trained, "rig", "both").mean for trained in MODELS]
    rig = " and ".join(f"{format_signed(increase)} %" for increase in increases)
    return (
        "Errors of an estimated rotation and translation make up for one another; with one of them "
        "from the truth they cannot (tab:fundamental-dissection). All views calibrated together "
        f"cost {rig} instead."
    )


UNKNOWN = Artefact(
    "unknown-extrinsics-evaluation", "table", "Poses from estimated cameras", _tasks, _section
)
