"""What ends a command from outside: an interrupt (Ctrl-C), SIGTERM, or the end of its terminal
(SIGHUP).
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
"""Windows has no SIGHUP."""
_received: list[int] = []


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP. Whatever ends in order after an interrupt does so after these, too."""


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Within the block a signal stops the program where it is, and the block ends in SystemExit.

    The status is what shells expect: 130 after SIGINT, 143 after SIGTERM and SIGHUP. Files are
    written whole or not at all, so this may be anywhere. A second SIGINT or SIGTERM ends the
    process at once. A signal that the process was started to ignore (by `nohup`, or as a script's
    background job) stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():  # signals are not sent to others
        yield
        return
    previous = {number: signal.getsignal(number) for number in SIGNALS}
    if stop not in previous.values():
        _received.clear()
    for number, handler in previous.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield
    except BaseException as error:
        # Code that was interrupted may raise what it likes while it tidies up, as OmegaConf and
        # Lightning do.
        if _received:
            raise SystemExit(130 if _received[0] == signal.SIGINT else 143) from error
        raise
    finally:
        for number, handler in previous.items():
            if handler is not None:  # None is a handler that was not set by Python
                signal.signal(number, handler)


def stop(number: int, frame: FrameType | None) -> None:
    """The handler of the first signal."""
    _received.append(number)
    for later in SIGNALS:
        # A terminal that is closed may send SIGHUP more than once: that is no second wish.
        second = later in (signal.SIGINT, signal.SIGTERM)
        signal.signal(later, signal.SIG_DFL if second else signal.SIG_IGN)
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated


def give_back() -> None:
    """Take SIGTERM back from a library of C++ that handles it behind Python's back."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
