"""The errors that a user can cause. Each names where, what is wrong and the hint what to do."""

import re
from typing import Any

_NO_MEMORY = re.compile(r"can't allocate memory|out of memory")


class GhptError(ValueError):
    """Base of all errors that ghpt raises on purpose.

    They can be sent from one process to another.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (type(self), str(self), vars(self))


def _restore(kind: type[GhptError], text: str, attributes: dict[str, Any]) -> GhptError:
    """Return an unpickled error, whose constructor takes other arguments than its text."""
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
        place = f"{where}: {field}" if field else str(where)
        super().__init__(f"{place}: {problem}. {hint}")


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
    """Return an error's text without its line breaks."""
    words = str(error).split()
    return " ".join(words)


def out_of_memory(error: Exception) -> GhptConfigError | None:
    """Return the error in words, if it is that there was no more memory."""
    text = str(error)
    is_torchs = isinstance(error, RuntimeError) and _NO_MEMORY.search(text)
    if not isinstance(error, MemoryError) and not is_torchs:
        return None
    first = (text.splitlines() or ["an allocation failed"])[0]
    reason = first[:200].rstrip(".")
    hint = "Give smaller batches or fewer hypotheses, or close other programs."
    return GhptConfigError("memory", f"there is not enough ({reason})", hint)


def check(condition: bool, key: str, problem: str, hint: str) -> None:
    """Raise GhptConfigError unless ``condition`` holds.

    It is for the constructors that values of the yaml reach.
    """
    if not condition:
        raise GhptConfigError(key, problem, hint)


def check_positive(**values: float | int) -> None:
    """Raise GhptConfigError for a setting that is not > 0."""
    for name, value in values.items():
        is_positive = value > 0
        check(is_positive, name, f"is {value}", "It must be > 0.")
