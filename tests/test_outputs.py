"""The user's files stay the user's: what an output folder lets a command replace, and who may write
there.
"""

import hashlib
import json
import os
from pathlib import Path

import pytest
import yaml

import children
import ghpt.commands.calibrate
import ghpt.commands.cameras
import ghpt.commands.test as testing
from ghpt import files
from ghpt.commands import predict, train
from ghpt.commands.outputs import STATE, Files, OutputFolder, check_apart, input_paths, stamp
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.files import atomic_write, remove
from predicting import cameras_file

ROOT = Path(__file__).resolve().parents[1]
WRITES = Files(writes=("a.txt", "b.txt"))


def write(folder: Path, name: str, text: str) -> None:
    with atomic_write(folder / name, "w") as handle:
        handle.write(text)


def contents(folder: Path) -> dict[str, str]:
    """Name -> digest of every file below a folder, but for the guard's own records."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and STATE not in path.parts
    }


def test_what_ghpt_wrote_is_replaced(tmp_path):
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "first")
        write(tmp_path, "sub/c.txt", "first")
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "second")
        write(tmp_path, "a.txt", "third")
        write(tmp_path, "sub/c.txt", "second")
        remove(tmp_path / "a.txt")
        write(tmp_path, "a.txt", "fourth")
    assert (tmp_path / "a.txt").read_text() == "fourth"
    assert (tmp_path / "sub" / "c.txt").read_text() == "second"


def test_a_foreign_file_is_named_before_anything_happens(tmp_path):
    (tmp_path / "b.txt").write_text("mine")
    with pytest.raises(GhptDataError, match=r"b\.txt: was not written by ghpt.*overwrite=true"):
        OutputFolder(tmp_path, WRITES).__enter__()
    assert [path.name for path in tmp_path.iterdir()] == ["b.txt"]


def test_a_file_that_was_changed_since_is_foreign(tmp_path):
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "ours")
    (tmp_path / "a.txt").write_text("ours, with notes of mine")
    with pytest.raises(
        GhptDataError, match=r"a\.txt: was not written by ghpt, or has been changed"
    ):
        OutputFolder(tmp_path, WRITES).__enter__()
    (tmp_path / "a.txt").write_text("ours")  # the same content again is the same file
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "newer")


def test_a_file_that_appears_meanwhile_is_neither_replaced_nor_removed(tmp_path):
    with OutputFolder(tmp_path, WRITES):
        for name in ("a.txt", "not_announced.txt"):
            (tmp_path / name).write_text("mine")
            with pytest.raises(GhptDataError, match=f"{name}: was not written by ghpt"):
                write(tmp_path, name, "ours")
            with pytest.raises(GhptDataError, match=f"{name}: was not written by ghpt"):
                remove(tmp_path / name)
            assert (tmp_path / name).read_text() == "mine"
        remove(tmp_path / "absent.txt")
    assert sorted(path.name for path in tmp_path.iterdir()) == [STATE, "a.txt", "not_announced.txt"]


def test_what_a_writer_that_died_left_is_swept(tmp_path):
    nobody = 2**22  # Linux has no process of this number
    left = tmp_path / f".a.txt.{files._HOST}-{nobody}-0123abcd.tmp"
    left.write_text("half")
    with OutputFolder(tmp_path, WRITES):
        assert not left.exists()


def test_overwrite_insists_but_never_on_an_input(tmp_path):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("mine")
    reading = Files(reads=(tmp_path / "a.txt",), writes=WRITES.writes)
    with pytest.raises(GhptDataError, match=r"a\.txt: is an input of this command"):
        OutputFolder(tmp_path, reading, overwrite=True).__enter__()
    with OutputFolder(tmp_path, WRITES, overwrite=True):
        write(tmp_path, "a.txt", "ours")
        remove(tmp_path / "b.txt")
    assert contents(tmp_path).keys() == {"a.txt"}
    with pytest.raises(
        GhptDataError, match=r"a\.txt: is an input of this command"
    ):  # although it is ours now
        OutputFolder(tmp_path, reading).__enter__()


def test_an_input_is_found_through_links_and_in_folders_that_are_read(tmp_path):
    folder, link = tmp_path / "folder", tmp_path / "link"
    folder.mkdir()
    (folder / "a.txt").write_text("mine")
    link.symlink_to(folder)
    for reads in ((link / "a.txt",), (folder / ".." / "folder" / "a.txt",)):
        with pytest.raises(GhptDataError, match="is an input of this command"):
            OutputFolder(folder, Files(reads, ("a.txt",)), overwrite=True).__enter__()
    with pytest.raises(GhptDataError, match="lies in a folder that this command reads"):
        OutputFolder(link, Files((folder,), ("a.txt",)), overwrite=True).__enter__()
    os.link(folder / "a.txt", tmp_path / "b.txt")
    with pytest.raises(GhptDataError, match="is an input of this command"):
        OutputFolder(tmp_path, Files((folder / "a.txt",), ("b.txt",)), overwrite=True).__enter__()


def test_what_is_kept_is_replaced_on_request_alone(tmp_path):
    keeping = Files(writes=("a.txt",), keeps=("a.txt",))
    with OutputFolder(tmp_path, keeping):
        write(tmp_path, "a.txt", "first")
        write(tmp_path, "a.txt", "second")  # within a run it may be
    with pytest.raises(
        GhptDataError, match=r"a\.txt: is there from an earlier run\. .*resume=true.*overwrite=true"
    ):
        OutputFolder(tmp_path, keeping).__enter__()
    with OutputFolder(tmp_path, keeping, overwrite=True):
        write(tmp_path, "a.txt", "third")
    assert (tmp_path / "a.txt").read_text() == "third"


def test_logs_and_unfinished_work_are_ours_by_name_once_we_made_them(tmp_path):
    growing = Files(growing=("run.log", ".work"))
    (tmp_path / "run.log").write_text("mine")
    with pytest.raises(GhptDataError, match=r"run\.log: was not written by ghpt"):
        OutputFolder(tmp_path, growing).__enter__()
    (tmp_path / "run.log").unlink()
    with OutputFolder(tmp_path, growing):
        (tmp_path / "run.log").write_text("a line")
        write(tmp_path, ".work/part", "1")
    with OutputFolder(tmp_path, growing):
        write(tmp_path, ".work/part", "2")
    assert (tmp_path / "run.log").read_text() == "a line"


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_crash_around_the_move_leaves_a_file_that_is_still_ours(tmp_path, monkeypatch, moment):
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "first")
    replace = os.replace

    def crash(old, new):
        if Path(new).name == "a.txt":
            if moment == "after":
                replace(old, new)
            raise KeyboardInterrupt
        replace(old, new)

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt), OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "second")
    monkeypatch.undo()
    assert (tmp_path / "a.txt").read_text() == {"before": "first", "after": "second"}[moment]
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "third")


@pytest.mark.parametrize(
    "damage", [b"", b"{", b"[1, 2]", b'{"version": 99}', b'{"version": 1, "files": 3}']
)
def test_with_a_damaged_manifest_nothing_is_ours(tmp_path, damage):
    with OutputFolder(tmp_path, WRITES):
        write(tmp_path, "a.txt", "ours")
    (tmp_path / STATE / "manifest.json").write_bytes(damage)
    with pytest.raises(GhptDataError, match=r"a\.txt: was not written by ghpt"):
        OutputFolder(tmp_path, WRITES).__enter__()
    assert (tmp_path / "a.txt").read_text() == "ours"


def test_b10_a_second_writer_is_refused_at_once_and_a_dead_ones_lock_is_taken_over(tmp_path):
    script = (
        "import sys, time; from pathlib import Path\n"
        "from ghpt.commands.outputs import Files, OutputFolder\n"
        "with OutputFolder(Path(sys.argv[1]), Files()):\n"
        "    print('in', flush=True); time.sleep(600)\n"
    )
    child = children.start("-c", script, tmp_path)
    assert child.stdout.readline() == "in\n"
    with pytest.raises(GhptDataError, match="another ghpt command writes here"):
        OutputFolder(tmp_path, Files()).__enter__()  # it does not wait
    child.kill()
    child.wait(children.LIMIT)
    with (
        OutputFolder(tmp_path, Files()),
        pytest.raises(GhptDataError, match="another ghpt command writes here"),
    ):
        OutputFolder(tmp_path, Files()).__enter__()  # nor may another part of this process


def test_a_finished_run_is_known_until_its_settings_inputs_or_files_change(tmp_path):
    source, output = tmp_path / "in.txt", tmp_path / "out"
    source.write_text("input")
    settings = {"a": 1, "output": "here", "progress_bar": True}

    def said(**changed):
        with OutputFolder(output, Files((source,), ("a.txt",))) as folder:
            return folder.read_summary(settings | changed)

    assert said() is None
    with OutputFolder(output, Files((source,), ("a.txt",))) as folder:
        write(output, "a.txt", "result")
        folder.finish(settings, "3 mm")
    assert said() == "3 mm"
    assert said(output="there", progress_bar=False, resume="auto") == "3 mm"
    assert said(a=2) is None
    os.utime(source, ns=(1, 1))
    assert said() is None
    with OutputFolder(output, Files((source,), ("a.txt",))) as folder:
        folder.finish(settings, "3 mm")
    (output / "a.txt").unlink()
    assert said() is None


def test_the_stamp_of_a_folder_changes_with_any_file_below_it(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "c.json").write_text("1")
    first = stamp([tmp_path / "a"])
    assert stamp([tmp_path / "a"]) == first
    (tmp_path / "a" / "b" / "c.json").write_text("12")
    assert stamp([tmp_path / "a"]) != first


def test_the_inputs_of_a_command_are_those_that_its_settings_name(tmp_path):
    found = input_paths("m.ckpt", "pose", str(tmp_path), "/data")
    named = [Path("m.ckpt"), Path("pose"), tmp_path, Path("/data")]
    assert set(found) == {*named, tmp_path / "intri.yml", tmp_path / "extri.yml"}
    assert input_paths(None, None) == ()


def test_the_folder_of_key_points_is_no_output(tmp_path):
    with pytest.raises(
        GhptConfigError, match=r"output: is .*, the folder that the key points are read from"
    ):
        check_apart(str(tmp_path), f"{tmp_path}/.")
    check_apart(str(tmp_path), f"{tmp_path}/out")


COMMANDS = {
    "predict": (
        predict.COMMAND,
        [],
        ["poses.npz", "poses.csv", "report.md", "prediction.json", ".shards/000000.npz"],
    ),
    "calibrate": (
        ghpt.commands.calibrate.COMMAND,
        [],
        ["extri.yml", "rig.toml", "poses.npz", "calibration.json", "rig.png"],
    ),
    "cameras": (
        ghpt.commands.cameras.COMMAND,
        [],
        ["cameras.toml", "keypoints.npz", "cameras.json", "report.md"],
    ),
    "train": (
        train.COMMAND,
        ["data=cmu2"],
        ["last.ckpt", "best.ckpt", "train.log", ".hydra/config.yaml"],
    ),
    "test": (
        testing.COMMAND,
        ["ckpt=last.ckpt"],
        ["metrics.json", "predictions.npz", ".predictions/frame"],
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_touches_a_foreign_folder(typed, tmp_path, name):
    """Before it reads anything: the inputs that these command lines name do not even exist."""
    command, words, theirs = COMMANDS[name]
    if not words:
        words = ["keypoints=none.npz", "cameras=none.toml"]
    for number, file in enumerate(theirs):
        output = tmp_path / str(number)
        (output / file).parent.mkdir(parents=True)
        (output / file).write_text("mine")
        status, _, said = typed(ROOT / "conf", command, [*words, f"output={output}"])
        assert (status, said.count("\n")) == (1, 1), said
        assert "was not written by ghpt" in said
        assert file.split("/")[0] in said
        assert contents(output) == {file: hashlib.sha256(b"mine").hexdigest()}
        assert not (output / STATE).exists()


def test_a_calibration_beside_its_own_inputs_is_refused_and_leaves_them(typed, tmp_path):
    """EasyMocap's layout: intri.yml and extri.yml lie in the folder that is also the output."""
    for name in ("intri.yml", "extri.yml"):
        (tmp_path / name).write_text("%YAML:1.0\n---\n")
    before = contents(tmp_path)
    words = [f"keypoints={tmp_path / 'pose'}", f"cameras={tmp_path}", f"output={tmp_path}"]
    for more in ([], ["overwrite=true"]):
        status, _, said = typed(ROOT / "conf", ghpt.commands.calibrate.COMMAND, [*words, *more])
        assert (status, said.count("\n")) == (1, 1)
        assert "intri.yml: is an input of this command. Name another output." in said
        assert contents(tmp_path) == before


def test_a_prediction_does_not_overwrite_its_key_points(typed, tmp_path):
    (tmp_path / "poses.npz").write_bytes(b"key points")
    before = contents(tmp_path)
    cameras = cameras_file(tmp_path)
    words = [
        f"keypoints={tmp_path / 'poses.npz'}",
        f"cameras={cameras}",
        f"output={tmp_path}",
        "overwrite=true",
    ]
    status, _, said = typed(ROOT / "conf", predict.COMMAND, words)
    assert (status, said.count("\n")) == (1, 1)
    assert "poses.npz: is an input of this command. Name another output." in said
    assert contents(tmp_path).items() >= before.items()


TOY_SWEEP = ROOT / "tests" / "toy_sweep.py"


@pytest.fixture
def sweep(tmp_path):
    """``sweep(*words)`` runs toy_sweep.py in a child: (exit status, what it printed)."""
    hydra = yaml.safe_load((ROOT / "conf" / "train.yaml").read_text())["hydra"]
    content = {
        "how": "well",
        "output": str(tmp_path / "out"),
        "overwrite": False,
        "hydra": {key: value for key, value in hydra.items() if key != "help"},
    }
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "toy.yaml").write_text(yaml.safe_dump(content))

    def run(*words):
        ended = children.run(TOY_SWEEP, *words, env={"TOY_CONF": str(tmp_path / "conf")})
        return ended.status, ended.out + ended.errors

    return run


def pids(folder: Path) -> dict[str, str]:
    """Which process made each job's result."""
    return {path.parent.name: path.read_text() for path in sorted(folder.glob("*/pid"))}


def test_b9_a_sweep_that_runs_again_does_only_what_is_missing(sweep, tmp_path):
    out = tmp_path / "out"
    status, said = sweep("-m", "how=well,once,other")
    assert status == 1
    assert "1_how-once: error: how: is once. Say well." in said
    assert "error: how: is once" in (out / "1_how-once" / "train.log").read_text()
    first = pids(out)
    assert first.keys() == {"0_how-well", "2_how-other"}
    status, said = sweep("-m", "how=well,once,other")
    assert status == 0, said
    assert "0_how-well: done (finished before)" in said
    assert "2_how-other: done (finished before)" in said
    second = pids(out)
    assert second.items() > first.items()
    assert second.keys() - first.keys() == {"1_how-once"}
    status, said = sweep("-m", "how=well,once,other", "overwrite=true")
    assert status == 0, said
    assert not set(pids(out).values()) & set(second.values())


def test_a_sweep_into_a_foreign_folder_is_refused(sweep, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "multirun.yaml").write_text("mine")
    status, said = sweep("-m", "how=well,other")
    assert (status, said.count("\n")) == (1, 1)
    assert "multirun.yaml: was not written by ghpt" in said
    assert contents(tmp_path / "out") == {"multirun.yaml": hashlib.sha256(b"mine").hexdigest()}


def test_a_locked_sweep_s_folder_is_refused_in_one_line(sweep, tmp_path):
    with OutputFolder(tmp_path / "out", Files()):
        status, said = sweep("-m", "how=well,other")
    assert (status, said.count("\n")) == (1, 1)
    assert "another ghpt command writes here" in said


def test_the_manifest_lists_what_was_written_with_its_digest(typed, tmp_path):
    words = ["keypoints=none.npz", "cameras=none.toml", f"output={tmp_path}"]
    status, _, _ = typed(ROOT / "conf", predict.COMMAND, words)
    assert status == 1
    manifest = json.loads((tmp_path / STATE / "manifest.json").read_text())
    assert manifest["files"].keys() == {
        f".hydra/{name}.yaml" for name in ("config", "hydra", "overrides")
    }
    for name, digests in manifest["files"].items():
        assert digests == [hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()]
    assert manifest["growing"] == [".shards", "predict.log"]
