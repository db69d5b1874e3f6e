"""Every output is written through here: to a temporary name in the same folder, checked, then moved.

A reader therefore never sees half a file, and a crash at any instant leaves the previous file as it
was. Within the output folder of a command, `ghpt.outputs` guards what may be replaced or removed.
"""

import hashlib
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
"""What this machine's writers call their files; another machine's, on a shared disk, may be alive."""
_ABANDONED = 24 * 3600.0
"""Seconds after which a temporary file counts as abandoned where processes cannot be asked for."""


@runtime_checkable
class Guard(Protocol):
    """Decides what may happen to the files of a folder; see `ghpt.outputs.OutputFolder`."""

    def before_replace(self, path: Path, new: Path) -> None:
        """``new`` is about to take the place of ``path``. Raises GhptDataError if it must not."""

    def before_remove(self, path: Path) -> None:
        """``path`` exists and is about to be removed. Raises GhptDataError if it must not be."""


_guards: dict[Path, Guard] = {}


@contextmanager
def guarded(folder: Path, guard: Guard) -> Iterator[None]:
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


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


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
def atomic_write(path: str | Path, mode: str = "wb", verify: Callable[[Path], Any] | None = None) -> Iterator[IO[Any]]:
    """Yield a file open for writing that takes ``path``'s place when the block ends without an error.

    ``verify`` gets the finished temporary file and raises if it is not right. On any failure (the block's,
    the disk's, the check's) the temporary file is removed, ``path`` is untouched and the error is passed on.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    try:
        with open(temporary, mode, **({} if "b" in mode else {"encoding": "utf-8", "newline": "\n"})) as handle:
            yield handle
            handle.flush()
            os.fsync(handle.fileno())
        if verify is not None:
            verify(temporary)
        guard = _guard_of(path)
        if guard is not None:
            guard.before_replace(path, temporary)
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    _sync_folder(path.parent)


def remove(path: str | Path) -> None:
    """Remove a file that ghpt wrote, if it is there. Raises GhptDataError if its folder's guard objects."""
    path = Path(path)
    if not path.exists():
        return
    guard = _guard_of(path)
    if guard is not None:
        guard.before_remove(path)
    path.unlink(missing_ok=True)


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
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                with open(file, "rb+") as handle:  # Windows syncs only what is open for writing
                    os.fsync(handle.fileno())
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


def sweep_temporaries(folder: str | Path) -> list[Path]:
    """Remove what writers that died have left in ``folder`` (not below it); returns what was removed."""
    swept = []
    for path in Path(folder).iterdir() if Path(folder).is_dir() else ():
        match = _TEMPORARY.match(path.name)
        if match and _abandoned(path, int(match["pid"])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            swept.append(path)
    return swept


def _abandoned(path: Path, pid: int) -> bool:
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
            mend = "Wait for it, or name another output."
            raise GhptDataError(path.parent, "", problem, mend) from None
        return lock
    raise GhptDataError(path.parent, "", "cannot be locked on this file system", "Name another output.")
