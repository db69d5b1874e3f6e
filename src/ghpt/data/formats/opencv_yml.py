"""The yml files of OpenCV's FileStorage, as far as they hold names, numbers and matrices.

Read without FileStorage: it reads names without quotes as numbers, and aborts the process on some
damaged files.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from ghpt.data.formats.validate import open_input
from ghpt.errors import GhptDataError

Node = str | float | list[str] | Float[np.ndarray, "..."]
_LARGEST = 1 << 18
_DEEPEST = 100
"""Bytes; lists in lists, by brackets or by indentation."""
_INDENTED = re.compile(rb"^[ ?:-]{%d}" % (_DEEPEST + 1), re.MULTILINE)
_Base: type = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""Builds texts, lists and dicts alone; libyaml's is ten times as fast and may be absent."""
_HINT = "It must be a yml file that OpenCV or EasyMocap wrote."


class _Loader(_Base):
    """Refuses a key that is there twice: of two cameras with one name, one would be lost."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key.value, str)]
        if len(set(keys)) != len(keys):
            name = next(key for key in keys if keys.count(key) > 1)
            raise yaml.constructor.ConstructorError(
                None, None, f"{name} is there twice", node.start_mark
            )
        return super().construct_mapping(node, deep)


def read_yml(path: Path) -> dict[str, Node | None]:
    """Return what each key holds: a matrix, a number, a text or a list of texts.

    Raises GhptDataError for a file that is too large or damaged.
    """
    with open_input(path) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise GhptDataError(path, "", f"has more than {_LARGEST >> 10} KiB", _HINT)
    if not data.endswith((b"\n", b"\r")):
        problem = "ends in the middle of a line: it is truncated"
        raise GhptDataError(path, "", problem, "Copy it again.")
    if _depth(data) > _DEEPEST or _INDENTED.search(data):
        raise GhptDataError(path, "", f"has more than {_DEEPEST} lists in lists", _HINT)
    lines = data.removeprefix(codecs.BOM_UTF8).splitlines()
    # %YAML:1.0 is no directive of YAML's
    body = b"\n".join(line for line in lines if not line.startswith(b"%"))
    try:
        content = yaml.load(body.decode(), Loader=_Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise GhptDataError(path, "", f"is not valid yml ({reason})", _HINT) from error
    if not isinstance(content, dict):
        raise GhptDataError(path, "", "holds no keys", _HINT)
    return {str(key): _node(path, str(key), value) for key, value in content.items()}


def _depth(data: bytes) -> int:
    """Return how many brackets are open at once."""
    characters = np.frombuffer(data, np.uint8)
    opened = np.isin(characters, list(b"[{")).astype(np.int32)
    closed = np.isin(characters, list(b"]}")).astype(np.int32)
    return int(np.cumsum(opened - closed).max(initial=0))


def _node(path: Path, key: str, value: Any) -> Node | None:
    if isinstance(value, dict) and {"rows", "cols", "data"} <= set(value):
        return _matrix(path, key, value)
    if isinstance(value, list):
        # lists within lists may stand for more than memory holds: a few lines of aliases double at
        # each line
        return [item for item in value if isinstance(item, str)]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return None


def _matrix(path: Path, key: str, value: dict[str, Any]) -> Float[np.ndarray, "rows cols"]:
    try:
        shape = int(value["rows"]), int(value["cols"])
        flat = np.array([float(item) for item in value["data"]])
        if min(shape) < 0 or flat.size != shape[0] * shape[1]:
            raise ValueError(f"{flat.size} numbers for {shape[0]} x {shape[1]}")
    except (ValueError, TypeError, OverflowError) as error:
        raise GhptDataError(path, key, f"is no matrix ({error})", _HINT) from error
    return flat.reshape(shape)
