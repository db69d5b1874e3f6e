"""Every table and figure of the paper again: the tasks that are missing, then the report from all
of them.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypedDict

import yaml

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.jobs import Job
from ghpt.commands.outputs import Files
from ghpt.commands.train import display_path
from ghpt.config import check_type, suggest
from ghpt.errors import GhptConfigError, check
from ghpt.paper.ablations import tables as ablations
from ghpt.paper.camera import tables as camera_tables
from ghpt.paper.engine.artefact import Artefact, Results
from ghpt.paper.engine.page import Entry, Page, write_page
from ghpt.paper.engine.pool import perform_all
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.pose import base_dataset, generalization, other_systems, view_weights
from ghpt.paper.pose import figures as pose_figures
from ghpt.paper.robustness import curves as robustness
from ghpt.provenance import provenance
from ghpt.report.escape import code
from ghpt.report.tables import display_name

_PARTS = (
    generalization,
    other_systems,
    base_dataset,
    pose_figures,
    camera_tables,
    view_weights,
    ablations,
    robustness,
)
ARTEFACTS: dict[str, Artefact] = {
    artefact.label: artefact for part in _PARTS for artefact in part.ARTEFACTS
}
"""Every artefact by its label, in the report's order."""
MOST_JOBS = 8
_log = logging.getLogger(__name__)


class Data(TypedDict):
    """Where the real data sets are; see conf/reproduce.yaml."""

    root: str | None
    human36m: str | None
    panoptic: str | None


class Overrides(TypedDict):
    """Of every training and of every test, in the words of their command lines."""

    train: list[str]
    test: list[str]


class Settings(TypedDict):
    """What `reproduce` needs of the configuration."""

    only: list[str] | str | None
    seed: int
    seeds: int
    jobs: int | None
    overrides: Overrides
    data: Data
    sizes: dict[str, Any]
    tasks: str
    progress_bar: bool


def files(config: dict[str, Any]) -> Files:
    """What `reproduce` reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    roots = [Path(root).expanduser() for root in config["data"].values() if root]
    return Files(tuple(roots), ("report.md", "report.html", "report.json"))


def reproduce(config: dict[str, Any], output: Path, conf: Path) -> dict[str, Any]:
    """Compute what is missing of the artefacts that are asked for, and write their report into
    ``output``.

    ``conf`` is the folder of train.yaml and test.yaml. Returns what the report says of itself.
    Raises GhptConfigError for a label that there is not, and whatever a task raises, with its name;
    what was finished by then is kept.
    """
    check_type(config, Settings, "")
    check(config["seeds"] >= 1, "seeds", f"is {config['seeds']}", "It must be >= 1.")
    check(
        config["jobs"] is None or config["jobs"] >= 1,
        "jobs",
        f"is {config['jobs']}",
        "It must be >= 1, or null.",
    )
    return _reproduce(config, seeds_of(config), output, conf)


def gather(jobs: Sequence[Job[dict[str, Any], dict[str, Any]]], conf: Path) -> None:
    """After a sweep over seeds or artefacts: one report of them all in the sweep's folder, from the
    tasks that they kept.

    Where the jobs differ in anything else there is nothing to gather, and each has its own report.
    """
    configs = [job.settings for job in jobs if not job.failed and job.settings is not None]
    if not configs or any(_but_shares(config) != _but_shares(configs[0]) for config in configs):
        return
    seeds = sorted({seed for config in configs for seed in seeds_of(config)})
    everything = any(config["only"] is None for config in configs)
    only = (
        None
        if everything
        else [artefact.label for config in configs for artefact in chosen(config["only"])]
    )
    with_all = {"only": only, "seed": seeds[0], "seeds": len(seeds)}
    _reproduce(configs[0] | with_all, seeds, Path(configs[0]["output"]), conf)


def seeds_of(config: dict[str, Any]) -> list[int]:
    return list(range(config["seed"], config["seed"] + config["seeds"]))


def _but_shares(config: dict[str, Any]) -> dict[str, Any]:
    """What the jobs of a sweep that belong together have in common."""
    return {key: value for key, value in config.items() if key not in ("only", "seed", "seeds")}


def _reproduce(
    config: dict[str, Any], seeds: Sequence[int], output: Path, conf: Path
) -> dict[str, Any]:
    start = time.perf_counter()
    artefacts = chosen(config["only"])
    setups = [
        Setup(conf, _roots(config["data"]), config["overrides"], config["sizes"], seed)
        for seed in seeds
    ]
    tasks = {artefact.label: [artefact.tasks(setup) for setup in setups] for artefact in artefacts}
    wanted = [
        task for of_item in tasks.values() for of_seed in of_item for task in of_seed.values()
    ]
    folder = Path(config["tasks"])
    jobs = config["jobs"] or min(processors(), MOST_JOBS)
    try:
        done = perform_all(wanted, folder, jobs, config["progress_bar"])
    except (KeyboardInterrupt, SystemExit):
        _log.warning(
            "Stopped. What was finished is in %s; the same command goes on.", display_path(folder)
        )
        raise
    entries = [
        Entry(
            artefact,
            artefact.section(Results(setups, tasks[artefact.label], folder)),
            _commands(tasks[artefact.label][0]),
        )
        for artefact in artefacts
    ]
    page = Page(
        entries, _about(config, setups, done, start), yaml.safe_dump(config, sort_keys=False)
    )
    write_page(page, output)
    held = sum(claim.holds for claim in page.claims)
    misses = sum(len(entry.misses) for entry in entries)
    numbers = sum(len(entry.section.comparisons) for entry in entries)
    _log.info(
        "%d of %d claims hold, %d of %d numbers miss the paper's.",
        held,
        len(page.claims),
        misses,
        numbers,
    )
    _log.info("Report: %s, and report.html", display_path(output / "report.md"))
    return {"claims": len(page.claims), "held": held, "numbers": numbers, "misses": misses}


def summary(told: dict[str, Any]) -> str:
    """What `reproduce` returned, in words."""
    return f"{told['held']} of {told['claims']} claims hold, {told['misses']} of {told['numbers']} numbers miss"


def chosen(only: Sequence[str] | str | None) -> list[Artefact]:
    """The artefacts of these labels, with or without ``tab:`` or ``fig:``, or kinds, in the report's
    order; None: all.
    """
    if only is None:
        return list(ARTEFACTS.values())
    wanted = [
        word.removeprefix("tab:").removeprefix("fig:")
        for word in ([only] if isinstance(only, str) else only)
    ]
    existing = {*ARTEFACTS, *(artefact.kind for artefact in ARTEFACTS.values())}
    for word in wanted:
        if word not in existing:
            raise GhptConfigError("only", f"there is no {word!r}", suggest(word, existing))
    return [
        artefact for artefact in ARTEFACTS.values() if {artefact.label, artefact.kind} & set(wanted)
    ]


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _roots(data: Data) -> dict[str, str | None]:
    """Each data set's folder. Raises GhptConfigError where ``data.root`` does not hold it."""
    roots = {}
    for name in ("human36m", "panoptic"):
        below = None if data["root"] is None else str(Path(data["root"]).expanduser() / name)
        roots[name] = data[name] or below
        if data[name] is None and below is not None and not Path(below).is_dir():
            hint = f"Put the data set there, or name its folder alone: data.{name}=/path (the other stays synthetic)."
            raise GhptConfigError("data.root", f"{data['root']} has no folder {name}", hint)
    return roots


def _commands(tasks: dict[str, Task]) -> list[str]:
    """What makes these tasks by hand: trainings, then tests."""
    found: dict[str, None] = {}
    for task in tasks.values():
        for before in (*task.dependencies.values(), task):
            if before.command:
                found[before.command] = None
    return sorted(found, key=lambda command: "train.py" not in command)


def _about(
    config: dict[str, Any], setups: Sequence[Setup], done: int, start: float
) -> dict[str, Any]:
    origin = provenance(config["seed"])
    minutes = (time.perf_counter() - start) / 60
    seeds = [setup.seed for setup in setups]
    return {
        "data": ", ".join(
            display_name(data, setups[0].source(data)) for data in ("h36m", "panoptic")
        ),
        "seeds": f"{len(seeds)} ({', '.join(map(str, seeds))}), of training and hypotheses; the data are the same",
        "made by": f"ghpt {origin['ghpt']}, commit {origin['commit'] or 'unknown'}, torch {origin['torch']}, "
        f"numpy {origin['numpy']}, Python {origin['python']}",
        "command": code(origin["command"]),
        "run time": f"{minutes:.1f} minutes on {processors()} processors, for {done} tasks that were not there before",
    }


def command(conf: Path) -> Command:
    """The command, of the configurations in the folder ``conf``."""
    task = partial(reproduce, conf=conf)
    after = partial(gather, conf=conf)
    return Command(
        name="reproduce", settings=dict, task=task, summary=summary, files=files, after=after
    )


if __name__ == "__main__":
    run_by_name("reproduce")
