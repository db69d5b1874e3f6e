"""Run the reliability scorecard: ``python scripts/reliability.py [--nightly] [--output
reliability.json]``.

Per-push sizes are part of the test suite; ``--nightly`` runs the large ones. Prints one line a row
and writes them all to a JSON file with versions and the 3/N bound (rows without a failure in N
trials fail less often than 3/N, at 95 %).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from ghpt.files import write_json
from ghpt.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]
SHAPES = "--jaxtyping-packages=ghpt,beartype.beartype"
"""Has pytest check the shapes in the signatures."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nightly", action="store_true", help="the large sizes (tens of minutes)")
    parser.add_argument("--output", default="reliability.json")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "rows.jsonl"
        environment = os.environ | {
            "GHPT_RELIABILITY": str(log),
            "GHPT_NIGHTLY": str(int(options.nightly)),
        }
        tests = str(ROOT / "tests" / "reliability")
        command = [sys.executable, "-m", "pytest", SHAPES, tests]
        status = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    for row in sorted(rows, key=lambda r: r["row"]):
        bound = (
            f"failure rate < {3 / row['total']:.3g} at 95 %"
            if row["passed"] == row["total"] > 1
            else ""
        )
        print(f"{row['row']:4} {row['passed']:>6}/{row['total']:<6} {row['figure']}  {bound}")
    content = {"nightly": options.nightly, "provenance": provenance(0), "rows": rows}
    write_json(options.output, content)
    return status


if __name__ == "__main__":
    sys.exit(main())
