"""Where a result comes from: versions, commit, seed, command."""

import platform
import subprocess
import sys
from pathlib import Path

import lightning
import numpy as np
import torch

import ghpt


def provenance(seed: int) -> dict[str, str | int]:
    """What is needed to make a result again, as plain data."""
    return {
        "ghpt": ghpt.__version__,
        "commit": commit(),
        "seed": seed,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "lightning": lightning.__version__,
        "numpy": np.__version__,
    }


def commit() -> str:
    """The git commit of the source tree, with + if files differ from it; '' where there is none."""
    folder = Path(__file__).parent
    try:
        options = {
            "cwd": folder,
            "capture_output": True,
            "text": True,
            "timeout": 10,
            "check": True,
        }
        head = subprocess.run(["git", "rev-parse", "HEAD"], **options).stdout.strip()
        # A command that is stopped here kills git, whose lock would then stay in the user's
        # repository.
        changed = subprocess.run(
            ["git", "--no-optional-locks", "status", "--porcelain", "-uno"], **options
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
    return head + ("+" if changed else "")
