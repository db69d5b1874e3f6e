"""The scorecard: each row prints its figure, and appends it to the file that GHPT_RELIABILITY names."""

import json
import os
from collections.abc import Callable

import pytest


@pytest.fixture(scope="session")
def nightly() -> bool:
    """Whether to run the large sizes: GHPT_NIGHTLY=1."""
    return os.environ.get("GHPT_NIGHTLY") == "1"


@pytest.fixture(scope="session")
def record_row() -> Callable[[str, str, int, int], None]:
    """``record_row(row, figure, passed, total)`` notes what a row measured."""

    def record(row: str, figure: str, passed: int, total: int) -> None:
        print(f"{row}: {figure} ({passed}/{total})")
        if path := os.environ.get("GHPT_RELIABILITY"):
            with open(path, "a", encoding="utf-8") as handle:
                handle.write(json.dumps({"row": row, "figure": figure, "passed": passed, "total": total}) + "\n")

    return record
