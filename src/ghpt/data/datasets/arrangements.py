"""The paper's five camera arrangements as DataModules, of their synthetic or real sources."""

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
from ghpt.data.synthetic.recordings import synthetic_recordings
from ghpt.errors import GhptDataError, check
from ghpt.observations import LabelledRecording


class Synthetic(TypedDict):
    """Settings of the synthetic source."""

    seed: int
    detector: dict[str, Any]


class _Arrangement(KeyPointDataModule):
    """The choice between the synthetic and the real source."""

    name: str

    def __init__(self, cameras: Sequence[int], synthetic: Synthetic, **settings: Any) -> None:
        super().__init__(**settings)
        hint = "Triangulation needs at least 2 views."
        check(len(cameras) >= 2, "data.cameras", f"is {list(cameras)}", hint)
        check_arguments(Detector, synthetic["detector"], "data.synthetic.detector")
        self.cameras = list(cameras)
        self.synthetic = synthetic

    def _synthesize(self, split: str) -> Iterable[LabelledRecording]:
        seed = self.synthetic["seed"]
        detector = Detector(**self.synthetic["detector"])
        return synthetic_recordings(self.name, split, seed, detector, self.cameras)

    def _key(self, split: str, files: list[Path] | None) -> dict[str, Any]:
        """Return what the recordings of a split depend on; ``files`` are those of a real source."""
        source = "real" if self.root else "synthetic"
        key = {"name": f"{self.name}-{split}-{source}", "cameras": self.cameras}
        if files is None:
            return key | {"synthetic": self.synthetic, "made by": synthesis_digest()}
        return key | {"root": self.source, "files": file_stamps(files, self._root())}

    def _root(self) -> Path:
        root = Path(self.root or "").expanduser()
        if not root.is_dir():
            hint = "Give the data set's folder, or none."
            raise GhptDataError(root, "data.root", "there is no such folder", hint)
        return root


def synthesis_digest() -> str:
    """Return a hash of the files that make the synthetic recordings.

    Whoever changes them need not clear a cache.
    """
    package = Path(__file__).parents[2]
    geometry = package / "geometry"
    files = [geometry / "lens.py", geometry / "masking.py"]
    files += sorted((package / "data" / "synthetic").iterdir())
    digest = hashlib.sha256()
    for path in files:
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

    def generate(self, split: str) -> Iterable[LabelledRecording]:
        if self.root is not None:
            return human36m_recordings(self._root(), split, self.cameras, self.damaged)
        recordings = self._synthesize(split)
        return (r for r in recordings if self.damaged or r.name not in DAMAGED)

    def cache_key(self, split: str) -> dict[str, Any]:
        files = human36m_files(self._root(), split) if self.root else None
        return self._key(split, files) | {"damaged": self.damaged}


class Panoptic(_Arrangement):
    """CMU Panoptic Studio's HD cameras by number; each sequence 60/20/20 % in time."""

    def generate(self, split: str) -> Iterable[LabelledRecording]:
        if self.root is not None:
            return panoptic_recordings(self._root(), self.cameras, split)
        return self._synthesize(split)

    def cache_key(self, split: str) -> dict[str, Any]:
        files = panoptic_files(self._root(), self.cameras) if self.root else None
        return self._key(split, files)
