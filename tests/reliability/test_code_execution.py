"""A5: nothing that a data file holds is ever run.

Each payload creates a sentinel file if it runs, in whatever way; an audit hook notes every attempt
to reach the system while the file is read.
"""

import codecs
import copyreg
import io
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import real_layout as layout
from auditing import watch
from ghpt.data.datasets.labels import read_labels
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.validate import read_npy, read_npz
from ghpt.errors import GhptDataError

WATCHED = (
    "exec",
    "import",
    "subprocess.",
    "socket.",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "os.remove",
    "os.rename",
    "ctypes.",
    "shutil.",
    "pickle.find_class",
)


class Call:
    """Pickles as a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any, state: Any = None) -> None:
        self.reduced = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


class Registered:
    """Pickled by way of copyreg."""


def raw(text: str, module: str, name: str) -> bytes:
    """A hand-written pickle of protocol 0 that calls ``module.name(text)``."""
    return f"c{module}\n{name}\n(V{text}\ntR.".encode()


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def payloads(sentinel: Path) -> dict[str, bytes]:
    """Pickles whose plain loading runs a command that creates ``sentinel``."""
    import os

    shell = f"touch {sentinel}"
    python = f"open({str(sentinel)!r}, 'w').close()"
    registered = Registered()
    copyreg.pickle(Registered, lambda _: (os.system, (shell,)))
    good = layout.human36m_labels([("S1", "Greeting-1", np.zeros((1, 17, 3)))])
    array = np.zeros(3).__reduce__()
    objects: dict[str, tuple[Any, int]] = {
        **{f"os.system, protocol {p}": (Call(os.system, shell), p) for p in range(6)},
        "builtins.eval": (Call(eval, f"__import__('pathlib').Path({str(sentinel)!r}).touch()"), 4),
        "builtins.exec": (Call(exec, python), 4),
        "nested in the dict": (good | {"cameras": Call(os.system, shell)}, 4),
        "in a list of names": (good | {"subject_names": ["S1", Call(os.system, shell)]}, 4),
        "as a key": ({**good, (Call(os.system, shell),): 1}, 4),
        "in an object array": (good | {"table": np.array([Call(os.system, shell)], object)}, 4),
        "copyreg": (registered, 2),
        "partial": (Call(partial(os.system, shell)), 4),
        "state of an array": (Call(array[0], *array[1], state=Call(os.system, shell)), 4),
        "metadata of a dtype": (np.dtype("f4", metadata={"x": Call(os.system, shell)}), 4),
        "getattr chain": (Call(getattr, Call(__import__, "os"), "system"), 4),
        "codecs of code": (Call(codecs.decode, b"x", "unicode_escape"), 4),
    }
    written = {
        "numpy f2py": raw(f"os.system('{shell}')", "numpy.f2py.crackfortran", "getlincoef"),
        "numpy runstring": raw(python, "numpy.testing._private.utils", "runstring"),
        "numpy.load": raw(str(sentinel), "numpy", "load"),
        "posix.system": raw(shell, "posix", "system"),
        "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x10dtype.__class__.x\x93.",
        "numpy.dtype's module": b"\x80\x04\x8c\x05numpy\x8c\x12dtype.__init__.x.y\x93.",
        "INST": f"(S'{shell}'\nios\nsystem\n.".encode(),
        "OBJ": b"(cos\nsystem\n" + f"S'{shell}'\no.".encode(),
        "NEWOBJ": b"\x80\x02cnumpy\nndarray\n(K\x01t\x81.",
        "persistent id": b"P" + shell.encode() + b"\n.",
        "extension code": b"\x80\x02\x82\x01.",
        "attributes of a stand-in": b"\x80\x02cnumpy\ndtype\nN}X\x08\x00\x00\x00"
        b"__code__K\x01s\x86b.",
        "global by memo": b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94h\x00h\x01\x93"
        + text(shell)
        + b"\x85R.",
    }
    dumped = {}
    for name, (value, protocol) in objects.items():
        buffer = io.BytesIO()
        box = np.empty((), object)
        box[()] = value
        pickle.dump(
            box if "array" not in name or name == "in an object array" else value, buffer, protocol
        )
        dumped[name] = buffer.getvalue()
    return dumped | written


def test_labels_run_nothing(tmp_path: Path, record_row: Callable[..., None]) -> None:
    sentinel, file = tmp_path / "sentinel", tmp_path / "labels.npy"
    layout.write_pickle(file, {})
    header = file.read_bytes()[:128]
    codecs.lookup(
        "raw_unicode_escape"
    )  # what Python imports at the first use is not the payload's doing
    with pytest.raises(GhptDataError):
        read_labels(file)
    assert header.endswith(b"\n")
    refused, cases = [], payloads(sentinel)
    for name, pickled in cases.items():
        file.write_bytes(header + pickled)
        with (
            watch(WATCHED) as valid,
            pytest.raises(GhptDataError, match=r"is not a labels file|is missing") as caught,
        ):
            read_labels(file)
        if not sentinel.exists() and not valid and str(file) in str(caught.value):
            refused.append(name)
        else:
            print(name, valid)
    record_row(
        "A5",
        f"labels: {len(cases)} payloads, none run, all refused by GhptDataError",
        len(refused),
        len(cases),
    )
    assert refused == list(cases)


def test_a_pickled_camera_runs_nothing(tmp_path: Path, record_row: Callable[..., None]) -> None:
    sentinel, file = tmp_path / "sentinel", tmp_path / "camera.pickle"
    codecs.lookup("raw_unicode_escape")
    refused, cases = [], payloads(sentinel)
    for name, pickled in cases.items():
        file.write_bytes(pickled)
        with watch(WATCHED) as valid, pytest.raises(GhptDataError) as caught:
            read_cameras(file)
        if not sentinel.exists() and not valid and str(file) in str(caught.value):
            refused.append(name)
    record_row("A5", "pickled cameras: none run, all refused", len(refused), len(cases))
    assert refused == list(cases)


def test_the_payloads_do_run_when_they_are_let(tmp_path: Path) -> None:
    """The test above would pass with payloads that do nothing."""
    sentinel = tmp_path / "sentinel"
    ran = []
    for name, pickled in payloads(sentinel).items():
        try:
            with watch(WATCHED) as valid:
                pickle.loads(pickled)
        except Exception:
            pass
        if sentinel.exists() or any(
            not attempt.startswith("pickle.find_class") for attempt in valid
        ):
            ran.append(name)
        sentinel.unlink(missing_ok=True)
    print("ran:", ran)
    assert len(ran) >= 15


@pytest.mark.parametrize("name", ["preds.npy", "keypoints.npz"])
def test_arrays_of_objects_run_nothing(
    tmp_path: Path, name: str, record_row: Callable[..., None]
) -> None:
    import os

    sentinel, file = tmp_path / "sentinel", tmp_path / name
    array = np.array([Call(os.system, f"touch {sentinel}")], object)
    np.savez(file, x=array) if name.endswith("z") else np.save(file, array, allow_pickle=True)
    read = (
        partial(read_npz, file, {"x": ((None,), "f")})
        if name.endswith("z")
        else partial(read_npy, file, (None,), "f")
    )
    with pytest.raises(GhptDataError):
        read()  # what Python imports at the first use is not the file's doing
    with watch(WATCHED) as valid, pytest.raises(GhptDataError, match="Python objects"):
        read()
    assert not sentinel.exists()
    assert not valid
    record_row("A5", f"{name} of objects: nothing run, refused by GhptDataError", 1, 1)
