"""B4: what a writer leaves was on the disk before it got its name, and its name was before the
writer went on.
"""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ghpt.commands.prediction.shards import MANIFEST, Shards
from ghpt.data.datasets.store import write_store
from ghpt.data.formats.camera_writers import write_aniposelib, write_opencv, write_pose2sim
from ghpt.data.formats.stored_npz import members_of
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.export import WRITERS, Scene
from ghpt.files import atomic_write, write_json
from ghpt.models.checkpoint import FIELD, FORMAT_VERSION, AtomicCheckpointIO
from ghpt.models.rows import RowWriter
from ghpt.paper.engine.tasks import Task, perform
from ghpt.skeleton import JOINTS
from reconstructions import about, in_parts, random_reconstruction, rig
from single_person import SinglePerson, write_person
from toys import recording

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="asks Linux what a handle is of"
)


def digest(path: str | Path) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class Diary:
    """Every fsync and rename in order, with what the file or folder held then."""

    def __init__(self, patch: pytest.MonkeyPatch, watched: tuple[Path, ...] = ()) -> None:
        self.synced: list[tuple[int, str, str]] = []
        """When, which file (its inode), and its content."""
        self.folders: list[tuple[int, Path]] = []
        self.renamed: list[tuple[int, Path, str, dict[Path, bytes]]] = []
        """When, to what, which inode, and what the watched files held."""
        self.time = 0
        self.watched = watched
        fsync, replace, rename = os.fsync, os.replace, os.rename

        def noted_fsync(handle: Any) -> None:
            fsync(handle)
            self.time += 1
            number = handle if isinstance(handle, int) else handle.fileno()
            path = Path(os.readlink(f"/proc/self/fd/{number}"))
            if path.is_dir():
                self.folders.append((self.time, path))
            else:
                self.synced.append((self.time, inode(path), digest(path)))

        def noted(move: Any) -> Any:
            def call(source: Any, target: Any, **more: Any) -> None:
                self.time += 1
                held = {path: path.read_bytes() for path in self.watched}
                self.renamed.append((self.time, Path(target), inode(source), held))
                move(source, target, **more)

            return call

        patch.setattr(os, "fsync", noted_fsync)
        patch.setattr(os, "replace", noted(replace))
        patch.setattr(os, "rename", noted(rename))

    def check(self, path: Path) -> None:
        """The file, or a file in a folder that was written as a whole, is durable."""
        (moved,) = [
            (time, target, node)
            for time, target, node, _ in self.renamed
            if target in (path, *path.parents)
        ]
        time, target, node = moved
        assert node == inode(target)
        before = [content for at, node, content in self.synced if node == inode(path) and at < time]
        assert before, f"{path.name} was not synced before it got its name"
        assert before[-1] == digest(path), f"{path.name} was written to after it was synced"
        named = [at for at, folder in self.folders if folder == target.parent and at > time]
        assert named, f"the name of {path.name} was not synced"
        if target != path:
            assert path.parent in self.synced_folders(time), f"{path.name}'s folder was not synced"

    def synced_folders(self, before: int) -> set[Path]:
        """Those that were synced by then, by the names that they have now."""
        renames = {f".{target.name}.": target for _, target, _, _ in self.renamed}
        return {
            next((t for start, t in renames.items() if folder.name.startswith(start)), folder)
            for at, folder in self.folders
            if at < before
        }


def inode(path: str | Path) -> str:
    status = os.stat(path)
    return f"{status.st_dev}:{status.st_ino}"


def save_checkpoint(folder: Path) -> None:
    state = {"x": torch.full((2000,), 1.0)}
    AtomicCheckpointIO().save_checkpoint(
        {"state_dict": state, FIELD: {"format_version": FORMAT_VERSION}}, folder / "last.ckpt"
    )


def save_rows(folder: Path) -> None:
    writer = RowWriter(folder / ".rows", 3, {"x": ("<f4", (2,))})
    writer.write(torch.tensor([2, 0, 1]), {"x": torch.ones(3, 2)})
    writer.finish(folder / "predictions.npz", {}, {}, members_of)


def save_rig(folder: Path) -> None:
    rig = human36m_rig("S9")
    write_opencv(folder, rig)
    write_pose2sim(folder / "rig.toml", rig, {})
    write_aniposelib(folder / "rig_anipose.toml", rig, {})


def save_key_points(folder: Path) -> None:
    values = np.ones((3, 2, len(JOINTS), 2))
    shape = values.shape[:-1]
    points = SinglePerson(
        "",
        ("a", "b"),
        JOINTS,
        np.arange(3),
        values,
        np.ones(shape),
        np.ones(shape, bool),
        10.0,
    )
    write_person(folder / "points.npz", points)


def save_store(folder: Path) -> None:
    write_store(
        folder / "store", [recording("S1/a", "S1", 5, 3, 0.1, np.random.default_rng(0))], {}
    )


def save_cell(folder: Path) -> None:
    diary = folder.parent / "diary"
    perform(Task("add", "toy_tasks.add", {"number": 1, "diary": str(diary)}), folder)


def save_poses(name: str) -> Any:
    def save(folder: Path) -> None:
        settings = {"scene": Scene(rig(3))} if name == "html" else {}
        writer = WRITERS[name]
        writer.write(folder / writer.file, about(), in_parts(random_reconstruction(30)), **settings)

    return save


SAVERS = {
    "a checkpoint": save_checkpoint,
    "predictions of a test": save_rows,
    "metrics": lambda folder: write_json(folder / "metrics.json", {"a": 1}),
    "a rig": save_rig,
    "key points": save_key_points,
    "prepared recordings": save_store,
    "a task": save_cell,
    **{name: save_poses(name) for name in ("npz", "csv", "parquet", "trc", "c3d", "html")},
}


@pytest.mark.parametrize("what", SAVERS)
def test_every_file_is_synced_then_named_and_its_name_is_synced(tmp_path, monkeypatch, what):
    folder = tmp_path / "out"
    folder.mkdir()
    diary = Diary(monkeypatch)
    SAVERS[what](folder)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files
    for path in files:
        diary.check(path)


def test_a_shard_is_durable_before_the_manifest_lists_it_and_the_line_is_synced(
    tmp_path, monkeypatch, record_row
):
    shards = Shards(tmp_path, "key", 20, 10)
    manifest = tmp_path / MANIFEST
    diary = Diary(monkeypatch, watched=(manifest,))
    for number in (0, 1):
        before = manifest.read_bytes()
        shards.write(number, random_reconstruction(10))
        diary.check(shards.path(number))
        renamed, _, _, held = next(
            entry for entry in diary.renamed if entry[1] == shards.path(number)
        )
        assert held[manifest] == before
        named = min(at for at, folder in diary.folders if folder == tmp_path and at > renamed)
        listed = [
            content for at, node, content in diary.synced if node == inode(manifest) and at > named
        ]
        assert listed[-1] == digest(manifest)
        assert manifest.read_bytes().count(b"\n") == 2 + number
    record_row(
        "B4", f"{len(SAVERS)} writers and the shards: synced before and after the rename", 1, 1
    )


CHECKED = {
    "a checkpoint": "last.ckpt",
    "predictions of a test": "predictions.npz",
    "npz": "poses.npz",
    "a rig": "intri.yml",
}


@pytest.mark.parametrize("what", CHECKED)
def test_what_the_disk_spoils_is_seen_before_it_takes_the_old_file_s_place(
    tmp_path, monkeypatch, what
):
    folder = tmp_path / "out"
    folder.mkdir()
    SAVERS[what](folder)
    before = digest(folder / CHECKED[what])
    real = os.fsync

    def spoils(handle: int) -> None:
        real(handle)
        path = Path(os.readlink(f"/proc/self/fd/{handle}"))
        if path.is_file():
            os.truncate(path, path.stat().st_size // 2)

    monkeypatch.setattr(os, "fsync", spoils)
    with pytest.raises(Exception, match=r".") as caught:
        SAVERS[what](folder)
    assert not isinstance(caught.value, AssertionError)
    assert digest(folder / CHECKED[what]) == before
    assert not list(folder.rglob("*.tmp"))


def test_the_diary_sees_what_is_written_after_the_sync(tmp_path, monkeypatch):
    """The checks above can fail."""
    diary = Diary(monkeypatch)

    def late(path: Path) -> None:
        with open(path, "ab") as handle:
            handle.write(b"late")

    with atomic_write(tmp_path / "a", verify=late) as handle:
        handle.write(b"early")
    with pytest.raises(AssertionError, match="written to after"):
        diary.check(tmp_path / "a")
