"""The scorecard: each row prints its figure, and appends it to the file that GHPT_RELIABILITY
names.
"""

import json
import os
from collections.abc import Callable

import pytest

import sizes

collect_ignore = []
if not hasattr(os, "fork"):  # Windows: these kill forks, or limit their memory
    collect_ignore += [
        "test_bombs.py",
        "test_code_execution.py",
        "test_hostile_files.py",
        "test_many_files.py",
        "test_prediction_crash.py",
        "test_writing.py",
    ]
elif not os.path.exists("/proc/self"):  # macOS: these read a process's memory there
    collect_ignore += ["test_bombs.py", "test_hostile_files.py", "test_stream_memory.py"]


@pytest.fixture(scope="session")
def nightly() -> bool:
    """Whether to run the large sizes; see sizes.py."""
    return sizes.NIGHTLY


@pytest.fixture(scope="session")
def record_row() -> Callable[[str, str, int, int], None]:
    """``record_row(row, figure, passed, total)`` notes what a row measured."""

    def record(row: str, figure: str, passed: int, total: int) -> None:
        print(f"{row}: {figure} ({passed}/{total})")
        if path := os.environ.get("GHPT_RELIABILITY"):
            with open(path, "a", encoding="utf-8") as handle:
                handle.write(
                    json.dumps({"row": row, "figure": figure, "passed": passed, "total": total})
                    + "\n"
                )

    return record
