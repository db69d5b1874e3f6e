"""What pyproject.toml, constraints.txt and the workflow promise."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"].values()
REQUIREMENTS = [Requirement(text) for text in sum(EXTRAS, PROJECT["dependencies"])]
PINS = dict(
    line.split("==")
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if not line.startswith("#")
)
BANNED = {
    "torch": ["2.5.1", "2.9.1"],  # CVE-2025-32434, CVE-2026-24747
    "lightning": ["2.6.2", "2.6.3"],  # compromised releases, GHSA-w37p-236h-pfx3
    "hydra-core": ["1.3.5"],  # GHSA-37p2-j732-x8pj
}
"""Versions that must never be installed."""


@pytest.mark.parametrize(
    ("name", "version"), [(name, v) for name, versions in BANNED.items() for v in versions]
)
def test_a_banned_version_is_refused(name: str, version: str) -> None:
    (requirement,) = [r for r in REQUIREMENTS if r.name == name]
    assert not requirement.specifier.contains(version)


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_a_requirement_has_a_floor_that_its_pin_keeps(requirement: Requirement) -> None:
    if requirement.name == "ghpt":
        return
    floors = [Version(s.version) for s in requirement.specifier if s.operator == ">="]
    assert len(floors) == 1
    if pin := {name.lower(): version for name, version in PINS.items()}.get(requirement.name):
        assert requirement.specifier.contains(pin)


def workflow() -> dict:
    path = ROOT / ".github" / "workflows" / "test.yml"
    return yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]


def test_the_workflow_runs_on_every_system_and_python() -> None:
    matrix = workflow()["systems"]["strategy"]["matrix"]
    assert matrix["system"] == ["ubuntu-latest", "windows-latest", "macos-latest"]
    assert matrix["python"] == ["3.11", "3.12", "3.13"]


def test_the_workflow_runs_the_lowest_and_the_newest_versions() -> None:
    versions = workflow()["versions"]["strategy"]["matrix"]["versions"]
    lowest = re.search(r"\d+\.\d+", PROJECT["requires-python"]).group()
    assert [v["resolution"] for v in versions] == ["lowest-direct", "highest"]
    assert versions[0]["python"] == lowest


def test_the_scripts_of_the_workflow_exist() -> None:
    steps = [step.get("run", "") for job in workflow().values() for step in job["steps"]]
    scripts = re.findall(r"python (\S+\.py)", " ".join(steps))
    assert scripts
    assert all((ROOT / script).is_file() for script in scripts)


WITHOUT_POSIX = """
import os, pkgutil, signal, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios", "cv2", "pycolmap"):
    sys.modules[name] = None
import torch, lightning.pytorch  # theirs may be imported before the rest is gone
MISSING = (
    "fork", "sched_getaffinity", "getuid", "geteuid", "killpg", "setsid", "mkfifo", "O_DIRECTORY",
    "posix_fallocate",
)
for name in MISSING:
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "setitimer", "alarm", "pthread_sigmask"):
    if hasattr(signal, name):
        delattr(signal, name)
import ghpt
for module in pkgutil.walk_packages(ghpt.__path__, "ghpt."):
    if module.name != "ghpt.colmap":
        __import__(module.name)
        print(module.name)
"""


def test_every_module_is_imported_without_extras_and_what_windows_lacks() -> None:
    """In a child, since a module that is imported here stays imported."""
    command = [sys.executable, "-c", WITHOUT_POSIX]
    child = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert child.returncode == 0, child.stderr
    assert "ghpt.commands.prediction.shards" in child.stdout.split()
