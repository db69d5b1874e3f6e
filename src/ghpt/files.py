"""Every output is written through here: to a temporary name in the same folder, checked, then moved.

A reader therefore never sees half a file, and a crash at any instant leaves the previous file as it was.
"""

import os
import platform
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

_HOST = re.sub(r"[^\w-]", "_", platform.node())[:32] or "host"
_TEMPORARY = re.compile(rf"^\..+\.{_HOST}-(?P<pid>\d+)-[0-9a-f]{{8}}\.tmp$")
"""What this machine's writers call their files; another machine's, on a shared disk, may be alive."""


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


@contextmanager
def errors_name(path: str | Path) -> Iterator[None]:
    """Have an OSError of the block that names no file name this one, such as that the disk is full."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def _sync_folder(folder: Path) -> None:
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
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    _sync_folder(path.parent)


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
                with open(path_within, "rb") as handle:
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


def sweep_temporaries(folder: str | Path) -> list[Path]:
    """Remove what writers that died have left in ``folder`` (not below it); returns what was removed."""
    swept = []
    for path in Path(folder).iterdir() if Path(folder).is_dir() else ():
        match = _TEMPORARY.match(path.name)
        if match and not _alive(int(match["pid"])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            swept.append(path)
    return swept


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
