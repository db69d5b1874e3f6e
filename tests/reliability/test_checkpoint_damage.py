"""A2, A3 and B6: a damaged checkpoint is seen before it is read, and the one before it is there to
go on from.
"""

import copy
import importlib
import io
import json
import logging
import os
import random
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sizes
import toys
from ghpt import files
from ghpt.commands.resume import Start, resumable
from ghpt.config import build
from ghpt.errors import GhptCheckpointError
from ghpt.models import checkpoint as module_of_checkpoints
from ghpt.models.checkpoint import (
    FIELD,
    FORMAT_VERSION,
    AtomicCheckpointIO,
    load_model,
    read_checkpoint,
)
from signing import save_signed, signed
from toys import train

CONF = Path(__file__).resolve().parents[2] / "conf"
LAST, PREVIOUS = "last.ckpt", "previous.ckpt"


def settings(**changes: Any) -> dict[str, Any]:
    """Two epochs of five steps, a save after each."""
    config = copy.deepcopy(toys.TRAIN) | {"save_every": 1} | changes
    config["data"]["train_samples"] = 70
    return config


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished training."""
    folder = tmp_path_factory.mktemp("trained")
    train(settings(), folder)
    return folder


@pytest.fixture(scope="module")
def seventh(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """The folder of a training that ended after its seventh step, and what its files held."""
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.MonkeyPatch.context() as patch:
        stop_after(patch, 7)
        with pytest.raises(Stopped):
            train(settings(), folder)
    return folder, {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def stopped(seventh: tuple[Path, dict[str, bytes]]) -> Path:
    """That folder, as it was. (Lightning wants a run to be gone on with where it was.)"""
    folder, held = seventh
    shutil.rmtree(folder)
    folder.mkdir()
    for name, data in held.items():
        (folder / name).write_bytes(data)
    return folder


class Stopped(Exception):
    pass


def stop_after(patch: pytest.MonkeyPatch, step: int) -> None:
    """Have the next training end at once when it has saved this step."""
    save = AtomicCheckpointIO.save_checkpoint

    def saved(
        self: Any, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        save(self, checkpoint, path, storage_options)
        if checkpoint["global_step"] == step:
            raise Stopped

    patch.setattr(AtomicCheckpointIO, "save_checkpoint", saved)


def flipped(whole: bytes, bit: int) -> bytes:
    data = bytearray(whole)
    data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def test_a2_no_flipped_bit_is_read(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch, record_row: Callable[..., None]
) -> None:
    """Bits all over the file, and many of its end; nothing is unpickled."""
    whole, path = (trained / LAST).read_bytes(), tmp_path / LAST
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("it was unpickled"))
    bits = random.Random(0).sample(range(8 * len(whole)), sizes.FLIPPED_BITS)
    bits += range(8 * (len(whole) - 100), 8 * len(whole), 5)
    refused = 0
    for bit in bits:
        path.write_bytes(flipped(whole, bit))
        with pytest.raises(
            GhptCheckpointError, match=r"last\.ckpt: (cannot be read|has no digest)"
        ):
            read_checkpoint(path)
        refused += 1
    record_row(
        "A2",
        f"{len(bits)} flipped bits of a checkpoint: {len(bits) - refused} read",
        refused,
        len(bits),
    )


def test_a3_no_part_of_a_checkpoint_is_read(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch, record_row: Callable[..., None]
) -> None:
    whole, other = (trained / LAST).read_bytes(), (trained / PREVIOUS).read_bytes()
    path, half = tmp_path / LAST, len(whole) // 2
    spoilt = [
        whole[:size] for size in (*range(0, len(whole), 211), *range(len(whole) - 300, len(whole)))
    ]
    spoilt += [whole + b"\0", whole + whole, whole[1:], whole[half:] + whole[:half]]
    spoilt += [
        whole[:size] + other[size:]
        for size in (half, len(whole) // 3, len(whole) - 76, len(whole) - 200)
    ]
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("it was unpickled"))
    for data in spoilt:
        path.write_bytes(data)
        with pytest.raises(
            GhptCheckpointError, match=r"last\.ckpt: (cannot be read|has no digest)"
        ):
            read_checkpoint(path)
    record_row(
        "A3", f"{len(spoilt)} cut or joined checkpoints: none read", len(spoilt), len(spoilt)
    )


def test_torch_and_zip_read_a_checkpoint_too(trained: Path) -> None:
    plain = torch.load(trained / LAST, weights_only=True)
    ours = read_checkpoint(trained / LAST)
    assert plain.keys() == ours.keys()
    assert all(
        torch.equal(plain["state_dict"][name], value) for name, value in ours["state_dict"].items()
    )
    with zipfile.ZipFile(trained / LAST) as archive:
        assert archive.testzip() is None
        assert re.fullmatch(rb"ghpt sha256 [0-9a-f]{64}", archive.comment)


def test_a_checkpoint_of_the_first_version_says_how_to_go_on(tmp_path: Path, trained: Path) -> None:
    torch.save(torch.load(trained / LAST, weights_only=True), tmp_path / LAST)
    with pytest.raises(
        GhptCheckpointError, match=r"format version 1.*Train again, or use it with ghpt 0\.1\."
    ):
        load_model(tmp_path / LAST)


def test_a_save_is_read_back_before_it_replaces(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk gives back something else than was written."""
    path = tmp_path / LAST
    shutil.copy(trained / LAST, path)
    before = path.read_bytes()
    sync = os.fsync

    def spoiling(handle: int) -> None:
        sync(handle)
        if os.path.isfile(f"/proc/self/fd/{handle}"):
            os.pwrite(handle, b"spoilt", 3000)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs Linux to write behind the writer's back")
    monkeypatch.setattr(files.os, "fsync", spoiling)
    with pytest.raises(GhptCheckpointError, match="cannot be read"):
        AtomicCheckpointIO().save_checkpoint(
            read_checkpoint(path), path, {"previous": tmp_path / PREVIOUS}
        )
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [LAST]


def test_at_every_instant_of_a_save_there_are_two_good_checkpoints(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill would leave before and after each change of a name."""
    checkpoint = read_checkpoint(trained / LAST)
    path, options = tmp_path / LAST, {"previous": tmp_path / PREVIOUS}
    found: list[tuple[int, int]] = []

    def save(step: int) -> None:
        AtomicCheckpointIO().save_checkpoint(checkpoint | {"global_step": step}, path, options)

    def look() -> None:
        found.append(
            (
                read_checkpoint(path)["global_step"],
                read_checkpoint(options["previous"])["global_step"],
            )
        )

    def watched(change: Callable[..., None]) -> Callable[..., None]:
        def changed(*names: Any) -> None:
            look()
            change(*names)
            look()

        return changed

    save(1)
    assert os.listdir(tmp_path) == [LAST]
    save(2)
    for name in ("link", "replace"):
        monkeypatch.setattr(files.os, name, watched(getattr(os, name)))
    save(3)
    assert found == [(2, 1), (2, 1), (2, 1), (3, 1), (3, 1), (3, 2)]
    assert sorted(os.listdir(tmp_path)) == [LAST, PREVIOUS]


def test_without_hard_links_the_previous_one_is_a_copy(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unable(*names: Any) -> None:
        raise PermissionError("no hard links here")

    monkeypatch.setattr(files.os, "link", unable)
    checkpoint, path = read_checkpoint(trained / LAST), tmp_path / LAST
    for step in (1, 2):
        options = {"previous": tmp_path / PREVIOUS}
        AtomicCheckpointIO().save_checkpoint(checkpoint | {"global_step": step}, path, options)
    assert [read_checkpoint(tmp_path / name)["global_step"] for name in (LAST, PREVIOUS)] == [2, 1]
    assert sorted(os.listdir(tmp_path)) == [LAST, PREVIOUS]


def mutated(whole: bytes, chance: random.Random) -> bytes | None:
    """A checkpoint as disks and people spoil it; None is one that is gone."""
    kind = chance.choice(
        ("bit", "cut", "zeros", "empty", "text", "foreign", "no state", "version", "gone")
    )
    place = chance.randrange(len(whole))
    if kind == "bit":
        return flipped(whole, 8 * place)
    if kind == "cut":
        return whole[:place]
    if kind == "zeros":
        return whole[:place] + bytes(len(whole) - place)
    if kind == "text":
        return b"version https://git-lfs.github.com/spec/v1\n"
    if kind == "empty":
        return b""
    if kind == "gone":
        return None
    checkpoint = torch.load(io.BytesIO(whole), weights_only=True)
    if kind == "foreign":
        checkpoint = {"state_dict": checkpoint["state_dict"], "pytorch-lightning_version": "2.5.0"}
    elif kind == "no state":
        del checkpoint[
            chance.choice(("optimizer_states", "loops", "epoch", "global_step", "state_dict"))
        ]
    else:
        checkpoint[FIELD]["format_version"] = chance.choice(
            (1, FORMAT_VERSION + 1, "3", 2.5, None, True)
        )
    content = io.BytesIO()
    torch.save(checkpoint, content)
    return signed(content.getvalue())


def test_b6_the_previous_checkpoint_is_gone_on_from(
    stopped: Path, record_row: Callable[..., None]
) -> None:
    config = {key: settings()[key] for key in ("model", "data", "seed")}
    model = build(toys.MODEL, "model")
    path, chance, passed = stopped / LAST, random.Random(0), 0
    whole = path.read_bytes()
    assert resumable(stopped, config, model) == Start(path)
    for _ in range(sizes.DAMAGED_CHECKPOINTS):
        data = mutated(whole, chance)
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        start = resumable(stopped, config, model)
        assert start.checkpoint.name == PREVIOUS
        assert re.search(
            r"last\.ckpt: .+\. Going on from previous\.ckpt, which holds training step 6\.$",
            start.warning,
        ), start.warning
        passed += 1
    figure = f"{passed} damaged last checkpoints: each refused, the previous one taken"
    record_row("B6", figure, passed, sizes.DAMAGED_CHECKPOINTS)


@pytest.mark.parametrize("damage", ["bit", "empty", "gone"])
def test_b6_a_run_with_a_damaged_checkpoint_ends_with_the_same_numbers(
    trained: Path, stopped: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    path = stopped / LAST
    whole = path.read_bytes()
    path.unlink()
    if damage != "gone":
        path.write_bytes(flipped(whole, 80_000) if damage == "bit" else b"")
    with caplog.at_level(logging.WARNING, "ghpt.commands.train"):
        train(settings(resume=True), stopped)
    said = [message for message in caplog.messages if PREVIOUS in message]
    assert len(said) == 1
    assert said[0].endswith("Going on from previous.ckpt, which holds training step 6.")
    expected, found = read_checkpoint(trained / LAST), read_checkpoint(path)
    assert found["global_step"] == expected["global_step"] == 10
    assert all(
        torch.equal(found["state_dict"][name], value)
        for name, value in expected["state_dict"].items()
    )


def test_b6_a_damaged_checkpoint_does_not_become_the_previous_one(
    stopped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (stopped / LAST).write_bytes(b"damaged")
    stop_after(monkeypatch, 7)
    with pytest.raises(Stopped):
        train(settings(resume=True), stopped)
    assert [read_checkpoint(stopped / name)["global_step"] for name in (LAST, PREVIOUS)] == [7, 6]


def test_b6_without_a_good_one_there_is_no_silent_start(stopped: Path) -> None:
    for name in (LAST, PREVIOUS):
        (stopped / name).write_bytes(b"damaged")
    before = {path: path.read_bytes() for path in stopped.iterdir()}
    with pytest.raises(
        GhptCheckpointError,
        match=r"last\.ckpt: cannot.*; previous\.ckpt: cannot.*without resume=true",
    ):
        train(settings(resume=True), stopped)
    assert {path: path.read_bytes() for path in stopped.iterdir()} == before


def test_b6_the_previous_one_is_of_the_same_settings_too(stopped: Path) -> None:
    (stopped / LAST).unlink()
    config = settings(resume=True)
    config["model"]["temperature"] = 2.0
    with pytest.raises(
        GhptCheckpointError, match=r"previous\.ckpt: was made with other settings of 'model'"
    ):
        train(config, stopped)


Bad = Callable[[Path, bytes], Any]
"""Puts a bad checkpoint at the path; given a good one."""


def changed(change: Callable[[dict[str, Any]], Any]) -> Bad:
    def write(path: Path, whole: bytes) -> None:
        checkpoint = torch.load(io.BytesIO(whole), weights_only=True)
        change(checkpoint)
        save_signed(checkpoint, path)

    return write


def weight(change: Callable[[torch.Tensor], Any]) -> Bad:
    def replace(checkpoint: dict[str, Any]) -> None:
        weights = checkpoint["state_dict"]
        name = next(name for name in weights if name.endswith("0.weight"))
        weights[name] = change(weights[name])

    return changed(replace)


def ours(name: str, value: Any) -> Bad:
    return changed(lambda c: c[FIELD].update({name: value}))


def model(value: Any) -> Bad:
    return ours("config", {"model": value})


def saved(value: Any) -> Bad:
    return lambda path, whole: save_signed(value, path)


def written(data: bytes) -> Bad:
    return lambda path, whole: path.write_bytes(data)


def other_zip(path: Path, whole: bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")


def safetensors(path: Path, whole: bytes) -> None:
    header = json.dumps({"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))


def npz(path: Path, whole: bytes) -> None:
    with open(path, "wb") as handle:
        np.savez(handle, x=np.zeros(3))


BAD: dict[str, Bad] = {
    "missing": lambda path, whole: None,
    "a folder": lambda path, whole: path.mkdir(),
    "empty": written(b""),
    "one byte": written(b"P"),
    "text": written(b"not a checkpoint\n" * 100),
    "text, signed": written(signed(b"not a checkpoint\n")),
    "nothing, signed": written(signed(b"")),
    "of git lfs": written(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"),
    "HTML": written(b"<!DOCTYPE html><title>404</title>"),
    "cut": lambda path, whole: path.write_bytes(whole[: len(whole) // 2]),
    "another zip": other_zip,
    "a safetensors file": safetensors,
    "npz": npz,
    "pickle": written(b"\x80\x04]\x94."),
    "a tensor": saved(torch.zeros(3)),
    "a list": saved([1, 2]),
    "a number": saved(3),
    "null": saved(None),
    "weights alone": saved({"x": torch.zeros(3)}),
    "of another Lightning module": saved(
        {"state_dict": {"x": torch.zeros(3)}, "epoch": 1, "global_step": 5}
    ),
    "no state_dict": changed(lambda c: c.pop("state_dict")),
    "no ghpt": changed(lambda c: c.pop(FIELD)),
    "ghpt is a list": changed(lambda c: c.update({FIELD: [1]})),
    "state_dict is a list": changed(lambda c: c.update(state_dict=[torch.zeros(1)])),
    "state_dict of text": changed(
        lambda c: c.update(state_dict=dict.fromkeys(c["state_dict"], "x"))
    ),
    "state_dict by number": changed(lambda c: c.update(state_dict={1: torch.zeros(1)})),
    "a weight too few": changed(lambda c: c["state_dict"].popitem()),
    "a weight too many": changed(lambda c: c["state_dict"].update(more=torch.zeros(1))),
    "a weight of another shape": weight(lambda w: w[:-1]),
    "a weight without a shape": weight(lambda w: torch.tensor(0.0)),
    "a weight in double": weight(torch.Tensor.double),
    "a weight of integers": weight(torch.Tensor.long),
    "a complex weight": weight(lambda w: w.to(torch.complex64)),
    "a sparse weight": weight(torch.Tensor.to_sparse),
    "a weight without numbers": weight(lambda w: w.to("meta")),
    "a weight that is NaN": weight(lambda w: w * torch.nan),
    "a weight that is inf": weight(lambda w: w + torch.inf),
    "version 1": ours("format_version", 1),
    "version 99": ours("format_version", 99),
    "version is text": ours("format_version", "2"),
    "version is true": ours("format_version", True),
    "version is 2.0": ours("format_version", 2.0),
    "version is a tensor": ours("format_version", torch.tensor(2)),
    "no version": changed(lambda c: c[FIELD].pop("format_version")),
    "no config": changed(lambda c: c[FIELD].pop("config")),
    "config is text": ours("config", "model"),
    "config without a model": ours("config", {}),
    "model is a list": model([]),
    "model is empty": model({}),
    "model is null": model(None),
    "model is only a scorer": model(toys.MODEL["scorer"]),
    "problem is text": model(toys.MODEL | {"problem": "pose"}),
    "no problem": model({k: v for k, v in toys.MODEL.items() if k != "problem"}),
    "an unknown setting": model(toys.MODEL | {"colour": 1}),
    "negative hypotheses": model(toys.MODEL | {"hypotheses": -1}),
    "no provenance": changed(lambda c: c[FIELD].pop("provenance")),
    "provenance is text": ours("provenance", "here"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_checkpoint_is_refused_in_one_line(tmp_path: Path, trained: Path, name: str) -> None:
    path = tmp_path / "bad.ckpt"
    BAD[name](path, (trained / LAST).read_bytes())
    with pytest.raises(GhptCheckpointError) as caught:
        load_model(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert said.isprintable()
    assert len(said) < 600 + len(str(path))


def test_a_checkpoint_that_may_not_be_read_is_refused(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(module_of_checkpoints, "open", refused, raising=False)
    with pytest.raises(
        GhptCheckpointError, match=r"last\.ckpt: cannot be read \(.*Permission denied\)"
    ):
        load_model(trained / LAST)


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, "last.ckpt/below"])
def test_a_path_that_cannot_be_is_refused(
    path: str, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(trained)
    with pytest.raises(GhptCheckpointError):
        load_model(path)


@pytest.mark.parametrize("command", ["test", "predict"])
@pytest.mark.parametrize("name", ["a list", "config is text", "a weight that is NaN"])
def test_a_command_ends_in_one_line(
    tmp_path: Path,
    trained: Path,
    typed: Callable[..., tuple[int, str, str]],
    command: str,
    name: str,
) -> None:
    path = tmp_path / "bad.ckpt"
    BAD[name](path, (trained / LAST).read_bytes())
    module = importlib.import_module(f"ghpt.commands.{command}")
    words = (f"ckpt={path}", f"output={tmp_path / 'out'}", "progress_bar=false")
    status, out, said = typed(CONF, module.COMMAND, words)
    assert (status, out) == (1, "")
    assert re.fullmatch(rf"error: {re.escape(str(path))}: .+\n", said)
