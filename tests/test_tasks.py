"""Tasks are computed once, in the order of their dependencies, on several processes, and kept
whatever happens.
"""

import os
import signal
from pathlib import Path

import pytest

import children
from ghpt.errors import GhptDataError
from ghpt.paper.engine.pool import perform_all
from ghpt.paper.engine.tasks import read_json, with_dependencies
from toy_tasks import task


@pytest.fixture
def diary(tmp_path):
    (tmp_path / "diary").touch()
    return tmp_path / "diary"


def numbers(diary):
    return [float(line.split()[0]) for line in diary.read_text().splitlines()]


def diamond(diary, first=1, last=4):
    """Two tasks that need the same one, and a last that needs both."""
    a = task(diary, first)
    b, c = task(diary, 2, a), task(diary, 3, a)
    return task(diary, last, b, c)


@pytest.mark.parametrize("jobs", [1, 2])
def test_each_task_is_done_once_after_what_it_needs(diary, tmp_path, jobs):
    last = diamond(diary)
    assert (
        perform_all([last, *last.dependencies.values()], tmp_path / "tasks", jobs, show=False) == 4
    )
    assert sorted(numbers(diary)) == [1, 2, 3, 4]
    assert numbers(diary)[0] == 1
    assert numbers(diary)[-1] == 4
    assert read_json(last.folder(tmp_path / "tasks") / "result.json") == 4 + (2 + 1) + (3 + 1)
    here = {int(line.split()[1]) for line in diary.read_text().splitlines()} == {os.getpid()}
    assert here == (jobs == 1)


def test_only_what_changed_is_done_again(diary, tmp_path):
    tasks = tmp_path / "tasks"
    perform_all([diamond(diary)], tasks, 1, show=False)
    assert perform_all([diamond(diary)], tasks, 1, show=False) == 0
    assert perform_all([diamond(diary, last=5)], tasks, 1, show=False) == 1
    assert perform_all([diamond(diary, first=7)], tasks, 1, show=False) == 4
    assert numbers(diary) == [1, 2, 3, 4, 5, 7, 2, 3, 4]


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_names_the_task_and_keeps_what_is_finished(diary, tmp_path, jobs):
    good = task(diary, 1)
    bad = task(diary, -1, good)  # after it: an error ends at once what is made beside it
    with pytest.raises(
        GhptDataError, match=r"^add--1: .*is negative. Give a positive one"
    ) as caught:
        perform_all([task(diary, 2, bad)], tmp_path / "tasks", jobs, show=False)
    assert caught.value.field == "number"
    assert good.done(tmp_path / "tasks")
    assert not bad.done(tmp_path / "tasks")


def test_the_key_knows_config_needs_and_code(diary, monkeypatch):
    assert diamond(diary).key == diamond(diary).key
    assert len({diamond(diary).key, diamond(diary, first=9).key, diamond(diary, last=9).key}) == 3
    before = diamond(diary).key
    monkeypatch.setattr("ghpt.paper.engine.tasks.code_digest", lambda names: "changed")
    assert diamond(diary).key != before
    assert len(with_dependencies([diamond(diary), diamond(diary)])) == 4


PROGRAM = """
import sys
from pathlib import Path
from test_tasks import slow
from ghpt.paper.engine.pool import perform_all
if __name__ == "__main__":
    perform_all(slow(Path(sys.argv[1])), Path(sys.argv[2]), 2, show=False)
"""


def slow(diary):
    return [task(diary, 1), *(task(diary, n, sleep=600) for n in (2, 3))]


@pytest.mark.posix
@pytest.mark.parametrize(("stop", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGKILL", -9)])
def test_a_stopped_run_leaves_no_process_and_goes_on_where_it_was(diary, tmp_path, stop, status):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    run = children.start(program, diary, tmp_path / "tasks")
    children.wait_until(lambda: {2, 3} <= set(numbers(diary)), run)
    run.send_signal(getattr(signal, stop))
    assert run.wait(children.LIMIT) == status
    workers = {int(line.split()[1]) for line in diary.read_text().splitlines()}
    children.wait_until(lambda: not any(alive(worker) for worker in workers))
    first, *others = slow(diary)
    assert first.done(tmp_path / "tasks")
    assert not any(other.done(tmp_path / "tasks") for other in others)
    assert perform_all([first, task(diary, 4, first)], tmp_path / "tasks", 1, show=False) == 1
    if stop != "SIGKILL":  # orphans may stay in the table of processes for a while, and look alive
        assert [path.name for path in (tmp_path / "tasks").glob(".*.tmp")] == []


def alive(process):
    try:
        return (
            Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0]
            != "Z"
        )
    except OSError:
        return False
