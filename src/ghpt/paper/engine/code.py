"""What of the source code decides a number: a task is made again when this changes, and not for a
comment.
"""

import ast
import functools
import hashlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

import lightning
import numpy as np
import torch

PACKAGE = Path(__file__).parents[2]
DECIDES = (
    "data",
    "geometry",
    "models",
    "metrics",
    "calibration",
    "randomness.py",
    "recording.py",
    "skeleton.py",
    "commands/train.py",
    "commands/test.py",
    "report/poses.py",
    "report/pairs.py",
)
"""Every task depends on these files and folders of ghpt, and on the module of its own work."""


def code_digest(module: str) -> str:
    """A digest of the code behind a task whose work is in ``module``, and of the libraries that
    compute.
    """
    own = importlib.util.find_spec(module)
    files = [PACKAGE / name for name in DECIDES]
    versions = f"torch {torch.__version__} numpy {np.__version__} lightning {lightning.__version__}"
    parts = [meaning(file) for file in (*_python_files(files), Path(own.origin))]
    return hashlib.sha256("\n".join([versions, *parts]).encode()).hexdigest()


def _python_files(paths: Iterable[Path]) -> list[Path]:
    return [
        file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]


@functools.cache
def meaning(file: Path) -> str:
    """The file's code without comments, docstrings and layout."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [part for part in body if not _is_text(part)] or [ast.Pass()]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
