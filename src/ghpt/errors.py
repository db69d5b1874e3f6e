"""The errors that a user can cause and mend. Each names where, what is wrong and the mend."""


class GhptError(ValueError):
    """Base of all errors that ghpt raises on purpose."""


class GhptDataError(GhptError):
    """Bad input data: a file, folder, array or camera.

    Reads as ``WHERE: FIELD: PROBLEM. MEND`` (``field`` may be empty).
    """

    def __init__(self, where: object, field: str, problem: str, mend: str) -> None:
        self.where, self.field, self.problem, self.mend = str(where), field, problem, mend
        super().__init__(f"{where}: {f'{field}: ' if field else ''}{problem}. {mend}")


class GhptConfigError(GhptError):
    """A setting that cannot work. Reads as ``KEY: PROBLEM. MEND``."""

    def __init__(self, key: str, problem: str, mend: str) -> None:
        self.key, self.problem, self.mend = key, problem, mend
        super().__init__(f"{key}: {problem}. {mend}")


class GhptCheckpointError(GhptError):
    """A checkpoint that is missing, damaged, foreign, or of another model."""

    def __init__(self, path: object, problem: str, mend: str) -> None:
        self.path, self.problem, self.mend = str(path), problem, mend
        super().__init__(f"{path}: {problem}. {mend}")


def check(condition: bool, key: str, problem: str, mend: str) -> None:
    """Raise GhptConfigError unless ``condition`` holds: for the constructors that yaml values reach."""
    if not condition:
        raise GhptConfigError(key, problem, mend)
