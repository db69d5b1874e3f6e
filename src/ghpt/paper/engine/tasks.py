"""A task: one action with its settings, kept in a folder that is named by everything that decides its result."""

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
    """``action`` is the full name of a function ``(config, dependencies, folder)`` that writes its result
    into ``folder``; ``dependencies`` gives it the folders of the tasks that came before.

    Two tasks with the same action, config, dependencies and code are one: whichever artefact of the report asks,
    it is computed once. ``name`` is for people.
    """

    name: str
    action: str
    config: Mapping[str, Any]
    """Plain data that decides the result, and nothing else."""
    dependencies: Mapping[str, Task] = field(default_factory=dict)
    command: str = ""
    """What one would type to do the same by hand, where there is such a command."""
    seconds: float = 10.0
    """About how long it takes, for the progress bar and the order of action."""

    @cached_property
    def key(self) -> str:
        content = {
            "action": self.action,
            "config": self.config,
            "dependencies": {name: task.key for name, task in self.dependencies.items()},
            "code": code_digest(frozenset({self.action, *target_names(self.config)})),
        }
        return hashlib.sha256(
            json.dumps(content, sort_keys=True, allow_nan=False).encode()
        ).hexdigest()[:16]

    def folder(self, tasks: Path) -> Path:
        return tasks / f"{self.name}-{self.key}"

    def done(self, tasks: Path) -> bool:
        return self.folder(tasks).is_dir()


def perform(task: Task, tasks: Path) -> None:
    """Run the action of a task whose dependencies are done. The folder appears when all is done."""
    start = time.perf_counter()
    if not task.done(tasks):
        module, _, function = task.action.rpartition(".")
        dependencies = {name: before.folder(tasks) for name, before in task.dependencies.items()}
        with atomic_folder(task.folder(tasks)) as folder:
            getattr(importlib.import_module(module), function)(
                dict(task.config), dependencies, folder
            )
            about = {
                "name": task.name,
                "action": task.action,
                "config": task.config,
                "command": task.command,
                "dependencies": {
                    name: before.folder(tasks).name for name, before in task.dependencies.items()
                },
                "seconds": round(time.perf_counter() - start, 2),
                "provenance": provenance(task.config.get("seed", 0)),
            }
            write_json(folder / "task.json", about)


def with_dependencies(tasks: Iterable[Task]) -> dict[str, Task]:
    """The tasks and all that they need, by key, in an order in which they can be done."""
    found: dict[str, Task] = {}

    def visit(task: Task) -> None:
        for before in task.dependencies.values():
            visit(before)
        found.setdefault(task.key, task)

    for task in tasks:
        visit(task)
    return found


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
