"""Writers of reconstructions: one function for each format, all called alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

from ghpt.errors import check
from ghpt.export.c3d import write_c3d
from ghpt.export.html import write_html
from ghpt.export.markers import MarkerSet, find_marker_set
from ghpt.export.npz import read_reconstruction, write_npz
from ghpt.export.rerun import write_rerun
from ghpt.export.scene import Evidence, OtherPoses, Scene
from ghpt.export.stream import Chunks
from ghpt.export.table import write_csv, write_parquet
from ghpt.export.trc import write_trc

__all__ = [
    "WRITERS",
    "Chunks",
    "Evidence",
    "MarkerSet",
    "OtherPoses",
    "Scene",
    "Writer",
    "find_marker_set",
    "read_reconstruction",
]


@dataclass(frozen=True)
class Writer:
    """How a format is written: ``write(path, about, chunks, **settings)``.

    Atomic, at a memory that does not grow with the recording. Raises GhptConfigError for what the
    format needs and does not have (a rate, a package) and GhptDataError for frames or names that it
    cannot hold.
    """

    file: str
    """Its name in the output folder."""
    write: Callable[..., None]
    single: bool = False
    """Whether its positions have single precision, and so are relative to ``About.origin``."""
    pictures: bool = False
    """Whether it shows a `Scene`, its setting ``scene``, besides the skeleton."""
    has_markers: bool = False
    """Whether its joints may have the names of a marker set."""
    module: str | None = None
    """The module that it needs beside ghpt's own requirements."""
    package: str = ""
    """What to install for that."""

    def check_installed(self, name: str) -> None:
        """Raise GhptConfigError unless what the format needs is installed."""
        there = self.module is None or find_spec(self.module) is not None
        hint = f"Install it (pip install {self.package}), or leave {name} out."
        check(there, "formats", f"{name} needs {self.package}", hint)


WRITERS = {
    "npz": Writer("poses.npz", write_npz),
    "csv": Writer("poses.csv", write_csv),
    "parquet": Writer("poses.parquet", write_parquet, module="pyarrow", package="pyarrow"),
    "trc": Writer("poses.trc", write_trc, has_markers=True),
    "c3d": Writer("poses.c3d", write_c3d, single=True, has_markers=True),
    "html": Writer("poses.html", write_html, single=True, pictures=True),
    "rerun": Writer(
        "poses.rrd",
        write_rerun,
        single=True,
        pictures=True,
        module="rerun",
        package="rerun-sdk",
    ),
}
