"""Where a result comes from: versions, commit, seed, command."""

import platform
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

_PACKAGES = ("torch", "lightning", "numpy")
"""Beside ghpt itself, what decides numbers. They are asked for their versions, not imported."""


def provenance(seed: int) -> dict[str, str | int]:
    """Return what is needed to make a result again, as plain data."""
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    return {
        "ghpt": version("ghpt"),
        "commit": commit(),
        "seed": seed,
        "command": " ".join(command),
        "python": platform.python_version(),
        **{package: version(package) for package in _PACKAGES},
    }


@cache
def commit() -> str:
    """Return the git commit of the source tree, with + if files differ from it; '' without one.

    It is that of the first call in a process, which is nearest to the code that runs.
    """
    try:
        head = _git("rev-parse", "HEAD")
        # A command that is stopped here kills git, whose lock would then stay in the user's
        # repository.
        changed = _git("--no-optional-locks", "status", "--porcelain", "-uno")
    except (OSError, subprocess.SubprocessError):
        return ""
    return head + ("+" if changed else "")


def _git(*words: str) -> str:
    folder = Path(__file__).parent
    done = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()
