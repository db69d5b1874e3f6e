"""Writes a small reconstruction in every format to a folder: for tests in other environments."""

import locale
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from ghpt.export import WRITERS, Scene
from reconstructions import about, in_parts, random_reconstruction, rig

FORMATS = ("npz", "csv", "parquet", "trc", "c3d", "html")

if __name__ == "__main__":
    locale.setlocale(locale.LC_ALL, "")
    made = random_reconstruction(30)
    who = about(joints=("İIıi", "hip", *(f"joint_{j}" for j in range(15))))
    for format in FORMATS:
        settings = {"scene": Scene(rig(3))} if format == "html" else {}
        WRITERS[format].write(
            Path(sys.argv[1]) / WRITERS[format].file, who, in_parts(made), **settings
        )
    print(locale.localeconv()["decimal_point"])
