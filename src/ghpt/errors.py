"""The errors that a user can cause and mend. Each names where, what is wrong and the mend."""

import re
from typing import Any

_NO_MEMORY = re.compile(r"can't allocate memory|out of memory")


class GhptError(ValueError):
    """Base of all errors that ghpt raises on purpose. They can be sent from one process to another."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), str(self), vars(self))


def _again(kind: type[GhptError], text: str, attributes: dict[str, Any]) -> GhptError:
    """An unpickled error: its constructor takes other arguments than its text."""
    error = kind.__new__(kind, text)
    error.args = (text,)
    error.__dict__.update(attributes)
    return error


class GhptDataError(GhptError):
    """Bad input data: a file, folder, array or camera.

    Reads as ``WHERE: FIELD: PROBLEM. HINT`` (``field`` may be empty).
    """

    def __init__(self, where: object, field: str, problem: str, hint: str) -> None:
        self.where = str(where)
        self.field = field
        self.problem = problem
        self.hint = hint
        super().__init__(f"{where}: {f'{field}: ' if field else ''}{problem}. {hint}")


class GhptConfigError(GhptError):
    """A setting that cannot work. Reads as ``KEY: PROBLEM. HINT``."""

    def __init__(self, key: str, problem: str, hint: str) -> None:
        self.key = key
        self.problem = problem
        self.hint = hint
        super().__init__(f"{key}: {problem}. {hint}")


class GhptCheckpointError(GhptError):
    """A checkpoint that is missing, damaged, foreign, or of another model."""

    def __init__(self, path: object, problem: str, hint: str) -> None:
        self.path = str(path)
        self.problem = problem
        self.hint = hint
        super().__init__(f"{path}: {problem}. {hint}")


def one_line(error: BaseException) -> str:
    """An error's text without its line breaks."""
    return " ".join(str(error).split())


def out_of_memory(error: Exception) -> GhptConfigError | None:
    """The error in words, if it is that there was no more memory."""
    torch_s = isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))
    if not (isinstance(error, MemoryError) or torch_s):
        return None
    lines = str(error).splitlines() or ["an allocation failed"]
    hint = "Give smaller batches or fewer hypotheses, or close other programs."
    return GhptConfigError("memory", f"there is not enough ({lines[0][:200].rstrip('.')})", hint)


def check(condition: bool, key: str, problem: str, hint: str) -> None:
    """Raise GhptConfigError unless ``condition`` holds: for the constructors that yaml values
    reach.
    """
    if not condition:
        raise GhptConfigError(key, problem, hint)


def check_positive(**values: float | int) -> None:
    """Raise GhptConfigError for a setting that is not > 0."""
    for name, value in values.items():
        check(value > 0, name, f"is {value}", "It must be > 0.")
