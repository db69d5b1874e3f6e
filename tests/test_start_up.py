"""What commands import before they do anything, read from the sources and not timed."""

import ast
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[1] / "src"


@cache
def imports(module: str) -> frozenset[str]:
    """The modules that a module of ghpt imports when it is imported itself."""
    path = SOURCES.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not path.exists():
        return frozenset()
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), module)
            found |= {source} | {f"{source}.{name.name}" for name in node.names}
    return frozenset(found)


def packages(module: str) -> set[str]:
    """The packages other than ghpt that are imported with a module."""
    known = {module}
    waiting = [module]
    others = set()
    while waiting:
        for name in imports(waiting.pop()):
            parts = name.split(".")
            if parts[0] != "ghpt":
                others.add(parts[0])
                continue
            inner = {".".join(parts[: count + 1]) for count in range(len(parts))} - known
            known |= inner
            waiting += inner
    return others


@pytest.mark.parametrize("command", ["calibrate", "cameras"])
def test_commands_on_files_import_no_lightning(command):
    """It takes three seconds, half of their start."""
    found = packages(f"ghpt.commands.{command}")
    assert "torch" in found
    assert not found & {"lightning", "torchmetrics"}


def test_what_is_imported_is_found():
    assert "lightning" in packages("ghpt.commands.train")
