"""A task: an action with its settings, in a folder named by everything that decides its result."""

from __future__ import annotations

import hashlib
import importlib
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ghpt.files import atomic_folder, write_json
from ghpt.paper.engine.code import code_digest, target_names
from ghpt.provenance import provenance


@dataclass(frozen=True)
class Task:
    """An action on settings and on the results of other tasks.

    ``action`` is the full name of a function ``(config, dependencies, folder)``. It writes its
    result into ``folder``; ``dependencies`` gives it the folders of the tasks that came before.

    Two tasks with the same action, config, dependencies and code are one: whichever artefact asks
    for it, it is run once. ``name`` is for people.
    """

    name: str
    action: str
    config: Mapping[str, Any]
    """Plain data that decides the result, and nothing else."""
    dependencies: Mapping[str, Task] = field(default_factory=dict)
    command: str = ""
    """What one would type to do the same by hand, where there is such a command."""
    seconds: float = 10.0
    """About how long it takes, for the progress bar and the order of tasks."""

    @cached_property
    def key(self) -> str:
        """A digest of everything that decides the result."""
        names = frozenset({self.action, *target_names(self.config)})
        content = {
            "action": self.action,
            "config": self.config,
            "dependencies": {name: task.key for name, task in self.dependencies.items()},
            "code": code_digest(names),
        }
        text = json.dumps(content, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def folder(self, tasks: Path) -> Path:
        """Return the task's folder within the folder of all tasks."""
        return tasks / f"{self.name}-{self.key}"

    def done(self, tasks: Path) -> bool:
        """Return whether the task's result is there."""
        return self.folder(tasks).is_dir()


def perform(task: Task, tasks: Path) -> None:
    """Run the action of a task whose dependencies are done. The folder appears when all is done."""
    if task.done(tasks):
        return
    start = time.perf_counter()
    module, _, function = task.action.rpartition(".")
    folders = {name: before.folder(tasks) for name, before in task.dependencies.items()}
    with atomic_folder(task.folder(tasks)) as folder:
        action = getattr(importlib.import_module(module), function)
        action(dict(task.config), folders, folder)
        about = {
            "name": task.name,
            "action": task.action,
            "config": task.config,
            "command": task.command,
            "dependencies": {name: path.name for name, path in folders.items()},
            "seconds": round(time.perf_counter() - start, 2),
            "provenance": provenance(task.config.get("seed", 0)),
        }
        write_json(folder / "task.json", about)


def with_dependencies(tasks: Iterable[Task]) -> dict[str, Task]:
    """Return the tasks and all that they depend on, by key, in an order that works."""
    found: dict[str, Task] = {}

    def visit(task: Task) -> None:
        for before in task.dependencies.values():
            visit(before)
        found.setdefault(task.key, task)

    for task in tasks:
        visit(task)
    return found


def read_json(path: Path) -> Any:
    """Return the content of a JSON file that a task wrote."""
    return json.loads(path.read_text(encoding="utf-8"))
