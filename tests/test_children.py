"""A forked child is like Python started with the same words."""

import os
import signal

import pytest

import children
import memory

SAY = "import os, sys; print(sys.argv[1:], os.getcwd(), os.environ['SAID']); sys.exit(3)"
WAIT = "import time; print('begun', flush=True); time.sleep(3600)"
FORK = "import os, time; print(os.fork(), flush=True); time.sleep(3600)"


@pytest.mark.parametrize("is_forked", [True, False])
def test_a_child_has_its_words_folder_environment_streams_and_status(tmp_path, is_forked):
    ended = children.run("-c", SAY, "a", 1, env={"SAID": "b"}, cwd=tmp_path, is_forked=is_forked)
    assert ended == children.Ended(3, f"['a', '1'] {tmp_path} b\n", "")


def test_an_error_has_its_trace():
    ended = children.run("-c", "raise KeyError('lost')")
    assert ended.status == 1
    assert ended.errors.endswith("KeyError: 'lost'\n")


@pytest.mark.posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_reaches_a_child_alone(number):
    child = children.start("-c", WAIT)
    other = children.start("-c", WAIT)
    assert [each.stdout.readline() for each in (child, other)] == ["begun\n", "begun\n"]
    child.send_signal(number)
    assert child.wait(children.LIMIT) == -number
    assert other.poll() is None


@pytest.mark.skipif(not memory.STATUS.is_file(), reason="needs Linux's /proc")
def test_what_a_child_has_started_ends_with_the_test():
    child = children.start("-c", FORK)
    own = int(child.stdout.readline())
    children.close_all()
    children.wait_until(lambda: not os.path.exists(f"/proc/{own}"))
    assert not os.path.exists(f"/proc/{own}")
