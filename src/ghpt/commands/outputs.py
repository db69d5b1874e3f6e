"""A command's output folder: locked while the command runs, with a manifest of what ghpt wrote
there.

A file is replaced or removed only if the manifest lists it, by name and digest. Anything else is
somebody's work, and an error names it before anything is computed.
"""

import hashlib
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

from filelock import BaseFileLock
from hydra.experimental.callback import Callback

from ghpt.errors import GhptConfigError, GhptDataError, GhptError, one_line
from ghpt.files import acquire, digest, guard_folder, sweep_temporaries, write_json

STATE = ".ghpt"
"""The folder, within the output folder, of the manifest, the lock and the record of a finished run.
"""
_MANIFEST = "manifest.json"
_LOCK = "lock"
_FINISHED = "finished.json"
_VERSION = 1
_NOT_COMPARED = ("output", "overwrite", "progress_bar", "resume")
"""Settings that do not change a run's result."""
_INSIST = "Move it away, name another output, or insist with overwrite=true."


@dataclass(frozen=True, kw_only=True)
class OutputSettings:
    """The settings that every command has."""

    output: str
    """The output folder."""
    overwrite: bool = False
    """Whether what is there is replaced, whoever wrote it."""


@dataclass(frozen=True)
class Files:
    """What a command reads and writes, as its settings tell before it computes anything."""

    reads: tuple[Path, ...] = ()
    """Files and folders."""
    writes: tuple[str, ...] = ()
    """Names of files within the output folder."""
    keeps: tuple[str, ...] = ()
    """Those of ``writes`` that, once there, are replaced only on request, although ghpt wrote them.
    """
    growing: tuple[str, ...] = ()
    """Names of logs, and of folders of unfinished work: once ghpt made them they are its own,
    whatever they hold.
    """


class OutputFolder:
    """The output folder ``path``, as a context. Entering it creates, locks and checks the folder.

    Raises GhptDataError if another command writes there, if a file that is to be written is an
    input, or if it was not written by ghpt, or has been changed since (allowed by ``overwrite``).
    """

    def __init__(self, path: Path, files: Files, overwrite: bool = False) -> None:
        self.path = path
        self.files = files
        self.overwrite = overwrite
        self._digests: dict[str, list[str]] = {}
        """Of every file written: the last two, because a crash may leave either in place."""
        self._growing: set[str] = set()
        self._stats: dict[str, tuple[int, ...]] = {}
        self._lock: BaseFileLock | None = None
        self._stack = ExitStack()

    def __enter__(self) -> "OutputFolder":
        state = self.path / STATE
        created = not state.exists()
        state.mkdir(parents=True, exist_ok=True)
        self._lock = acquire(state / _LOCK, "another ghpt command writes here")
        try:
            self._read()
            self._check()
            self._growing.update(self.files.growing)
            self._write()
        except BaseException:
            self._release()
            if created:
                self._discard_state()
            raise
        sweep_temporaries(self.path)
        self._stack.enter_context(guard_folder(self.path, self))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()
        self._release()

    def before_replace(self, path: Path, new: Path) -> None:
        """Record the digest that ``path`` is about to get. Raises GhptDataError if it is not
        ghpt's.
        """
        name = self._name(path)
        if self._is_work(name):
            return
        if path.exists() and not self.overwrite and not self._owns(name):
            raise _foreign(path)
        self._digests[name] = [*self._digests.get(name, [])[-1:], digest(new)]
        self._stats[name] = _signature(new)
        self._write()

    def before_remove(self, path: Path) -> None:
        """Raises GhptDataError unless ghpt wrote ``path``."""
        name = self._name(path)
        if not self._is_work(name) and not self.overwrite and not self._owns(name):
            raise _foreign(path)

    def adopt(self, path: Path) -> None:
        """Take ``path``, which has proved that ghpt wrote it, into the manifest."""
        name = self._name(path)
        if path.is_file() and not self._owns(name):
            self._digests[name] = [digest(path)]
            self._stats[name] = _signature(path)
            self._write()

    def read_summary(self, settings: Mapping[str, Any]) -> str | None:
        """Return what a finished run with these settings and inputs said; None without one."""
        try:
            record = json.loads((self.path / STATE / _FINISHED).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(record, dict) or record.get("run") != self._run(settings):
            return None
        names = record.get("files")
        if not isinstance(names, list) or not all(self._owns(str(name)) for name in names):
            return None
        return str(record.get("said"))

    def finish(self, settings: Mapping[str, Any], said: str) -> None:
        """Note that the run with these settings has finished, and what it ``said``."""
        there = [name for name in self._digests if (self.path / name).is_file()]
        record = {"version": _VERSION, "run": self._run(settings), "files": there, "said": said}
        write_json(self.path / STATE / _FINISHED, record)

    def _run(self, settings: Mapping[str, Any]) -> str:
        """A digest of the settings that matter and of the inputs as they are now."""
        compared = {key: value for key, value in settings.items() if key not in _NOT_COMPARED}
        content = json.dumps([compared, stamp(self.files.reads)], sort_keys=True, default=str)
        return hashlib.sha256(content.encode()).hexdigest()

    def _check(self) -> None:
        inputs = {path.resolve() for path in self.files.reads}
        for name in self.files.writes:
            path = self.path / name
            if path.resolve() in inputs or _is_linked(path, self.files.reads):
                raise GhptDataError(path, "", "is an input of this command", "Name another output.")
            if not path.exists() or self._is_work(name):
                continue
            if path.parent.resolve() in inputs and not self._owns(name):
                problem = "lies in a folder that this command reads, and would be replaced"
                raise GhptDataError(path, "", problem, "Name another output.")
            if self.overwrite:
                continue
            if not self._owns(name):
                raise _foreign(path)
            if name in self.files.keeps:
                hint = (
                    "Go on with resume=true, start anew with overwrite=true, "
                    "or name another output."
                )
                raise GhptDataError(path, "", "is there from an earlier run", hint)
        for name in self.files.growing:
            if (self.path / name).exists() and name not in self._growing and not self.overwrite:
                raise _foreign(self.path / name)

    def _owns(self, name: str) -> bool:
        """Whether the file is there with a content that ghpt wrote."""
        path = self.path / name
        known = self._digests.get(name)
        if not known or not path.is_file():
            return False
        signature = _signature(path)
        if self._stats.get(name) == signature:
            return True
        if digest(path) not in known:
            return False
        self._stats[name] = signature
        return True

    def _is_work(self, name: str) -> bool:
        folders = name.split("/")
        return STATE in folders or name in self._growing or folders[0] in self._growing

    def _name(self, path: Path) -> str:
        resolved = path.parent.resolve() / path.name
        return resolved.relative_to(self.path.resolve()).as_posix()

    def _read(self) -> None:
        """The manifest; one that is damaged lists nothing, so that nothing is replaced."""
        try:
            content = json.loads((self.path / STATE / _MANIFEST).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return
        if not isinstance(content, dict) or content.get("version") != _VERSION:
            return
        files = content.get("files")
        growing = content.get("growing")
        if isinstance(files, dict):
            self._digests = {n: d for n, d in files.items() if isinstance(d, list)}
        if isinstance(growing, list):
            self._growing = {name for name in growing if isinstance(name, str)}

    def _write(self) -> None:
        content = {
            "version": _VERSION,
            "files": self._digests,
            "growing": sorted(self._growing),
        }
        write_json(self.path / STATE / _MANIFEST, content)

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def _discard_state(self) -> None:
        """Leave nothing in a folder that is not to be written into."""
        for name in (_MANIFEST, _LOCK):
            with suppress(OSError):
                (self.path / STATE / name).unlink()
        with suppress(OSError):
            (self.path / STATE).rmdir()


class SweepFolder(Callback):
    """Hydra's callback that takes a sweep's folder before Hydra writes into it."""

    _taken: ClassVar[list[OutputFolder]] = []

    def on_multirun_start(self, config: Any, **_: Any) -> None:
        """Lock and guard the folder, or end the program: Hydra drops a callback's other errors."""
        files = Files(growing=("multirun.yaml", ".submitit"))
        folder = OutputFolder(Path(config.hydra.sweep.dir), files, bool(config.get("overwrite")))
        try:
            folder.__enter__()
        except (GhptError, OSError) as error:
            sys.exit(f"error: {one_line(error)}")
        self._taken.append(folder)

    @classmethod
    @contextmanager
    def release_after(cls) -> Iterator[None]:
        """After the block, the sweep's folder is free for others."""
        try:
            yield
        finally:
            while cls._taken:
                cls._taken.pop().__exit__(None, None, None)


def input_paths(*named: str | None) -> tuple[Path, ...]:
    """Return the files and folders that settings name as inputs; None names nothing."""
    paths = [Path(value).expanduser() for value in named if value]
    for folder in tuple(paths):
        if folder.is_dir():
            # A folder of cameras may be the output of an earlier calibration: these files are read.
            paths += [folder / name for name in ("intri.yml", "extri.yml")]
    return tuple(paths)


def check_apart(keypoints: str | None, output: str) -> None:
    """Raise GhptConfigError if the output folder is the folder of key points itself."""
    if not keypoints or not output or not Path(keypoints).is_dir():
        return
    if Path(output).resolve() == Path(keypoints).resolve():
        problem = f"is {output}, the folder that the key points are read from"
        raise GhptConfigError("output", problem, "Name another folder.")


def stamp(paths: Iterable[Path]) -> str:
    """A digest of the names, sizes and times of change of files, and of all files in folders."""
    state = hashlib.sha256()
    for path in paths:
        for file in sorted(_files_of(path)):
            try:
                about = file.stat()
            except OSError:
                continue
            entry = (str(file.relative_to(path.parent)), about.st_size, about.st_mtime_ns)
            state.update(repr(entry).encode())
    return state.hexdigest()


def _files_of(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return [Path(folder) / name for folder, _, names in os.walk(path) for name in names]


def _is_linked(path: Path, inputs: Iterable[Path]) -> bool:
    """Whether ``path`` is one of the inputs under another name."""
    if not path.is_file():
        return False
    return any(other.is_file() and path.samefile(other) for other in inputs)


def _signature(path: Path) -> tuple[int, ...]:
    """What changes when a file is written to, at the price of a look."""
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns


def _foreign(path: Path) -> GhptDataError:
    return GhptDataError(path, "", "was not written by ghpt, or has been changed since", _INSIST)
