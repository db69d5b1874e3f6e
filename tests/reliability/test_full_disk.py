"""B5: where a file cannot be written, a command says which, in one line, and what was there before
is whole.
"""

import errno
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from tensorboard.summary.writer.record_writer import RecordWriter

import ghpt.commands.test as testing
import sizes
from ghpt.commands import predict as prediction
from ghpt.commands.prediction import sequences
from ghpt.commands.prediction.shards import MANIFEST, Shards
from ghpt.commands.train import COMMAND
from ghpt.models.checkpoint import read_checkpoint
from ghpt.models.rows import RowWriter
from ghpt.paper.engine.pool import perform_all
from predicting import sequence_of
from reconstructions import random_reconstruction
from toy_tasks import task

pytestmark = pytest.mark.usefixtures("blank_figures")

resource = pytest.importorskip("resource", reason="limits the size of files")
ROOT = Path(__file__).resolve().parents[2]
SMALL = (
    "data=toy",
    "model.hypotheses=5",
    "model.scorer.layers=[4]",
    "trainer.accelerator=cpu",
    "progress_bar=false",
    "trainer.max_epochs=1",
)


@contextmanager
def files_of_at_most(size: int):
    """No file can become longer: what is written beyond fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(folder: Path) -> dict[str, bytes]:
    """Of all files that a user reads; the log and the shards go on."""
    names = ("ckpt", "npz", "json", "md", "csv")
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.glob("*"))
        if path.suffix[1:] in names and not path.name.startswith(".")
    }


@pytest.fixture
def train_command(typed, conf, tmp_path):
    output = f"output={tmp_path / 'out'}"
    return lambda *words: typed(conf, COMMAND, [*SMALL, output, "overwrite=true", *words])


@pytest.fixture
def test_command(typed, conf, tmp_path, train_command, blank_figures):
    assert train_command(f"output={tmp_path / 'model'}")[0] == 0
    words = ("data=toy", f"ckpt={tmp_path / 'model' / 'last.ckpt'}", f"output={tmp_path / 'out'}")
    quiet = ("progress_bar=false", "trainer.accelerator=cpu")
    return lambda *more: typed(conf, testing.COMMAND, [*words, *quiet, *more])


@pytest.fixture
def predict_command(typed, tmp_path, monkeypatch):
    monkeypatch.setattr(sequences, "recording_sequence", lambda _: sequence_of(400))
    words = (
        "estimator=linear",
        "shard_frames=100",
        "formats=[npz,csv]",
        "evaluated_frames=4",
        "data=cmu1",
    )
    quiet = ("progress_bar=false", "trainer.accelerator=cpu", f"output={tmp_path / 'out'}")
    return lambda *more: typed(ROOT / "conf", prediction.COMMAND, [*words, *quiet, *more])


@pytest.mark.parametrize(
    ("name", "size"),  # bytes: another file than the first is too long for 60,000
    sizes.representatives(
        [("train_command", 12_000), ("test_command", 12_000), ("predict_command", 60_000)],
        [("predict_command", 12_000)],
    ),
)
def test_a_command_names_the_file_and_keeps_what_was_there(request, tmp_path, name, size):
    command = request.getfixturevalue(name)
    status, _, said = command()
    assert status == 0, said
    before = contents(tmp_path / "out")
    assert before
    if name == "predict_command":
        shutil.rmtree(tmp_path / "out" / prediction.SHARDS)  # else nothing is computed again
    with files_of_at_most(size):
        status, _, said = command()
    error = said.splitlines()[-1]
    assert status == 1, said
    assert error.startswith(f"error: [Errno {errno.EFBIG}] File too large: '{tmp_path / 'out'}"), (
        said
    )
    assert "Traceback" not in said
    assert contents(tmp_path / "out") == before
    left = [path.name for path in (tmp_path / "out").rglob("*") if path.name.endswith(".tmp")]
    assert left == []
    assert not (tmp_path / "out" / ".predictions").exists()
    assert command()[0] == 0


def test_a_cell_names_its_file(tmp_path):
    diary = tmp_path / "diary"
    diary.touch()
    wanted = [task(diary, 1, long="x" * 4_000)]
    with files_of_at_most(1_000), pytest.raises(OSError, match="File too large: ") as caught:
        perform_all(wanted, tmp_path / "tasks", 1, show=False)
    assert str(tmp_path / "tasks") in str(caught.value)
    assert list((tmp_path / "tasks").iterdir()) == []


def test_prepared_recordings_name_their_folder(train_command, tmp_path):
    cache = tmp_path / "cache"
    with files_of_at_most(10_000):
        status, _, said = train_command(f"data.cache={cache}")
    first, error = said.splitlines()
    assert status == 1
    assert first.startswith("Preparing ")
    assert error.startswith(f"error: [Errno {errno.EFBIG}] File too large: '{cache}")
    assert list(cache.iterdir()) == []


@pytest.fixture
def no_space(monkeypatch):
    """``no_space(name)``: what is written to a file of this name finds the disk full."""

    def full(name: str) -> None:
        import builtins

        real = builtins.open

        def opened(path, mode="r", *args, **kwargs):
            handle = real(path, mode, *args, **kwargs)
            if Path(path).name == name and mode != "r":
                handle.close()
                handle = real("/dev/full", "r+b", buffering=0)
            return handle

        monkeypatch.setattr(builtins, "open", opened)

    return full


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_rows_are_not_written_through_a_memory_map(tmp_path, no_space):
    """A full disk would end the process with SIGBUS."""
    import torch

    writer = RowWriter(tmp_path / ".rows", 3, {"x": ("<f4", (2,))})
    no_space("x")
    with pytest.raises(OSError, match=r"No space left on device: '.*\.rows/x'"):
        writer.write(torch.arange(3), {"x": torch.ones(3, 2)})


def test_the_manifest_is_named(tmp_path, monkeypatch):
    shards = Shards(tmp_path, "key", 10, 10)

    def full(handle, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match=rf"No space left on device: '.*{MANIFEST}'"):
        shards.write(0, random_reconstruction(10))


@pytest.mark.parametrize("written", [0, 2])
def test_training_without_tensorboard(train_command, tmp_path, monkeypatch, written):
    """It goes on; only where not even a file of events can be begun, it does not begin either."""
    original, calls = RecordWriter.write, []

    def full(self, data):
        calls.append(data)
        if len(calls) > written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        original(self, data)

    monkeypatch.setattr(RecordWriter, "write", full)
    status, _, said = train_command()
    if written:
        assert status == 0, said
        assert said.count("TensorBoard logging fails") == 1
        assert read_checkpoint(tmp_path / "out" / "last.ckpt")["global_step"] == 5
    else:
        assert status == 1
        assert said.splitlines() == [
            f"error: [Errno 28] No space left on device: '{tmp_path / 'out'}'"
        ]
