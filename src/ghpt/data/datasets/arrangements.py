"""The paper's five camera arrangements as DataModules, each from its embedded or its real source."""

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypedDict

from ghpt.config import check_arguments
from ghpt.data.datasets.datamodule import KeyPointDataModule
from ghpt.data.datasets.human36m import DAMAGED, human36m_files, human36m_recordings
from ghpt.data.datasets.panoptic import panoptic_files, panoptic_recordings
from ghpt.data.datasets.store import file_stamps
from ghpt.data.synthetic.detector import Detector
from ghpt.data.synthetic.recordings import embedded_recordings
from ghpt.errors import GhptDataError, check
from ghpt.recording import Recording


class Embedded(TypedDict):
    """Settings of the embedded source."""

    seed: int
    detector: dict[str, Any]


class _Arrangement(KeyPointDataModule):
    """The choice between the embedded and the real source."""

    def __init__(self, cameras: Sequence[int], embedded: Embedded, **settings: Any) -> None:
        super().__init__(**settings)
        check(
            len(cameras) >= 2,
            "data.cameras",
            f"is {list(cameras)}",
            "Triangulation needs at least 2 views.",
        )
        check_arguments(Detector, embedded["detector"], "data.embedded.detector")
        self.cameras = list(cameras)
        self.embedded = embedded

    def _embedded(self, split: str) -> Iterable[Recording]:
        detector = Detector(**self.embedded["detector"])
        return embedded_recordings(self.name, split, self.embedded["seed"], detector, self.cameras)

    def _key(self, split: str, files: list[Path] | None, **more: Any) -> dict[str, Any]:
        key = {
            "name": f"{self.name}-{split}-{'real' if self.root else 'embedded'}",
            "cameras": self.cameras,
        }
        if files is None:
            return key | {"embedded": self.embedded, "made by": _made_by()}
        return key | more | {"root": self.source, "files": file_stamps(files, self._root())}

    def _root(self) -> Path:
        root = Path(self.root or "").expanduser()
        if not root.is_dir():
            raise GhptDataError(
                root, "data.root", "there is no such folder", "Give the data set's folder, or none."
            )
        return root


def _made_by() -> str:
    """A hash of the files that make the embedded recordings: whoever changes them need not clear a
    cache.
    """
    package = Path(__file__).parents[2]
    digest = hashlib.sha256((package / "geometry" / "lens.py").read_bytes())
    for path in sorted((package / "data" / "synthetic").iterdir()):
        if path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()


class Human36M(_Arrangement):
    """Human3.6M's four cameras; S1 S5 S6 S7 train, S8 validation, S9 S11 test.

    ``damaged``: keep the three takes of S9 whose ground truth is damaged (the report also gives the
    errors without).
    """

    def __init__(self, damaged: bool, **settings: Any) -> None:
        super().__init__(**settings)
        self.damaged = damaged

    def make(self, split: str) -> Iterable[Recording]:
        if self.root is not None:
            return human36m_recordings(self._root(), split, self.cameras, self.damaged)
        return (r for r in self._embedded(split) if self.damaged or r.name not in DAMAGED)

    def key(self, split: str) -> dict[str, Any]:
        return self._key(split, human36m_files(self._root(), split) if self.root else None) | {
            "damaged": self.damaged
        }


class Panoptic(_Arrangement):
    """CMU Panoptic Studio's HD cameras by number; each sequence 60/20/20 % in time."""

    def make(self, split: str) -> Iterable[Recording]:
        return (
            panoptic_recordings(self._root(), self.cameras, split)
            if self.root
            else self._embedded(split)
        )

    def key(self, split: str) -> dict[str, Any]:
        return self._key(split, panoptic_files(self._root(), self.cameras) if self.root else None)
