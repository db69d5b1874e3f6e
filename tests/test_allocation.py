"""Files behind memory maps take their place on the disk at once, so that a full one is an error."""

import errno
import os

import pytest

from ghpt.commands.predict import COMMAND
from ghpt.commands.prediction import gaps as module
from ghpt.commands.prediction.gaps import Gaps, apply_gaps
from ghpt.commands.prediction.shards import Shards
from ghpt.export.stream import part
from ghpt.files import allocate
from ghpt.models.rows import RowWriter
from predicting import CONF, QUICK
from reconstructions import random_reconstruction
from test_predict import points_file, result, words

pytestmark = pytest.mark.usefixtures("blank_figures")

SIZE = 3_000_001
LIMIT = 20_000
"""Bytes of a file: less than the positions of 90 frames take."""
FILL = Gaps(3, "linear", None, None)


def without_fallocate(monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate", raising=False)


def refused_by_the_disk(monkeypatch):
    def fails(*_):
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "posix_fallocate", fails, raising=False)


def as_it_is(_):
    pass


def taken(path) -> int:
    """Bytes of the disk that a file has."""
    if not hasattr(os.stat_result, "st_blocks"):
        pytest.skip("this system does not tell what a file takes")
    return 512 * os.stat(path).st_blocks


def full_disk(handle, size, name):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(name))


@pytest.fixture
def small_files():
    """No file may grow beyond ``LIMIT``, as on a disk that is nearly full."""
    resource = pytest.importorskip("resource", reason="limits are POSIX")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("system", [as_it_is, without_fallocate, refused_by_the_disk])
@pytest.mark.parametrize("mode", ["w+b", "ab"])
def test_all_bytes_are_the_disk_s(tmp_path, monkeypatch, system, mode):
    system(monkeypatch)
    with open(tmp_path / "file", mode) as handle:
        allocate(handle, SIZE, "file")
        assert os.fstat(handle.fileno()).st_size == SIZE
    assert taken(tmp_path / "file") >= SIZE
    assert not any((tmp_path / "file").read_bytes())


@pytest.mark.parametrize("system", [as_it_is, without_fallocate])
def test_a_second_process_changes_nothing(tmp_path, monkeypatch, system):
    system(monkeypatch)
    content = bytes(range(250)) * 4
    (tmp_path / "file").write_bytes(content)
    for size in (1500, 1500, 1500):
        with open(tmp_path / "file", "ab") as handle:
            allocate(handle, size, "file")
    assert (tmp_path / "file").read_bytes() == content + bytes(500)


@pytest.mark.parametrize("system", [as_it_is, without_fallocate])
def test_a_file_without_bytes_is_none(tmp_path, monkeypatch, system):
    system(monkeypatch)
    with open(tmp_path / "file", "w+b") as handle:
        allocate(handle, 0, "file")
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.parametrize("system", [as_it_is, without_fallocate])
def test_a_file_that_cannot_grow_is_named(tmp_path, monkeypatch, small_files, system):
    system(monkeypatch)
    with (
        pytest.raises(OSError, match="'its name'") as caught,
        open(tmp_path / "file", "wb") as handle,
    ):
        allocate(handle, LIMIT + 1, "its name")
    assert caught.value.errno == errno.EFBIG


@pytest.fixture
def shards(tmp_path):
    opened = Shards(tmp_path / "shards", "key", 90, 10)
    whole = random_reconstruction(90)
    for shard in opened.missing():
        rows = opened.rows(shard)
        opened.write(shard, part(whole, rows.start, rows.stop))
    yield opened
    opened.close()


def test_a_disk_that_is_full_while_gaps_are_filled_names_the_folder(tmp_path, shards, small_files):
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(OSError, match="out'") as caught, apply_gaps(FILL, shards, 17, out):
        pass
    assert caught.value.filename == str(out)
    assert list(out.iterdir()) == []


def test_paths_are_allocated_before_anything_is_written_to_them(tmp_path, shards, monkeypatch):
    sizes = []

    def measured(handle, size, name):
        allocate(handle, size, name)
        sizes.append((size, taken(handle.fileno())))

    monkeypatch.setattr(module, "allocate", measured)
    monkeypatch.setattr(shards, "chunks", lambda: iter(()))
    with apply_gaps(FILL, shards, 17, tmp_path):
        pass
    assert [size for size, _ in sizes] == [90 * 17 * 3 * 8, 90 * 17]
    assert all(blocks >= size for size, blocks in sizes)


def test_a_prediction_that_stops_so_is_one_line_and_goes_on(tmp_path, monkeypatch, typed):
    given = [*words(tmp_path, points_file(tmp_path)), *QUICK, "fill=3", "formats=[npz]"]
    with monkeypatch.context() as patch:
        patch.setattr(module, "allocate", full_disk)
        status, _, errors = typed(CONF, COMMAND, given)
    assert status == 1
    last = errors.strip().splitlines()[-1]
    assert last.endswith(f"No space left on device: '{tmp_path / 'out'}'")
    assert "Traceback" not in errors
    assert not list((tmp_path / "out").glob("poses.*"))
    assert typed(CONF, COMMAND, given)[0] == 0
    assert len(result(tmp_path)[1]) == 40


LAYOUT = {"points": ("<f4", (17, 3))}


def test_rows_are_allocated_before_they_are_written(tmp_path):
    RowWriter(tmp_path / "rows", 1000, LAYOUT)
    assert taken(tmp_path / "rows" / "points") >= 1000 * 17 * 3 * 4


def test_rows_that_the_disk_cannot_hold_are_named(tmp_path, small_files):
    with pytest.raises(OSError, match="points") as caught:
        RowWriter(tmp_path / "rows", 1000, LAYOUT)
    assert caught.value.filename == str(tmp_path / "rows" / "points")
