"""From plain configuration to typed settings and to objects.

`settings` turns the composed configuration of a command into its frozen dataclass. `build` makes
objects of the groups that have a ``_target_``: it names a class, the other keys are its arguments.

Hydra composes the yaml; this builds it, because a checkpoint carries its configuration too, and
what comes out of a file must not be able to name arbitrary callables or read the environment
through interpolations. What a checkpoint may name is in ``ghpt.models.registry``.
"""

import dataclasses
import difflib
import functools
import importlib
import inspect
import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import (
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import yaml
from omegaconf import OmegaConf

from ghpt.errors import GhptConfigError, check, one_line

S = TypeVar("S")
_PACKAGE = Path(__file__).parent
CONF = next(
    folder for folder in (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf") if folder.is_dir()
)
"""The folder of the project's own configuration: of the installed package, or of the clone."""
Target = Mapping[str, Any]
"""A group of a configuration that has a ``_target_``: it stays plain, and `build` makes it."""
Find = Callable[[Mapping[str, Any], str], Callable[..., Any]]
"""Gives what a node with ``_target_`` is built with, of the node and the key it stands under."""
_DEPTH = 32
"""Of the groups in a configuration from a file."""
_NODES = 100_000
"""Of the values in a configuration from a file."""


_LARGEST_YAML = 1 << 20
"""Bytes of a file that the user names in a setting."""
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's, which is ten times as fast, where it is there."""


def read_yaml(path: Path, key: str) -> dict[str, Any]:
    """Return the mapping of a yaml that the setting ``key`` names; nothing in it is executed.

    Raises GhptConfigError for a file that is missing, damaged, too large or no mapping by text.
    """
    hint = "Name a yaml that can be read."
    try:
        check(path.stat().st_size <= _LARGEST_YAML, key, f"{path} is too large", hint)
        content = yaml.load(path.read_text(encoding="utf-8"), _LOADER)
    except (OSError, UnicodeError, yaml.YAMLError, RecursionError) as error:
        reason = one_line(error)[:200]
        raise GhptConfigError(key, f"{path} cannot be read ({reason})", hint) from error
    is_table = isinstance(content, dict) and all(isinstance(name, str) for name in content)
    check(is_table, key, f"{path} is no mapping", hint)
    return dict(content)


def plain(config: Any) -> Any:
    """Resolve an OmegaConf node to dicts, lists and scalars."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


def settings(cls: type[S], values: Mapping[str, Any], path: str = "") -> S:
    """Return the dataclass ``cls``, such as a command's settings, of a plain configuration.

    Every key must be a field, and every field without a default needs its key; a group that is
    annotated as a dataclass becomes one. Lists become tuples where the annotation says ``tuple``,
    integers floats where it says ``float``. Groups annotated as `Target` stay plain. ``path`` is
    the dotted key that ``values`` stand under.

    Raises GhptConfigError, naming the dotted key, for an unknown key, a missing key, a value of
    another type, and for what the dataclass itself refuses.
    """
    annotations = _annotations(cls)
    for name in values:
        if name not in annotations:
            hint = suggest(name, annotations)
            raise GhptConfigError(_join_key(path, name), "no such setting", hint)
    arguments = {}
    for name, wanted in annotations.items():
        key = _join_key(path, name)
        if name in values:
            arguments[name] = _convert(values[name], wanted, key)
        elif name in _required_fields(cls):
            raise GhptConfigError(key, "is missing", "Set it in the yaml.")
    try:
        return cls(**arguments)
    except GhptConfigError as error:
        if error.key not in arguments:
            raise
        key = _join_key(path, error.key)
        raise GhptConfigError(key, error.problem, error.hint) from error


def _annotations(cls: type[Any]) -> dict[str, Any]:
    """Return the annotation of each field of a dataclass."""
    hints = get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _required_fields(cls: type[Any]) -> set[str]:
    """Return the names of the fields of a dataclass that have no default."""
    missing = dataclasses.MISSING
    fields = dataclasses.fields(cls)
    return {f.name for f in fields if f.default is missing and f.default_factory is missing}


def _join_key(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _convert(value: Any, wanted: Any, key: str) -> Any:
    """Return a plain value as the annotation ``wanted`` has it; see `settings`."""
    kind = _alternative(value, wanted)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
        return settings(kind, value, key)
    check_type(value, wanted, key)
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in (list, tuple, Sequence) and inner:
        kinds = _kinds_of_items(kind, len(value))
        items = zip(value, kinds, strict=True)
        typed = [_convert(item, of_item, f"{key}[{i}]") for i, (item, of_item) in enumerate(items)]
        return typed if origin is list else tuple(typed)
    if origin in (dict, Mapping) and inner:
        return {name: _convert(item, inner[1], f"{key}.{name}") for name, item in value.items()}
    return float(value) if kind is float else value


def _alternative(value: Any, wanted: Any) -> Any:
    """Return which part of a union the value is of; any other annotation itself."""
    if get_origin(wanted) not in (Union, types.UnionType):
        return wanted
    alternatives = get_args(wanted)
    if type(value) in alternatives:
        return type(value)
    return next((kind for kind in alternatives if _fits(value, kind)), wanted)


def _kinds_of_items(wanted: Any, count: int) -> tuple[Any, ...]:
    """Return the annotation of each of ``count`` items of a list or tuple."""
    inner = get_args(wanted)
    if get_origin(wanted) is tuple and Ellipsis not in inner:
        return inner
    return (inner[0],) * count


def suggest(word: str, existing: Iterable[object]) -> str:
    """One sentence that says what exists, the nearest name first where there is one."""
    names = sorted(map(str, existing))
    near = difflib.get_close_matches(word, names, n=1)
    return (
        f"Did you mean {near[0]!r}? " if near else ""
    ) + f"Existing: {', '.join(names) or 'none'}."


def locate(node: Mapping[str, Any], path: str) -> Callable[..., Any]:
    """Import what ``node["_target_"]`` names: for what the user typed, never for what a file holds.

    Raises GhptConfigError if there is no such callable.
    """
    target = node["_target_"]
    parts = str(target).split(".")
    try:
        found, depth = next(
            (importlib.import_module(".".join(parts[:n])), n)
            for n in range(len(parts) - 1, 0, -1)
            if _is_module(".".join(parts[:n]))
        )
        for name in parts[depth:]:
            found = getattr(found, name)
    except (StopIteration, AttributeError):
        found = None
    if not callable(found):
        hint = "Check the spelling of the full name."
        raise GhptConfigError(f"{path}._target_", f"no class {target!r}", hint)
    return found


def build(config: Any, path: str = "config", find: Find = locate) -> Any:
    """Build what a plain configuration describes, inner parts first.

    ``find`` gives the class of a node with ``_target_``; by default whatever Python can import.
    ``_partial_: true`` gives the class with these arguments bound, not yet called.
    Raises GhptConfigError, naming the key's path, for an unknown target or argument, a missing
    argument, and a value that is not of its parameter's type.
    """
    if isinstance(config, list | tuple):
        return [build(v, f"{path}[{i}]", find) for i, v in enumerate(config)]
    if not isinstance(config, Mapping):
        return config
    # The outer class is looked up first: an error names it, and nothing in it has been built.
    target = find(config, path) if "_target_" in config else None
    settings = {k: v for k, v in config.items() if k not in ("_target_", "_partial_")}
    values = {k: build(v, f"{path}.{k}", find) for k, v in settings.items()}
    if target is None:
        return values
    partial = bool(config.get("_partial_"))
    check_arguments(target, values, path, partial)
    if partial:
        return functools.partial(target, **values)
    try:
        return target(**values)
    except GhptConfigError as error:
        if error.key not in values:
            raise
        raise GhptConfigError(f"{path}.{error.key}", error.problem, error.hint) from error


def check_plain(config: Any, path: str) -> None:
    """Raise GhptConfigError unless a configuration is plain data.

    Plain data is numbers, text, true, false and null, in lists and in dicts whose keys are text.
    What is deeper or larger than any configuration is refused too, so that all else may walk,
    compare and show what was checked without a bound of its own.
    """
    waiting = [(config, path, 0)]
    count = 0
    while waiting:
        value, where, depth = waiting.pop()
        kind = type(value)
        inner: list[tuple[str, Any]] = []
        if kind is dict:
            if not all(type(key) is str for key in value):
                raise GhptConfigError(where, "has a key that is no text", _PLAIN)
            inner = [(f"{where}.{key}", part) for key, part in value.items()]
        elif kind in (list, tuple):
            inner = [(f"{where}[{i}]", part) for i, part in enumerate(value[: _NODES + 1])]
        elif kind is int and value.bit_length() > 64:
            raise GhptConfigError(where, "is a number of more than 64 bits", _PLAIN)
        elif kind not in _SCALARS:
            raise GhptConfigError(where, f"is a {kind.__name__}", _PLAIN)
        count += len(inner)
        if depth > _DEPTH or count > _NODES:
            raise GhptConfigError(path, "is larger than any configuration", _PLAIN)
        waiting += [(part, name, depth + 1) for name, part in inner]


def _is_module(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ImportError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            return False
        raise
    return True


def check_arguments(
    target: Any, values: Mapping[str, Any], path: str, partial: bool = False
) -> None:
    """Raise GhptConfigError unless ``target(**values)`` has its arguments, by name and by annotated
    type.

    ``partial``: more may come later. ``path`` is the key that the values stand under.
    """
    parameters, open_ended = _parameters(target)
    for key, value in values.items():
        if key in parameters:
            check_type(value, parameters[key][0], f"{path}.{key}")
        elif not open_ended:
            raise GhptConfigError(
                f"{path}.{key}",
                f"{target.__qualname__} has no such setting",
                suggest(key, parameters),
            )
    missing = [
        name for name, (_, required) in parameters.items() if required and name not in values
    ]
    if missing and not partial:
        raise GhptConfigError(
            path, f"{target.__qualname__} needs {', '.join(missing)}", "Set it in the yaml."
        )


def check_type(value: Any, wanted: Any, key: str) -> None:
    """Raise GhptConfigError unless a plain value is what the annotation ``wanted`` says; an integer
    is a number too.
    """
    if is_typeddict(wanted) and isinstance(value, Mapping):
        for name, inner in get_type_hints(wanted).items():
            if name not in value:
                if name in wanted.__optional_keys__:
                    continue
                raise GhptConfigError(
                    f"{key}.{name}".lstrip("."), "is missing", "Set it in the yaml."
                )
            check_type(value[name], inner, f"{key}.{name}".lstrip("."))
    elif not _fits(value, wanted):
        shown = "null" if value is None else repr(value)
        hint = "Give a value of this kind."
        if isinstance(value, str | int | float) and _fits([value], wanted):
            hint = f"Give a list: {key}=[{value}]."
        raise GhptConfigError(key, f"is {shown}, not {_words(wanted)}", hint)


def _parameters(target: Any) -> tuple[dict[str, tuple[Any, bool]], bool]:
    """Name -> (annotation, required), with what ``**settings`` hands on to parent classes; whether
    any name goes.
    """
    found: dict[str, tuple[Any, bool]] = {}
    own = int(inspect.isclass(target))  # self is no setting
    for function in (
        [vars(c)["__init__"] for c in target.__mro__ if "__init__" in vars(c)] if own else [target]
    ):
        try:
            signature = inspect.signature(function).parameters.values()
        except ValueError:  # of C, without a signature
            return found, True
        try:
            hints = get_type_hints(function)
        except (NameError, TypeError):  # names that exist for type checkers alone
            hints = {}
        for p in list(signature)[own:]:
            if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY):
                found.setdefault(p.name, (hints.get(p.name, Any), p.default is p.empty))
        if not any(p.kind is p.VAR_KEYWORD for p in signature):
            return found, False
    return found, True


_PLAIN = "A configuration is numbers, text, true, false and null, in lists and groups."
_SCALARS = {
    int: "an integer",
    float: "a finite number",
    bool: "true or false",
    str: "text",
    types.NoneType: "null",
}


def _fits(value: Any, wanted: Any) -> bool:
    origin = get_origin(wanted)
    inner = get_args(wanted)
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if wanted is float:
        return type(value) in (int, float) and math.isfinite(value)
    if wanted in _SCALARS:
        return type(value) is wanted  # true is no integer
    if origin is Callable:
        return callable(value)
    if origin in (list, tuple, Sequence, Iterable):
        if not isinstance(value, list | tuple):
            return False
        kinds = _kinds_of_items(wanted, len(value))
        return len(kinds) == len(value) and all(map(_fits, value, kinds))
    if dataclasses.is_dataclass(wanted):
        return type(value) not in {*_SCALARS, list, tuple}
    if origin in (dict, Mapping) or is_typeddict(wanted):
        return isinstance(value, Mapping)
    return not isinstance(wanted, type) or wanted in (object, Any) or type(value) not in _SCALARS


def _is_plain(wanted: Any) -> bool:
    return wanted in _SCALARS or get_origin(wanted) is Literal or dataclasses.is_dataclass(wanted)


def _words(wanted: Any) -> str:
    """What ``_fits`` looks for, for people."""
    origin = get_origin(wanted)
    inner = get_args(wanted)
    if origin in (Union, types.UnionType):
        plain_ones = [one for one in inner if _is_plain(one) or get_origin(one) is list]
        return " or ".join(dict.fromkeys(map(_words, plain_ones or inner)))
    if origin is Literal:
        return ("one of " if len(inner) > 1 else "") + ", ".join(map(repr, inner))
    if origin in (list, tuple, Sequence, Iterable):
        return "a list" + (f" ({_words(inner[0])} each)" if inner else "")
    if origin in (dict, Mapping) or is_typeddict(wanted) or dataclasses.is_dataclass(wanted):
        return "a group of settings"
    return (
        _SCALARS.get(wanted)
        or f"a {getattr(wanted, '__name__', wanted)}: a group of settings with _target_"
    )
