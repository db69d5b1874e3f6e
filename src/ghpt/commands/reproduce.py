"""Every table and figure of the paper again: the tasks that are missing, then a report of all."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import yaml

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.jobs import Job
from ghpt.commands.outputs import Files, OutputSettings
from ghpt.config import suggest
from ghpt.errors import GhptConfigError, check
from ghpt.extras import check_installed
from ghpt.paper.ablations import tables as ablations
from ghpt.paper.camera import tables as camera_tables
from ghpt.paper.engine.artefact import Artefact, Results
from ghpt.paper.engine.page import Counts, Entry, Page, write_page
from ghpt.paper.engine.pool import perform_all
from ghpt.paper.engine.settings import DataFolders, Overrides, Sizes
from ghpt.paper.engine.setup import Setup
from ghpt.paper.engine.tasks import Task
from ghpt.paper.pose import base_dataset, generalization, other_systems
from ghpt.paper.pose import figures as pose_figures
from ghpt.paper.robustness import curves as robustness
from ghpt.paper.robustness import sets
from ghpt.provenance import provenance
from ghpt.report.document import Code, Text
from ghpt.report.tables import display_name

_PARTS = (
    generalization,
    other_systems,
    base_dataset,
    pose_figures,
    camera_tables,
    sets,
    ablations,
    robustness,
)
ARTEFACTS: dict[str, Artefact] = {
    artefact.label: artefact for part in _PARTS for artefact in part.ARTEFACTS
}
"""Every artefact by its label, in the report's order."""
MOST_JOBS = 8
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings(OutputSettings):
    """conf/reproduce.yaml."""

    only: tuple[str, ...] | str | None
    """Labels or kinds of artefacts, None: all."""
    seed: int
    """The first seed."""
    seeds: int
    """How many; means and deviations are over them."""
    jobs: int | None
    """Processes at once; None: as many as there are processors, at most ``MOST_JOBS``."""
    overrides: Overrides
    data: DataFolders
    sizes: Sizes
    tasks: str
    """The folder of finished tasks."""
    progress_bar: bool

    def __post_init__(self) -> None:
        check(self.seeds >= 1, "seeds", f"is {self.seeds}", "It must be >= 1.")
        enough = self.jobs is None or self.jobs >= 1
        check(enough, "jobs", f"is {self.jobs}", "It must be >= 1, or null.")

    @property
    def all_seeds(self) -> tuple[int, ...]:
        return tuple(range(self.seed, self.seed + self.seeds))


def files(settings: ReproduceSettings) -> Files:
    """Return what `reproduce` reads and writes."""
    folders = (settings.data.root, settings.data.human36m, settings.data.panoptic)
    roots = tuple(Path(folder).expanduser() for folder in folders if folder)
    return Files(roots, ("report.md", "report.html", "report.json"))


def reproduce(settings: ReproduceSettings, output: Path, conf: Path) -> Counts:
    """Run what is missing of the artefacts asked for, and write their report into ``output``.

    ``conf`` is the folder of train.yaml and test.yaml. Raises GhptConfigError for a label that
    there is not, and whatever a task raises, with its name; what was finished by then is kept.
    """
    return _reproduce(settings, settings.all_seeds, output, conf)


def gather(jobs: Sequence[Job[ReproduceSettings, Counts]], conf: Path) -> None:
    """After a sweep over seeds or artefacts, write one report of all into the sweep's folder.

    It is made from the tasks that the jobs kept. Where the jobs differ in anything else there is
    nothing to gather, and each has its own report.
    """
    finished = [job.settings for job in jobs if not job.failed and job.settings is not None]
    shared = [_without_share(settings) for settings in finished]
    if not shared or any(settings != shared[0] for settings in shared):
        return
    seeds = sorted({seed for settings in finished for seed in settings.all_seeds})
    only: tuple[str, ...] | None = None
    if all(settings.only is not None for settings in finished):
        chosen = [artefact for settings in finished for artefact in choose(settings.only)]
        only = tuple(artefact.label for artefact in chosen)
    gathered = replace(finished[0], only=only, seed=seeds[0], seeds=len(seeds))
    _reproduce(gathered, seeds, Path(gathered.output), conf)


def _without_share(settings: ReproduceSettings) -> ReproduceSettings:
    """Return what the jobs of a sweep that belong together have in common."""
    return replace(settings, only=None, seed=0, seeds=1)


def _reproduce(
    settings: ReproduceSettings, seeds: Sequence[int], output: Path, conf: Path
) -> Counts:
    start = time.perf_counter()
    artefacts = choose(settings.only)
    for package in ("pycolmap", "cv2"):  # before the work, not after hours of it
        check_installed(package, "reproduce")
    roots = _roots(settings.data)
    setups = [Setup(conf, roots, settings.overrides, settings.sizes, seed) for seed in seeds]
    tasks = {artefact.label: [artefact.tasks(setup) for setup in setups] for artefact in artefacts}
    done = _perform(settings, tasks.values())
    folder = Path(settings.tasks)
    entries = []
    for artefact in artefacts:
        own = tasks[artefact.label]
        section = artefact.section(Results(setups, own, folder))
        entries.append(Entry(artefact, section, _commands(own[0])))
    minutes = (time.perf_counter() - start) / 60
    about = _about(setups, done, minutes)
    config = yaml.safe_dump(asdict(settings), sort_keys=False)
    page = Page(entries, about, config)
    write_page(page, output)
    counts = page.counts
    _log.info("%s the paper's.", summary(counts))
    _log.info("Report: %s, and report.html", display_path(output / "report.md"))
    return counts


def _perform(settings: ReproduceSettings, tasks: Iterable[Sequence[Mapping[str, Task]]]) -> int:
    """Run the tasks that are missing. Returns how many that were."""
    wanted = [task for of_artefact in tasks for of_seed in of_artefact for task in of_seed.values()]
    jobs = settings.jobs or min(processors(), MOST_JOBS)
    folder = Path(settings.tasks)
    try:
        return perform_all(wanted, folder, jobs, settings.progress_bar)
    except (KeyboardInterrupt, SystemExit):
        message = "Stopped. What was finished is in %s; the same command goes on."
        _log.warning(message, display_path(folder))
        raise


def summary(counts: Counts) -> str:
    """Return in words what `reproduce` returned."""
    return (
        f"{counts.claims_held} of {counts.claims} claims hold, "
        f"{counts.misses} of {counts.numbers} numbers miss"
    )


def choose(only: Sequence[str] | str | None) -> list[Artefact]:
    """Return the artefacts of some labels or kinds in the report's order; None: all.

    A label may have ``tab:`` or ``fig:`` before it. Raises GhptConfigError for one that there is
    not.
    """
    if only is None:
        return list(ARTEFACTS.values())
    words = [only] if isinstance(only, str) else only
    wanted = {word.removeprefix("tab:").removeprefix("fig:") for word in words}
    existing = {*ARTEFACTS, *(artefact.kind for artefact in ARTEFACTS.values())}
    for word in sorted(wanted - existing):
        raise GhptConfigError("only", f"there is no {word!r}", suggest(word, existing))
    return [artefact for artefact in ARTEFACTS.values() if {artefact.label, artefact.kind} & wanted]


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _roots(data: DataFolders) -> dict[str, str | None]:
    """Return each data set's folder. Raises GhptConfigError where ``data.root`` lacks it."""
    return {
        "human36m": data.human36m or _below(data.root, "human36m"),
        "panoptic": data.panoptic or _below(data.root, "panoptic"),
    }


def _below(root: str | None, name: str) -> str | None:
    if root is None:
        return None
    folder = Path(root).expanduser() / name
    if not folder.is_dir():
        hint = (
            f"Put the data set there, or name its folder alone: data.{name}=/path (the other stays "
            "synthetic)."
        )
        raise GhptConfigError("data.root", f"{root} has no folder {name}", hint)
    return str(folder)


def _commands(tasks: Mapping[str, Task]) -> list[str]:
    """Return the commands that do these tasks by hand: trainings, then tests."""
    commands: dict[str, None] = {}
    for task in tasks.values():
        for one in (*task.dependencies.values(), task):
            if one.command:
                commands[one.command] = None
    return sorted(commands, key=lambda command: "train.py" not in command)


def _about(setups: Sequence[Setup], done: int, minutes: float) -> dict[str, Text]:
    """Return what the report says of its run."""
    first = setups[0]
    origin = provenance(first.seed)
    seeds = ", ".join(str(setup.seed) for setup in setups)
    data = ", ".join(display_name(name, first.source(name)) for name in ("h36m", "panoptic"))
    return {
        "data": data,
        "seeds": f"{len(setups)} ({seeds}), of training and hypotheses; the data are the same",
        "made by": f"ghpt {origin['ghpt']}, commit {origin['commit'] or 'unknown'}, "
        f"torch {origin['torch']}, numpy {origin['numpy']}, Python {origin['python']}",
        "command": Code(str(origin["command"])),
        "run time": f"{minutes:.1f} minutes on {processors()} processors, for {done} tasks that "
        "were not there before",
    }


def command(conf: Path) -> Command[ReproduceSettings, Counts]:
    """Return the command, of the configurations in the folder ``conf``."""
    return Command(
        name="reproduce",
        settings=ReproduceSettings,
        task=partial(reproduce, conf=conf),
        summary=summary,
        files=files,
        after=partial(gather, conf=conf),
    )


if __name__ == "__main__":
    run_by_name("reproduce")
