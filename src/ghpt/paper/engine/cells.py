"""A cell: one piece of work, kept in a folder that is named by everything that decides its result."""

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
from ghpt.paper.engine.code import code_digest
from ghpt.provenance import provenance


@dataclass(frozen=True)
class Cell:
    """``work`` is the full name of a function ``(config, needs, folder)`` that writes its result
    into ``folder``; ``needs`` gives it the folders of the cells that came before.

    Two cells with the same work, config, needs and code are one: whichever item of the report asks,
    it is computed once. ``name`` is for people.
    """

    name: str
    work: str
    config: Mapping[str, Any]
    """Plain data that decides the result, and nothing else."""
    needs: Mapping[str, Cell] = field(default_factory=dict)
    command: str = ""
    """What one would type to do the same by hand, where there is such a command."""
    seconds: float = 10.0
    """About how long it takes, for the progress bar and the order of work."""

    @cached_property
    def key(self) -> str:
        content = {
            "work": self.work,
            "config": self.config,
            "needs": {name: cell.key for name, cell in self.needs.items()},
            "code": code_digest(self.work.rpartition(".")[0]),
        }
        return hashlib.sha256(
            json.dumps(content, sort_keys=True, allow_nan=False).encode()
        ).hexdigest()[:16]

    def folder(self, cells: Path) -> Path:
        return cells / f"{self.name}-{self.key}"

    def done(self, cells: Path) -> bool:
        return self.folder(cells).is_dir()


def perform(cell: Cell, cells: Path) -> None:
    """Do the work of a cell whose needs are done. The folder appears when all is done."""
    start = time.perf_counter()
    if not cell.done(cells):
        module, _, function = cell.work.rpartition(".")
        needs = {name: before.folder(cells) for name, before in cell.needs.items()}
        with atomic_folder(cell.folder(cells)) as folder:
            getattr(importlib.import_module(module), function)(dict(cell.config), needs, folder)
            about = {
                "name": cell.name,
                "work": cell.work,
                "config": cell.config,
                "command": cell.command,
                "needs": {name: before.folder(cells).name for name, before in cell.needs.items()},
                "seconds": round(time.perf_counter() - start, 2),
                "provenance": provenance(cell.config.get("seed", 0)),
            }
            write_json(folder / "cell.json", about)


def with_needs(cells: Iterable[Cell]) -> dict[str, Cell]:
    """The cells and all that they need, by key, in an order in which they can be done."""
    found: dict[str, Cell] = {}

    def visit(cell: Cell) -> None:
        for before in cell.needs.values():
            visit(before)
        found.setdefault(cell.key, cell)

    for cell in cells:
        visit(cell)
    return found


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
