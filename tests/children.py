"""Child processes of the tests, forked from a server that has imported the large libraries once.

``python script.py`` pays 6 s of processor time for torch and Lightning; a fork of a process that
has imported them pays 0.05 s. ``start`` asks the server for such a fork, which has arguments,
environment, folder, streams and session of its own, and runs the script as the main program.
Where there is no server (other systems than Linux) it starts Python itself.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import random
import runpy
import select
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import quick
import sizes

ADDRESS = "GHPT_TEST_FORK_SERVER"
"""The environment variable that names the server's socket."""
RANKS = {"GHPT_TEST_FORK_RANKS": "1"}
"""What has the other processes of a run forked too, in place of Lightning starting Python."""
TESTS = Path(__file__).resolve().parent
LIMIT = 7200.0 if sizes.NIGHTLY else 300.0
"""Seconds after which a child counts as hanging, on however slow a machine."""
MODULES = (
    "ghpt.commands.calibrate",
    "ghpt.commands.cameras",
    "ghpt.commands.predict",
    "ghpt.commands.test",
    "ghpt.commands.train",
    "ghpt.export",
    "tensorboard.backend.event_processing.event_accumulator",
)
"""What the server imports, and with it nearly all that a child would."""


class Fork:
    """A process that the server has forked, with what Lightning needs of ``subprocess.Popen``.

    Its group is its own, or that of the process that asks for it; its streams are those given.
    """

    def __init__(
        self,
        words: Sequence[str],
        env: Mapping[str, str],
        cwd: str | Path | None,
        streams: Sequence[int] = (0, 1, 2),
        group: int = 0,
    ) -> None:
        self.returncode: int | None = None
        self._lock = threading.Lock()
        self._server = socket.socket(socket.AF_UNIX)
        self._server.connect(os.environ[ADDRESS])
        folder = str(cwd or Path.cwd())
        request = {"words": list(words), "env": dict(env), "cwd": folder, "group": group}
        content = json.dumps(request).encode()
        socket.send_fds(self._server, [len(content).to_bytes(8)], streams)
        self._server.sendall(content)
        self.pid = int.from_bytes(self._server.recv(8, socket.MSG_WAITALL))

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal, or None while the process runs."""
        with self._lock:  # Lightning asks in a thread too
            if self.returncode is None and select.select([self._server], [], [], 0)[0]:
                status = self._server.recv(8, socket.MSG_WAITALL)
                self.returncode = os.waitstatus_to_exitcode(int.from_bytes(status))
        return self.returncode

    def wait(self, timeout: float = LIMIT) -> int:
        """Return the exit status when the process has ended."""
        if self.returncode is None:
            select.select([self._server], [], [], timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired("child", timeout)
        return status

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill the process, if it still runs."""
        self.send_signal(signal.SIGKILL)


class Child(Fork):
    """A fork whose standard output is a pipe, its standard error a file, its standard input
    empty."""

    def __init__(self, words: Sequence[str], env: Mapping[str, str], cwd: Path) -> None:
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 (open as long as the child)
        reading, writing = os.pipe()
        self.stdout: IO[str] = open(reading, encoding="utf-8")  # noqa: SIM115
        with open(os.devnull, "rb") as nothing:
            super().__init__(words, env, cwd, (nothing.fileno(), writing, self._errors.fileno()))
        os.close(writing)
        _CHILDREN.append(self)

    def communicate(self, timeout: float = LIMIT) -> tuple[str, str]:
        """Return what the process has written to both streams, when it has ended."""
        end = time.monotonic() + timeout
        chunks = []
        while True:
            left = max(end - time.monotonic(), 0)
            if not select.select([self.stdout], [], [], left)[0]:
                raise subprocess.TimeoutExpired("child", timeout, "".join(chunks))
            chunk = os.read(self.stdout.fileno(), 65536).decode()
            if not chunk:
                break
            chunks.append(chunk)
        self.wait(timeout)
        self._errors.seek(0)
        errors = self._errors.read()
        self.stdout.close()
        self._errors.close()
        return "".join(chunks), errors

    def close(self) -> None:
        """Close the streams. The server kills what is left of the process and its children."""
        self._server.close()
        self.stdout.close()
        self._errors.close()


_CHILDREN: list[Child] = []


def close_all() -> None:
    """Close the children that this process has started so far."""
    while _CHILDREN:
        _CHILDREN.pop().close()


def start(
    *words: object,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    is_forked: bool = True,
) -> Child | subprocess.Popen[str]:
    """Start Python with these words: a script or ``-c`` and its text, and their arguments.

    ``env`` is added to the environment of the tests; scripts find the modules of ``tests/``. A
    child whose start is the point is not forked.
    """
    paths = [str(TESTS.parent / "src"), str(TESTS), os.environ.get("PYTHONPATH", "")]
    ours = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    environment = {**os.environ, "HYDRA_FULL_ERROR": "0", **ours, **(env or {})}
    texts = [str(word) for word in words]
    if is_forked and ADDRESS in os.environ:
        return Child(texts, environment, cwd or Path.cwd())
    return subprocess.Popen(
        [sys.executable, *texts],
        env=environment,
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@dataclass(frozen=True)
class Ended:
    """What came of a child."""

    status: int
    out: str
    errors: str


def run(
    *words: object,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    is_forked: bool = True,
) -> Ended:
    """Run Python with these words to its end; see ``start``."""
    child = start(*words, env=env, cwd=cwd, is_forked=is_forked)
    out, errors = child.communicate(timeout=LIMIT)
    return Ended(child.wait(), out, errors)


def output_of(
    *words: object,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    is_forked: bool = True,
) -> str:
    """Return what Python with these words prints; it must end with status 0."""
    ended = run(*words, env=env, cwd=cwd, is_forked=is_forked)
    assert ended.status == 0, ended.errors[-3000:]
    return ended.out


def wait_until(
    condition: Callable[[], bool], child: Child | subprocess.Popen[str] | None = None
) -> None:
    """Return when the condition holds, which must be before the child ends."""
    end = time.monotonic() + LIMIT
    while not condition():
        if child is not None and child.poll() is not None:
            _, errors = child.communicate()
            raise AssertionError(f"the child ended with status {child.wait()} before: {errors}")
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


class Server:
    """The process that the children are forks of. It imports when the first child is asked for."""

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="ghpt-forks-")
        address = Path(self.folder.name) / "socket"
        words = [sys.executable, __file__, str(address)]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        # its standard input is its life: it ends when this process has closed that, or is dead
        self.process = subprocess.Popen(
            words, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self.process.stdout is not None
        self.process.stdout.readline()
        os.environ[ADDRESS] = str(address)

    def close(self) -> None:
        """End the server and all its children."""
        del os.environ[ADDRESS]
        self.process.communicate()
        self.folder.cleanup()


@dataclass(frozen=True)
class Program:
    """What a child is to run."""

    words: list[str]
    env: dict[str, str]
    cwd: str
    group: int
    streams: list[int]

    def become(self) -> None:
        """Give this process the streams, session, environment and folder of the program."""
        os.setpgid(0, self.group)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number, stream in enumerate(self.streams):
            os.dup2(stream, number)
            os.close(stream)
        os.environ.clear()
        os.environ.update(self.env)
        os.chdir(self.cwd)
        time.tzset()
        tempfile.tempdir = None
        random.seed()
        paths = self.env.get("PYTHONPATH", "").split(os.pathsep)
        sys.path[:0] = [path for path in paths if path]

    def run(self) -> None:
        """Run the words as Python's command line."""
        import torch

        torch.set_num_threads(int(self.env.get("OMP_NUM_THREADS", "1")))
        if RANKS.items() <= self.env.items():
            fork_ranks()
        if self.words[0] == "-c":
            sys.argv[:] = ["-c", *self.words[2:]]
            exec(compile(self.words[1], "<string>", "exec"), {"__name__": "__main__"})
        else:
            sys.argv[:] = self.words
            sys.path.insert(0, os.path.dirname(os.path.abspath(self.words[0])))
            runpy.run_path(self.words[0], run_name="__main__")


def fork_ranks() -> None:
    """Have Lightning fork the other processes of a run."""
    from lightning.pytorch.strategies.launchers import subprocess_script

    def started(command: list[str], env: Mapping[str, str], cwd: str | None) -> Fork:
        return Fork(command[1:], env, cwd, group=os.getpgid(0))

    subprocess_script.subprocess = SimpleNamespace(Popen=started)


def import_modules() -> None:
    quick.make_quick()
    for module in MODULES:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()


def received(connection: socket.socket) -> Program:
    """Read a request."""
    length, streams, _, _ = socket.recv_fds(connection, 8, 3)
    content = connection.recv(int.from_bytes(length), socket.MSG_WAITALL)
    request = json.loads(content)
    return Program(**request, streams=streams)


def serve(address: str) -> Program | None:
    """Fork a child for each request. Returns its program in a child, and None at the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started this
    signal.signal(signal.SIGCHLD, lambda *_: None)
    woken, waking = os.pipe()
    os.set_blocking(woken, False)
    os.set_blocking(waking, False)
    signal.set_wakeup_fd(waking)
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(address)
    listening.listen()
    children: dict[int, socket.socket] = {}
    waiting = selectors.DefaultSelector()
    for source in (listening, woken, sys.stdin):
        waiting.register(source, selectors.EVENT_READ)
    print("listening", flush=True)
    os.dup2(2, 1)
    imported = False
    while True:
        for key, _ in waiting.select():
            if key.fileobj is sys.stdin:
                for pid in children:
                    end_group(pid)
                return None
            if key.fileobj == woken:
                with contextlib.suppress(BlockingIOError):
                    os.read(woken, 4096)
                tell_the_ended(children, waiting)
            elif key.fileobj is listening:
                if not imported:
                    import_modules()
                    imported = True
                connection, _ = listening.accept()
                program = received(connection)
                pid = os.fork()
                if pid == 0:
                    for other in (listening, connection, *children.values()):
                        other.close()
                    waiting.close()
                    os.close(woken)
                    program.become()
                    os.close(waking)
                    return program
                for stream in program.streams:
                    os.close(stream)
                connection.sendall(pid.to_bytes(8))
                children[pid] = connection
                waiting.register(connection, selectors.EVENT_READ, pid)
            elif key.data in children:  # nobody asks for it any more
                end_group(key.data)
                waiting.unregister(key.fileobj)
                children.pop(key.data).close()


def tell_the_ended(children: dict[int, socket.socket], waiting: selectors.BaseSelector) -> None:
    """Send the status of each child that has ended to who asked for it."""
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        if connection := children.get(pid):
            with contextlib.suppress(OSError):
                connection.sendall(status.to_bytes(8))


def end_group(pid: int) -> None:
    """Kill a child and all processes that it has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


if __name__ == "__main__":
    program = serve(sys.argv[1])
    if program is not None:
        program.run()
