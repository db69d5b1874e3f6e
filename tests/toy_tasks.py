"""Work for tasks without models: numbers in, numbers out."""

import os
import time
from pathlib import Path
from typing import Any

from ghpt.errors import GhptDataError
from ghpt.files import write_json
from ghpt.paper.engine.tasks import Task, read_json


def add(config: dict[str, Any], dependencies: dict[str, Path], folder: Path) -> None:
    """The config's number and those of the dependencies; leaves a line in ``config["diary"]``."""
    with open(config["diary"], "a", encoding="utf-8") as diary:
        diary.write(f"{config['number']} {os.getpid()}\n")
    time.sleep(config.get("sleep", 0))
    if config["number"] < 0:
        raise GhptDataError(config["diary"], "number", "is negative", "Give a positive one")
    before = [read_json(path / "result.json") for path in dependencies.values()]
    write_json(folder / "result.json", config["number"] + sum(before))


def task(diary: Path, number: float, *dependencies: Task, **config: Any) -> Task:
    config |= {"number": number, "diary": str(diary)}
    return Task(
        f"add-{number}",
        "toy_tasks.add",
        config,
        {before.name: before for before in dependencies},
        seconds=1.0,
    )
