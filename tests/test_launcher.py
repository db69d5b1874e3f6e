"""Sweeps end alike under Hydra's own launcher, in a local pool of submitit's, and through Slurm's
commands.
"""

import json
import os
import re
import shlex
import signal
import sys
from pathlib import Path

import pytest
import torch
import yaml

import children
import ghpt.commands.jobs
from ghpt.commands.overrides import Source, check_overrides
from ghpt.commands.train import COMMAND
from ghpt.models.checkpoint import read_checkpoint

ROOT = Path(__file__).resolve().parents[1]
TOY = ROOT / "tests" / "toy_sweep.py"
LOCAL = "hydra/launcher=submitit_local"
SLURM = {  # stand-ins: an array's jobs run at once, on this machine
    "sbatch": """
        for i in $(seq 0 $(sed -n 's/#SBATCH --array=0-\\([0-9]*\\).*/\\1/p' "$1")); do
            SLURM_JOB_ID=7_$i SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$i \\
            SLURM_JOB_NODELIST=n SLURM_JOB_NUM_NODES=1 SLURM_NTASKS=1 SLURM_PROCID=0 \\
            SLURM_LOCALID=0 SLURM_NODEID=0 bash "$1" > /dev/null 2>&1 &
        done
        echo Submitted batch job 7""",
    "srun": 'while [ "$1" != "$PYTHON" ]; do shift; done; exec "$@"',
    "sacct": "echo 'JobID|State|NodeList'",
}


@pytest.fixture
def toy(tmp_path):
    """``toy(*words)`` starts toy_sweep.py, with the settings of Hydra that the project's commands
    have.
    """
    hydra = yaml.safe_load((ROOT / "conf" / "train.yaml").read_text())["hydra"]
    content = {
        "how": "well",
        "output": str(tmp_path / "out"),
        "hydra": {k: v for k, v in hydra.items() if k != "help"},
    }
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "toy.yaml").write_text(yaml.safe_dump(content))
    environment = {"TOY_CONF": str(tmp_path / "conf"), "PYTHON": sys.executable}

    def start(*words, path=""):
        paths = f"{path}{os.pathsep}{os.environ['PATH']}"
        return children.start(TOY, *words, env={**environment, "PATH": paths})

    return start


def lines(said):
    """The lines of the jobs, and what ``after`` got."""
    jobs = said.split("Jobs of the sweep:\n")[1].splitlines()
    last = jobs.pop().removeprefix("after ") if jobs[-1].startswith("after ") else "null"
    return jobs, json.loads(last)


def commands(folder, **content):
    for name, script in content.items():
        (folder / name).write_text(f"#!/bin/bash\n{script}\n")
        (folder / name).chmod(0o755)
    return str(folder)


WELL_AND_NOT = ["  0_how-well: done", "  1_how-user: error: how: is user. Say well."]


@pytest.mark.posix
@pytest.mark.parametrize("launcher", ["basic", "submitit_local", "submitit_slurm"])
def test_a_sweep_says_the_same_wherever_its_jobs_run(toy, tmp_path, launcher):
    child = toy(
        "-m", "how=well,user", f"hydra/launcher={launcher}", path=commands(tmp_path, **SLURM)
    )
    said, errors = child.communicate(timeout=children.LIMIT)
    jobs, after = lines(said)
    assert child.returncode == 1, errors
    assert jobs == WELL_AND_NOT
    assert "Traceback" not in errors
    assert [(job["name"], job["how"], job["failed"]) for job in after["jobs"]] == [
        ("0_how-well", "well", False),
        ("1_how-user", "user", True),
    ]
    assert after["jobs"][1]["result"] is None
    assert (after["jobs"][0]["result"]["pid"] == after["pid"]) is (launcher == "basic")
    assert "error: how: is user" in (tmp_path / "out" / "1_how-user" / "train.log").read_text()


@pytest.mark.posix
def test_a_job_that_dies_is_named_and_the_others_finish(toy, tmp_path):
    child = toy("-m", "how=killed,fault,exits,well", LOCAL)
    said, errors = child.communicate(timeout=children.LIMIT)
    (killed, *others), after = lines(said)
    assert child.returncode == 1, errors
    log = re.fullmatch(
        r"  0_how-killed: error: it ended without a result; (.*_log\.err) may say why", killed
    )[1]
    assert log.startswith(str(tmp_path / "out" / ".submitit"))
    assert others == [
        "  1_how-fault: error: KeyError: 'lost'",
        "  2_how-exits: stopped",
        "  3_how-well: done",
    ]
    assert [job["failed"] for job in after["jobs"]] == [True, True, True, False]
    assert "Traceback" in (tmp_path / "out" / "1_how-fault" / "train.log").read_text()


@pytest.mark.posix
def test_an_interrupt_stops_every_job(toy, tmp_path):
    child = toy("-m", "how=well,waits", LOCAL)
    children.wait_until((tmp_path / "out" / "1_how-waits" / "begun").exists, child)
    child.send_signal(signal.SIGINT)
    said, errors = child.communicate(timeout=children.LIMIT)
    assert child.returncode == 130, errors
    assert lines(said) == (["  0_how-well: done", "  1_how-waits: stopped"], None)
    assert "Traceback" not in errors


@pytest.mark.posix
def test_what_sbatch_refuses_is_said_in_one_line(toy, tmp_path):
    refusing = SLURM | {
        "sbatch": "echo 'sbatch: error: invalid partition specified: gpuu' >&2; exit 1"
    }
    words = (
        "-m",
        "how=well,user",
        "hydra/launcher=submitit_slurm",
        "hydra.launcher.partition=gpuu",
    )
    child = toy(*words, path=commands(tmp_path, **refusing))
    _, errors = child.communicate(timeout=children.LIMIT)
    assert child.returncode == 1
    assert errors.splitlines()[-1].startswith(
        "error: hydra.launcher: sbatch: error: invalid partition specified: gpuu"
    )
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("launcher", "installed", "message"),
    [
        (
            "submitit_local",
            False,
            "submitit_local needs hydra-submitit-launcher. Run: pip install -e '.[slurm]'",
        ),
        (
            "submitit_slurm",
            True,
            "submitit_slurm needs Slurm's sbatch and srun, which are not here. Start it on",
        ),
        (
            "submitit_loca",
            True,
            "there is no 'submitit_loca'. Did you mean 'submitit_local'? Existing: basic, ",
        ),
    ],
)
def test_a_launcher_that_is_not_there(typed, monkeypatch, tmp_path, launcher, installed, message):
    monkeypatch.setattr(ghpt.commands.jobs, "find_spec", lambda name: installed or None)
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ("-m", "data=cmu1,cmu2", f"hydra/launcher={launcher}")
    status, _, said = typed(ROOT / "conf", COMMAND, words)
    assert (status, said.count("\n")) == (1, 1)
    assert said.startswith(f"error: hydra/launcher: {message}")


@pytest.mark.parametrize(
    "name", ["RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK"]
)
def test_one_process_of_a_run_writes_its_files(monkeypatch, name):
    monkeypatch.delenv(name, raising=False)
    assert ghpt.commands.jobs.is_first_process()
    monkeypatch.setenv(name, "0")
    assert ghpt.commands.jobs.is_first_process()
    monkeypatch.setenv(name, "1")
    assert not ghpt.commands.jobs.is_first_process()


def test_slurm_s_settings_compose_where_there_is_no_slurm(typed):
    settings = {"partition": "gpu", "gpus_per_node": 1, "timeout_min": 120, "cpus_per_task": 4}
    words = [
        "hydra/launcher=submitit_slurm",
        *(f"hydra.launcher.{k}={v}" for k, v in settings.items()),
        "--cfg=hydra",
    ]
    status, said, _ = typed(ROOT / "conf", COMMAND, words)
    launcher = yaml.safe_load(said)["hydra"]["launcher"]
    assert status == 0
    assert {key: launcher[key] for key in settings} == settings


def test_the_commands_of_the_page_about_clusters_are_understood():
    text = (ROOT / "docs" / "clusters.md").read_text(encoding="utf-8")
    found = [
        shlex.split(line) for line in re.findall(r"^\$ (python .*)$", text, flags=re.MULTILINE)
    ]
    launchers = set()
    for _, script, *words in found:
        source = Source(ROOT / "conf", script.removesuffix(".py"))
        overrides = check_overrides(source, [word for word in words if word != "-m"])
        launchers.add(ghpt.commands.jobs.chosen_launcher(overrides, compose_only=True))
    assert launchers == {"basic", "submitit_local", "submitit_slurm"}


@pytest.mark.posix
def test_trainings_of_a_local_pool_are_those_of_one_process(typed, conf, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests")]))
    monkeypatch.setenv("OMP_NUM_THREADS", str(torch.get_num_threads()))
    small = (
        "data=toy",
        "model.hypotheses=5",
        "model.scorer.layers=[4]",
        "trainer.accelerator=cpu",
        "trainer.max_epochs=2",
        "seed=1",
    )
    said = {}
    for launcher in ("basic", "submitit_local"):
        words = (
            "-m",
            *small,
            "progress_bar=false",
            f"output={tmp_path / launcher}",
            f"hydra/launcher={launcher}",
        )
        status, text, errors = typed(conf, COMMAND, words)
        assert status == 0, errors
        said[launcher] = lines(text)[0]
    assert said["basic"] == said["submitit_local"]
    one, other = (read_checkpoint(*(tmp_path / name).glob("0*/best.ckpt")) for name in said)
    assert one["state_dict"].keys() == other["state_dict"].keys()
    for key, value in one["state_dict"].items():
        assert torch.equal(other["state_dict"][key], value), key
    scores = [
        next(v["best_model_score"] for k, v in c["callbacks"].items() if "ModelCheckpoint" in k)
        for c in (one, other)
    ]
    assert scores[0] == scores[1]
