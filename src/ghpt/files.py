"""Every output is written through here: to a temporary name in the same folder, checked, then
moved.

A reader therefore never sees half a file, and a crash at any instant leaves the previous file as it
was. Within the output folder of a command, `ghpt.commands.outputs` guards what may be replaced or
removed.
"""

import errno
import hashlib
import itertools
import json
import math
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Protocol, runtime_checkable

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from ghpt.errors import GhptDataError

_WINDOWS = os.name == "nt"
_HOST = re.sub(r"[^\w-]", "_", platform.node())[:32] or "host"
_TEMPORARY = re.compile(rf"^\..+\.{_HOST}-(?P<pid>\d+)-[0-9a-f]{{8}}\.tmp$")
"""What this machine's writers call their files; another machine's, on a shared disk, may be alive.
"""
_ABANDONED = 24 * 3600.0
"""Seconds after which a temporary file counts as abandoned where processes cannot be asked for."""


@runtime_checkable
class Guard(Protocol):
    """Decides what may happen to a folder's files; see `ghpt.commands.outputs.OutputFolder`."""

    def before_replace(self, path: Path, new: Path) -> None:
        """``new`` is about to take the place of ``path``. Raises GhptDataError if it must not."""

    def before_remove(self, path: Path) -> None:
        """``path`` exists and is about to be removed. Raises GhptDataError if it must not be."""

    def adopt(self, path: Path) -> None:
        """``path`` has proved that ghpt wrote it."""


_guards: dict[Path, Guard] = {}


@contextmanager
def guard_folder(folder: Path, guard: Guard) -> Iterator[None]:
    """Within the block, ``guard`` is asked before a file in or below ``folder`` is touched."""
    key = folder.resolve()
    previous = _guards.get(key)
    _guards[key] = guard
    try:
        yield
    finally:
        if previous is None:
            del _guards[key]
        else:
            _guards[key] = previous


def _guard_of(path: Path) -> Guard | None:
    """The guard of the nearest folder above ``path`` that has one."""
    if not _guards:
        return None
    parents = (path.parent.resolve() / path.name).parents
    return next((_guards[folder] for folder in parents if folder in _guards), None)


_ZEROS = 1 << 20
"""Bytes that are written at a time where a disk cannot reserve them."""


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


@contextmanager
def errors_name(path: str | Path) -> Iterator[None]:
    """Have an OSError of the block that names no file name this one (the disk is full, say)."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def _sync_folder(folder: Path) -> None:
    if _WINDOWS:  # a folder cannot be opened there, and a rename is durable without it
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        error.filename = str(folder)
        raise


@contextmanager
def atomic_write(
    path: str | Path,
    mode: str = "wb",
    verify: Callable[[Path], Any] | None = None,
    previous: Path | None = None,
) -> Iterator[IO[Any]]:
    """Yield a file open for writing that takes ``path``'s place when the block ends without an
    error.

    ``verify`` gets the finished temporary file and raises if it is not right. On any failure (the
    block's, the disk's, the check's) the temporary file is removed, ``path`` is untouched and the
    error is passed on. ``previous``: what stood at ``path`` is kept under this name, in the same
    folder. A kill at any instant leaves two files, both whole and not the same.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    second = _temporary(path)
    try:
        with _open(temporary, mode) as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        if verify is not None:
            verify(temporary)
        kept = previous if path.exists() else None
        if kept is not None:
            _second_name(path, second)
        guard = _guard_of(path)
        if guard is not None:
            guard.before_replace(path, temporary)
            if kept is not None:
                guard.before_replace(kept, second)
        os.replace(temporary, path)
        if kept is not None:
            os.replace(second, kept)
    except BaseException as error:
        for leftover in (temporary, second):
            with suppress(OSError):
                leftover.unlink()
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    _sync_folder(path.parent)


def _open(path: Path, mode: str) -> IO[Any]:
    """Open a file; text is UTF-8 with the same line ends on every system."""
    if "b" in mode:
        return open(path, mode)
    return open(path, mode, encoding="utf-8", newline="\n")


def remove(path: str | Path) -> None:
    """Remove a file that ghpt wrote, if it is there. Raises GhptDataError if its folder's guard
    objects.
    """
    path = Path(path)
    if not path.exists():
        return
    guard = _guard_of(path)
    if guard is not None:
        guard.before_remove(path)
    path.unlink(missing_ok=True)


def adopt(path: Path) -> None:
    """Let a file be replaced that has proved, by a digest of its own, that ghpt wrote it."""
    guard = _guard_of(path)
    if guard is not None:
        guard.adopt(path)


def set_aside(path: Path) -> None:
    """Give a damaged file, if it is there, a name that is free, so that nothing of it is lost."""
    if not path.exists():
        return
    names = (path.with_name(f"{path.name}.damaged{number or ''}") for number in itertools.count())
    os.rename(path, next(name for name in names if not name.exists()))


def _second_name(path: Path, second: Path) -> None:
    """Give a file a second name; where the file system has no hard links, to a copy of it."""
    try:
        os.link(path, second)
    except OSError:
        shutil.copyfile(path, second)
        with open(second, "rb+") as handle:
            os.fsync(handle.fileno())


def write_json(path: str | Path, content: Any) -> None:
    """Write plain data as JSON, indented; a number that is not finite, for which JSON has no word,
    as null.
    """
    with atomic_write(path, "w") as handle:
        json.dump(finite(content), handle, indent=1, allow_nan=False)
        handle.write("\n")


def finite(content: Any) -> Any:
    """Plain data with None in place of every number that is not finite."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a new empty folder that becomes ``path`` when the block ends without an error.

    A ``path`` that exists by then is kept and the new folder dropped: others may be reading it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    temporary.mkdir()
    try:
        with errors_name(path):
            yield temporary
        for path_within in (temporary, *temporary.rglob("*")):
            if path_within.is_file():
                with open(
                    path_within, "rb+"
                ) as handle:  # Windows syncs only what is open for writing
                    os.fsync(handle.fileno())
            else:  # the names of its files
                _sync_folder(path_within)
        try:
            os.rename(temporary, path)
        except OSError:
            if not path.is_dir():
                raise
            shutil.rmtree(temporary)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _sync_folder(path.parent)


def allocate(handle: IO[bytes], size: int, name: str | Path) -> None:
    """Make an open file ``size`` bytes long, and take all of them from the disk at once.

    A file that is only declared to be long has holes; where the disk is full when a memory map
    fills one, SIGBUS ends the process without a word. Here that is an OSError which names ``name``.
    What the file holds stays, and new bytes are 0.
    """
    try:
        if not _reserve(handle, size):
            # Past the handle's buffer, which would try, and fail, once more when it is closed.
            missing = size - os.lseek(handle.fileno(), 0, os.SEEK_END)
            while missing > 0:
                missing -= os.write(handle.fileno(), bytes(min(_ZEROS, missing)))
        handle.truncate(size)
    except OSError as error:
        error.filename = str(name)
        raise


def _reserve(handle: IO[bytes], size: int) -> bool:
    """Whether the operating system takes the bytes itself; Windows, macOS and some disks do not."""
    if not hasattr(os, "posix_fallocate"):
        return False
    try:
        os.posix_fallocate(handle.fileno(), 0, size)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.EOPNOTSUPP):
            return False
        raise
    return True


def sweep_temporaries(folder: str | Path) -> list[Path]:
    """Remove what writers that died have left in ``folder`` (not below it); returns what was
    removed.
    """
    swept = []
    for path in Path(folder).iterdir() if Path(folder).is_dir() else ():
        match = _TEMPORARY.match(path.name)
        if match and _is_abandoned(path, int(match["pid"])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(
                missing_ok=True
            )
            swept.append(path)
    return swept


def _is_abandoned(path: Path, pid: int) -> bool:
    """Whether the process that was writing ``path`` is gone."""
    if _WINDOWS:  # os.kill(pid, 0) would send it Ctrl-C
        return time.time() - path.stat().st_mtime > _ABANDONED
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def digest(path: str | Path) -> str:
    """SHA-256 of a file's content, as hexadecimal digits."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def acquire(path: Path, problem: str) -> BaseFileLock:
    """Hold the lock file ``path`` until ``release()`` or the end of the process, however it ends.

    Does not wait. Raises GhptDataError with ``problem`` if another process, or another part of this
    one, holds it.
    """
    for kind in (FileLock, SoftFileLock):  # the latter where the file system knows no locks
        lock = kind(path, timeout=0, thread_local=False)
        try:
            lock.acquire()
        except NotImplementedError:
            continue
        except (Timeout, RuntimeError):  # RuntimeError: held by this very thread
            hint = "Wait for it, or name another output."
            raise GhptDataError(path.parent, "", problem, hint) from None
        return lock
    raise GhptDataError(
        path.parent, "", "cannot be locked on this file system", "Name another output."
    )
