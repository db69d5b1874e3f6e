"""The code that decides a result: a task is run again when it changes, but not for a comment.

The code of a task is the import closure of its action's module and of the classes that its
configuration names. It is read from the source files; nothing is imported.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

PACKAGE = "ghpt"
PRESENTATION = "ghpt.report"
"""The package that shows numbers and decides none: it is not followed."""
_ROOT = Path(__file__).resolve().parents[2]
"""The package's folder."""
LIBRARIES = ("torch", "numpy", "lightning")
"""Libraries that count with their versions."""


@functools.cache
def code_digest(names: frozenset[str]) -> str:
    """Return a digest of the modules ``names`` and of all that they import, directly or not.

    A name may also be that of a class or function in a module. What counts is the meaning of the
    source, the content of data files that a module loads from its own folder, and the versions of
    `LIBRARIES`. Of other packages than ghpt only those of ``names`` themselves are followed.
    """
    parts = [f"{library} {importlib.metadata.version(library)}" for library in LIBRARIES]
    for name, file in sorted(import_closure(names).items()):
        parts.append(f"{name} {source_meaning(file)}")
        parts += [f"{data.name} {_content(data)}" for data in data_files(file)]
    return _sha256("\n".join(parts).encode())


def target_names(config: Any) -> Iterator[str]:
    """Yield the ``_target_`` of every group of a plain configuration."""
    if isinstance(config, dict):
        if "_target_" in config:
            yield config["_target_"]
        for value in config.values():
            yield from target_names(value)
    elif isinstance(config, list | tuple):
        for value in config:
            yield from target_names(value)


def import_closure(names: Iterable[str]) -> dict[str, Path]:
    """Return the source file of each module that ``names`` lead to, by the module's name."""
    first = list(names)
    packages = {PACKAGE, *(name.partition(".")[0] for name in first)} - set(LIBRARIES)
    found: dict[str, Path] = {}
    waiting = first
    while waiting:
        name = waiting.pop()
        if name.partition(".")[0] not in packages or f"{name}.".startswith(f"{PRESENTATION}."):
            continue
        for module in _prefixes(name):
            file = source_file(module)
            if file is not None:
                break
        if file is not None and module not in found:
            found[module] = file
            waiting += imported_names(module, file)
    return found


def _prefixes(name: str) -> list[str]:
    """Return the parts of a dotted name that can be a module, the longest first."""
    parts = name.split(".")
    return [".".join(parts[:count]) for count in range(len(parts), 0, -1)]


@functools.cache
def source_file(module: str) -> Path | None:
    """Return the file of a module's Python source, None where there is none."""
    package, *rest = module.split(".")
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return None
    if not rest:
        file = Path(spec.origin)
        return file if file.suffix == ".py" else None
    for folder in spec.submodule_search_locations or ():
        path = Path(folder, *rest)
        for candidate in (path.with_suffix(".py"), path / "__init__.py"):
            if candidate.is_file():
                return candidate
    return None


def imported_names(module: str, file: Path) -> list[str]:
    """Return what a module imports anywhere, in functions too: modules, and names within them.

    What is imported for type checkers alone decides nothing, and is left out.
    """
    names = []
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    for node in _walk_executed(_parse(file)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = _absolute(node, package)
            names += [origin, *(f"{origin}.{alias.name}" for alias in node.names)]
    return names


def _walk_executed(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes but those within ``if TYPE_CHECKING:``."""
    yield tree
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            for alternative in child.orelse:
                yield from _walk_executed(alternative)
        else:
            yield from _walk_executed(child)


def _absolute(node: ast.ImportFrom, package: str) -> str:
    """Return the full name of the module that a ``from ... import`` statement names."""
    if not node.level:
        return node.module or ""
    parents = package.split(".")
    base = parents[: len(parents) - node.level + 1]
    return ".".join([*base, node.module] if node.module else base)


def data_files(file: Path) -> list[Path]:
    """Return the data files of the package that the texts of a module's code name.

    They are files beside it, other than Python's, and arrays in a folder of the package.
    """
    constants = (node.value for node in ast.walk(_parse(file)) if isinstance(node, ast.Constant))
    texts = {text for text in constants if isinstance(text, str)}
    beside = (path for path in file.parent.iterdir() if path.suffix != ".py" and path.is_file())
    folders = (_ROOT / text for text in texts if text.isidentifier())
    arrays = [path for folder in folders for path in folder.glob("*.npz")]
    return sorted([*arrays, *(path for path in beside if path.name in texts)])


@functools.cache
def source_meaning(file: Path) -> str:
    """Return the file's code without comments, docstrings and layout."""
    return ast.dump(_WithoutDocstrings().visit(_parse(file)))


class _WithoutDocstrings(ast.NodeTransformer):
    """Removes every statement that is a text alone."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        value = node.value
        is_text = isinstance(value, ast.Constant) and isinstance(value.value, str)
        return None if is_text else node


def _parse(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def _content(file: Path) -> str:
    return _sha256(file.read_bytes())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
