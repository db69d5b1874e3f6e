"""Shards: what is listed is whole, what is not is made anew, whatever was done to the folder."""

import hashlib
import json
import os
from dataclasses import fields, replace

import pytest
import torch

from ghpt.commands.prediction.shards import MANIFEST, Shards
from ghpt.errors import GhptDataError
from ghpt.export.stream import part
from ghpt.reconstruction import Reconstruction
from reconstructions import random_reconstruction


@pytest.fixture
def whole():
    return random_reconstruction(25)


def shards(folder, key="key", frames=25, size=10, **more) -> Shards:
    return Shards(folder, key, frames, size, **more)


def filled(folder, whole) -> Shards:
    opened = shards(folder)
    for shard in opened.missing():
        rows = opened.rows(shard)
        opened.write(shard, part(whole, rows.start, rows.stop))
    return opened


def test_what_is_read_is_what_was_written(tmp_path, whole):
    opened = filled(tmp_path, whole)
    parts = list(opened.chunks())
    assert [len(p) for p in parts] == [10, 10, 5]
    for field in fields(Reconstruction):
        torch.testing.assert_close(
            torch.cat([getattr(p, field.name) for p in parts]),
            getattr(whole, field.name),
            rtol=0,
            atol=0,
        )


def test_the_same_content_gives_the_same_bytes(tmp_path, whole):
    one, other = filled(tmp_path / "a", whole), filled(tmp_path / "b", whole)
    for shard in range(3):
        assert one.path(shard).read_bytes() == other.path(shard).read_bytes()
    assert (tmp_path / "a" / MANIFEST).read_bytes() == (tmp_path / "b" / MANIFEST).read_bytes()


def test_an_opened_folder_goes_on_where_it_was(tmp_path, whole):
    opened = shards(tmp_path)
    opened.write(1, part(whole, 10, 20))
    opened.close()
    again = shards(tmp_path)
    assert again.missing() == [0, 2]
    torch.testing.assert_close(again.read(1).points, whole.points[10:20], rtol=0, atol=0)


@pytest.mark.parametrize("kept", range(0, 60, 7))
def test_a_manifest_that_was_cut_off_costs_the_last_shard(tmp_path, whole, kept):
    filled(tmp_path, whole).close()
    manifest = tmp_path / MANIFEST
    lines = manifest.read_bytes().splitlines(keepends=True)
    manifest.write_bytes(b"".join(lines[:3]) + lines[3][:kept])
    again = shards(tmp_path)
    assert again.missing() == [2]
    again.write(2, part(whole, 20, 25))
    again.close()
    assert shards(tmp_path).missing() == []


@pytest.mark.parametrize("damage", ["cut", "flipped", "gone", "swapped"])
def test_a_damaged_shard_is_made_anew(tmp_path, whole, damage):
    opened = filled(tmp_path, whole)
    opened.close()
    path = opened.path(1)
    data = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(data[:-1])
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif damage == "swapped":
        path.write_bytes(opened.path(0).read_bytes())
    else:
        path.unlink()
    if damage == "flipped":
        with pytest.raises(GhptDataError, match=r"000001\.npz: is not the shard"):
            opened.read(1)
    assert shards(tmp_path).missing() == [1]
    assert not path.exists()


@pytest.mark.parametrize("changed", [{"key": "other"}, {"frames": 24}, {"size": 9}])
def test_other_settings_start_anew_and_say_so(tmp_path, whole, changed, caplog):
    filled(tmp_path, whole).close()
    with caplog.at_level("INFO"):
        again = shards(tmp_path, **changed)
    assert again.missing() == list(range(len(again)))
    assert "starting anew" in caplog.text
    assert not list(tmp_path.glob("*.npz"))


def test_an_unlisted_shard_does_not_count(tmp_path, whole):
    """A kill between the shard's rename and its line."""
    opened = filled(tmp_path, whole)
    opened.close()
    manifest = tmp_path / MANIFEST
    manifest.write_bytes(b"".join(manifest.read_bytes().splitlines(keepends=True)[:-1]))
    assert shards(tmp_path).missing() == [2]


@pytest.mark.parametrize(
    "line",
    ["null", "[]", '{"shard": "0"}', '{"shard": true}', '{"shard": -1}', '{"shard": 99}', "{"],
)
def test_lines_that_are_no_entries_are_passed_over(tmp_path, whole, line):
    filled(tmp_path, whole).close()
    with open(tmp_path / MANIFEST, "a", encoding="utf-8") as handle:
        handle.write(line + "\n")
    assert shards(tmp_path).missing() == []


def test_a_second_run_is_refused_and_a_dead_ones_lock_is_none(tmp_path):
    opened = shards(tmp_path)
    with pytest.raises(GhptDataError, match="another prediction"):
        shards(tmp_path)
    opened.close()
    assert shards(tmp_path).missing() == [0, 1, 2]


def test_looking_changes_nothing(tmp_path, whole):
    opened = shards(tmp_path)
    beside = shards(tmp_path, clean=False)
    opened.write(0, part(whole, 0, 10))
    before = sorted((p.name, p.stat().st_mtime_ns) for p in tmp_path.iterdir())
    assert shards(tmp_path, clean=False).missing() == [1, 2]
    beside.write(2, part(whole, 20, 25))
    opened.refresh()
    assert opened.missing() == [1]
    assert len(before) == len(list(tmp_path.iterdir())) - 1


def test_the_manifest_lists_a_shard_after_it_is_there(tmp_path, whole, monkeypatch):
    opened = shards(tmp_path)
    real = os.open

    def dies(path, flags, *mode):
        if flags & os.O_APPEND:
            raise RuntimeError("killed here")
        return real(path, flags, *mode)

    monkeypatch.setattr(os, "open", dies)
    with pytest.raises(RuntimeError, match="killed here"):
        opened.write(0, part(whole, 0, 10))
    assert opened.path(0).is_file()
    assert len([json.loads(line) for line in (tmp_path / MANIFEST).read_text().splitlines()]) == 1


def lines_of(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / MANIFEST).read_text().splitlines()]


def test_the_manifest_says_what_its_shards_are_of_and_their_digests(tmp_path, whole):
    """What is on the disk, which another version must be able to tell from its own."""
    folder = tmp_path / "not" / "there"
    filled(folder, whole).close()
    header, *entries = lines_of(folder)
    assert header == {"version": 4, "key": "key", "frames": 25, "shard_frames": 10}
    for shard, entry in enumerate(entries):
        data = (folder / f"{shard:06d}.npz").read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        assert entry == {"shard": shard, "bytes": len(data), "sha256": digest}
    assert len(entries) == 3


def test_another_version_s_shards_start_anew(tmp_path, whole):
    filled(tmp_path, whole).close()
    header, *entries = lines_of(tmp_path)
    changed = [header | {"version": 1}, *entries]
    (tmp_path / MANIFEST).write_text("".join(json.dumps(line) + "\n" for line in changed))
    assert shards(tmp_path).missing() == [0, 1, 2]


@pytest.mark.parametrize("content", ["", "\n\n", "[]\nnull\n{"])
def test_a_manifest_without_an_entry_is_none(tmp_path, whole, content):
    filled(tmp_path, whole).close()
    (tmp_path / MANIFEST).write_text(content)
    assert shards(tmp_path).missing() == [0, 1, 2]


@pytest.mark.parametrize(("number", "left"), [(-1, True), (3, False)])
def test_a_shard_beyond_the_recording_is_none_even_if_it_is_whole(tmp_path, whole, number, left):
    """A file with a name that no shard has is left alone."""
    opened = filled(tmp_path, whole)
    opened.close()
    opened.path(number).write_bytes(opened.path(0).read_bytes())
    line = lines_of(tmp_path)[1] | {"shard": number}
    with open(tmp_path / MANIFEST, "a", encoding="utf-8") as handle:
        handle.write(json.dumps(line) + "\n")
    again = shards(tmp_path)
    assert sorted(again.kept) == [0, 1, 2]
    assert again.path(number).exists() is left


def test_looking_takes_in_only_what_is_whole_and_keeps_what_it_knows(tmp_path, whole):
    opened = shards(tmp_path)
    opened.write(0, part(whole, 0, 10))
    beside = shards(tmp_path, clean=False)
    for shard in (1, 2):
        beside.write(shard, part(whole, 10 * shard, min(10 * shard + 10, 25)))
    cut = opened.path(2).read_bytes()[:-1]
    opened.path(2).write_bytes(cut)
    opened.path(0).unlink()
    opened.refresh()
    assert sorted(opened.kept) == [0, 1]


def test_a_line_that_the_disk_cuts_off_is_an_error(tmp_path, whole, monkeypatch):
    opened = shards(tmp_path)
    real = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: real(handle, data[:5]))
    with pytest.raises(OSError, match="No space left") as caught:
        opened.write(0, part(whole, 0, 10))
    assert caught.value.filename == str(tmp_path / MANIFEST)
    monkeypatch.undo()
    opened.close()
    assert shards(tmp_path).missing() == [0, 1, 2]


@pytest.mark.parametrize(("frames", "sizes"), [(1, [1]), (10, [10]), (11, [10, 1]), (20, [10, 10])])
def test_the_last_shard_has_the_rest(tmp_path, frames, sizes):
    opened = shards(tmp_path, frames=frames)
    assert [len(opened.rows(shard)) for shard in range(len(opened))] == sizes
    assert [row for shard in range(len(opened)) for row in opened.rows(shard)] == [*range(frames)]


def test_positions_keep_their_digits_far_from_the_zero(tmp_path, whole):
    far = replace(whole, points=whole.points + 1e10)
    opened = shards(tmp_path, size=25)
    opened.write(0, far)
    assert torch.equal(opened.read(0).points, far.points)


def test_an_opened_folder_keeps_other_people_s_files(tmp_path, whole):
    (tmp_path / "notes.txt").write_text("mine")
    filled(tmp_path, whole)
    assert (tmp_path / "notes.txt").read_text() == "mine"
