"""What the benchmarks share: settings from the command line, timing in pairs, and the machine's
description.
"""

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import torch
from rich.console import Console
from rich.table import Table

from ghpt.config import plain

ROOT = Path(__file__).resolve().parents[1]


def settings(**defaults: Any) -> dict[str, Any]:
    """``key=value`` words of the command line over the defaults, in the defaults' types."""
    words = dict(word.partition("=")[::2] for word in sys.argv[1:])
    if unknown := set(words) - set(defaults):
        sys.exit(f"unknown: {', '.join(unknown)}. Existing: {', '.join(defaults)}")
    return defaults | {name: type(defaults[name])(value) for name, value in words.items()}


def configuration(name: str, *overrides: str) -> dict[str, Any]:
    """What ``conf/<name>.yaml`` gives with these overrides, as plain data."""
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(hydra.compose(name, overrides=list(overrides)))


def seconds(function: Callable[[], Any], least: float, warm: bool = True) -> float:
    """Median time of a call, over at least three calls and ``least`` seconds."""
    if warm:
        function()
    taken: list[float] = []
    while len(taken) < 3 or sum(taken) < least:
        start = time.perf_counter()
        function()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def machine() -> str:
    """One line for the head of a result."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return (
        f"{os.cpu_count()} CPU cores ({platform.machine()}), torch {torch.__version__}"
        f" with {torch.get_num_threads()} threads, load {load:.1f} at the start"
    )


def show(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print a table that can be pasted into a Markdown file."""
    from rich import box

    table = Table(*columns, title=title, title_justify="left", box=box.MARKDOWN)
    for row in rows:
        table.add_row(*row)
    Console(width=120).print(table)
