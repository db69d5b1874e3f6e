"""Prepared recordings: what is written is what is read, and nothing damaged is accepted."""

import json
import multiprocessing
import os
import signal
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ghpt.data.datasets import store
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras
from ghpt.observations import LabelledRecording


def recording(seed: int, frames: int = 7, views: int = 3) -> LabelledRecording:
    rng = np.random.default_rng(seed)
    return LabelledRecording(
        name=f"S1/take-{seed}",
        subject="S1",
        action="Größe 走",
        rate_hz=29.97,
        camera_names=tuple(f"c{v}" for v in range(views)),
        cameras=Cameras(
            *(torch.from_numpy(rng.normal(size=(views, *s))) for s in ((3, 3), (3, 3), (3,)))
        ),
        key_points=rng.normal(size=(frames, views, 17, 2)).astype(np.float32),
        confidence=rng.random((frames, views, 17), dtype=np.float32),
        valid=rng.random((frames, views, 17)) < 0.7,
        truth=rng.normal(size=(frames, 17, 3)).astype(np.float32),
        truth_valid=rng.random((frames, 17)) < 0.7,
        frame=rng.permutation(2**40 + np.arange(frames)),
    )


def assert_same(a: LabelledRecording, b: LabelledRecording) -> None:
    for field in fields(LabelledRecording):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name == "cameras":
            assert all(
                torch.equal(p, q) for p, q in zip((x.K, x.R, x.t), (y.K, y.R, y.t), strict=True)
            )
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            assert np.array_equal(x, y)
        else:
            assert x == y


def test_round_trip_is_exact_with_takes_longer_than_a_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "_CHUNK", 4)
    takes = [recording(0), recording(1, frames=1), recording(2, frames=13)]
    store.write_store(tmp_path / "s", iter(takes), {"source": "test", 3: [1, 2]})
    for a, b in zip(store.open_store(tmp_path / "s"), takes, strict=True):
        assert_same(a, b)
    store.verify_store(tmp_path / "s")
    assert store.read_manifest(tmp_path / "s").provenance == {"source": "test", "3": [1, 2]}


def test_arrays_are_read_only_maps_of_the_file(tmp_path: Path) -> None:
    store.write_store(tmp_path / "s", [recording(0)], {})
    (take,) = store.open_store(tmp_path / "s")
    for array in (take.key_points, take.valid, take.truth, take.frame):
        assert not array.flags.writeable
        assert not array.flags.owndata
    assert (tmp_path / "s" / "key_points.bin").read_bytes() == take.key_points.tobytes()


def test_prepares_once_per_key(tmp_path: Path) -> None:
    made = []

    def make(seed: int) -> list[LabelledRecording]:
        made.append(seed)
        return [recording(seed)]

    for seed in (0, 0, 1, 0):
        (take,) = store.prepare(
            tmp_path, {"name": "synthetic", "seed": seed}, lambda s=seed: make(s), {}
        )
        assert_same(take, recording(seed))
    assert made == [0, 1]
    assert sorted(p.name.rsplit("-", 1)[0] for p in tmp_path.iterdir()) == ["synthetic"] * 2


def test_a_changed_source_file_changes_the_key(tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    file.write_bytes(b"1")
    before = store.file_stamps([file], tmp_path)
    os.utime(file, ns=(1, 1))
    assert store.file_stamps([file], tmp_path) != before


def test_nothing_is_left_when_making_fails(tmp_path: Path) -> None:
    def make():
        yield recording(0)
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        store.prepare(tmp_path, {"name": "x"}, make, {})
    assert list(tmp_path.iterdir()) == []


def _make_slowly(root: Path, started: Path) -> None:
    def make():
        yield recording(0, frames=5000)
        started.touch()
        time.sleep(60)

    store.prepare(root, {"name": "x"}, make, {})


@pytest.mark.posix
def test_a_killed_preparation_is_swept_and_made_anew(tmp_path: Path) -> None:
    root, started = tmp_path / "cache", tmp_path / "started"
    child = multiprocessing.get_context("fork").Process(target=_make_slowly, args=(root, started))
    child.start()
    while not started.exists():
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    assert len(list(root.iterdir())) == 1
    (take,) = store.prepare(root, {"name": "x"}, lambda: [recording(0)], {})
    assert_same(take, recording(0))
    assert len(list(root.iterdir())) == 1


def _prepare(root: Path, start, results) -> None:
    start.wait()
    takes = store.prepare(root, {"name": "x"}, lambda: [recording(0, frames=3000)], {})
    results.put(int(takes[0].frame.sum()))


@pytest.mark.posix
def test_processes_that_prepare_the_same_at_once(tmp_path: Path) -> None:
    fork = multiprocessing.get_context("fork")
    start, results = fork.Event(), fork.Queue()
    children = [fork.Process(target=_prepare, args=(tmp_path, start, results)) for _ in range(4)]
    for child in children:
        child.start()
    start.set()
    assert [results.get(timeout=300) for _ in children] == [
        int(recording(0, frames=3000).frame.sum())
    ] * 4
    for child in children:
        child.join()
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_another_process_made_meanwhile_stays(tmp_path: Path) -> None:
    """Its readers have it mapped; ours goes away."""
    valid = []

    def make() -> list[LabelledRecording]:
        if not valid:
            valid.append(store.prepare(tmp_path, {"name": "x"}, make_other, {})[0])
        return [recording(1)]

    def make_other() -> list[LabelledRecording]:
        return [recording(0)]

    (take,) = store.prepare(tmp_path, {"name": "x"}, make, {})
    assert_same(take, recording(0))
    assert_same(valid[0], recording(0))
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", [*(f"{f.name}.bin" for f in store.FIELDS), "manifest.json"])
def test_every_truncated_or_missing_file_is_refused(tmp_path: Path, name: str) -> None:
    store.write_store(tmp_path / "s", [recording(0)], {})
    file = tmp_path / "s" / name
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(GhptDataError, match=f"{name}.*Delete this folder"):
        store.open_store(tmp_path / "s")
    file.unlink()
    with pytest.raises(GhptDataError, match=f"{name}.*Delete this folder"):
        store.open_store(tmp_path / "s")


def test_any_changed_digit_of_the_manifest_is_refused(tmp_path: Path) -> None:
    store.write_store(tmp_path / "s", [recording(0)], {})
    file = tmp_path / "s" / "manifest.json"
    good = file.read_bytes()
    digits = [i for i, byte in enumerate(good) if chr(byte).isdigit()]
    for i in np.random.default_rng(0).choice(digits, 200):
        file.write_bytes(
            good[:i] + bytes([ord("0") + (good[i] - ord("0") + 1) % 10]) + good[i + 1 :]
        )
        if json.loads(file.read_bytes()) != json.loads(
            good
        ):  # else a digit beyond double precision
            with pytest.raises(GhptDataError):
                store.open_store(tmp_path / "s")


def test_verification_finds_one_flipped_bit(tmp_path: Path) -> None:
    store.write_store(tmp_path / "s", [recording(0)], {})
    file = tmp_path / "s" / "truth.bin"
    data = bytearray(file.read_bytes())
    data[100] ^= 1
    file.write_bytes(data)
    with pytest.raises(GhptDataError, match="SHA-256"):
        store.verify_store(tmp_path / "s")


@pytest.mark.parametrize(
    ("takes", "problem"),
    [
        ([], "no frames"),
        ([recording(0, frames=0)], "no frames"),
        ([recording(0), recording(0)], "twice"),
        ([recording(0), recording(1, views=2)], "2 views"),
        (
            [replace(recording(0), truth=np.full((7, 17, 3), np.nan, np.float32))],
            "truth: is not finite",
        ),
        (
            [replace(recording(0), camera_names=("a", "b"), cameras=recording(1, views=2).cameras)],
            "has shape",
        ),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_written(
    tmp_path: Path, takes: list, problem: str
) -> None:
    with pytest.raises(GhptDataError, match=problem):
        store.write_store(tmp_path / "s", takes, {})
    assert list(tmp_path.iterdir()) == []
