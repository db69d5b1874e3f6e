"""The package as others get it: an sdist that is whole, and a wheel that runs outside the clone."""

import os
import shutil
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from ghpt.commands.catalogue import SUMMARIES

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = shutil.ignore_patterns(
    ".git",
    ".venv*",
    "*.egg-info",
    "__pycache__",
    ".*_cache",
    ".hypothesis",
    "build",
    "dist",
    "runs",
)
BUILD_SDIST = "from setuptools import build_meta; build_meta.build_sdist('dist')"
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


@dataclass(frozen=True)
class Installed:
    """A wheel that was made from the sdist, installed into a folder of its own."""

    site: Path
    source: Path
    """The unpacked sdist."""
    elsewhere: Path
    """A folder that has nothing of the project."""

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *words],
            cwd=self.elsewhere,
            env=os.environ | {"PYTHONPATH": str(self.site)},
            capture_output=True,
            text=True,
            timeout=300,
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    folder = tmp_path_factory.mktemp("wheel")
    clone = folder / "clone"
    shutil.copytree(ROOT, clone, ignore=LEFT_OUT)
    subprocess.run([sys.executable, "-c", BUILD_SDIST], cwd=clone, check=True, capture_output=True)
    (archive,) = (clone / "dist").iterdir()
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    source = folder / archive.name.removesuffix(".tar.gz")
    shutil.rmtree(clone)
    build = ["wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source)]
    subprocess.run([*PIP, *build], check=True)
    (wheel,) = folder.glob("*.whl")
    site = folder / "site"
    install = ["install", "--no-deps", "--no-index", "--target", str(site), str(wheel)]
    subprocess.run([*PIP, *install], check=True)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    return Installed(site, source, elsewhere)


def test_the_source_archive_is_whole(installed: Installed) -> None:
    names = (
        *(
            "README.md",
            "LICENSE",
            "CHANGELOG.md",
            "constraints.txt",
            "pyproject.toml",
            "mkdocs.yml",
        ),
        *("train.py", "conf/train.yaml", "conf/data/cmu1.yaml", "docs/index.md"),
        *("tests/test_wheel.py", "scripts/reliability.py", "src/ghpt/export/player.js"),
    )
    assert [name for name in names if not (installed.source / name).is_file()] == []


def test_the_wheel_is_typed_and_holds_its_configuration(installed: Installed) -> None:
    package = installed.site / "ghpt"
    assert (package / "py.typed").is_file()
    in_wheel = {path.relative_to(package / "conf") for path in package.glob("conf/**/*.yaml")}
    assert in_wheel == {path.relative_to(ROOT / "conf") for path in ROOT.glob("conf/**/*.yaml")}
    found = installed.run("-c", "import ghpt.config; print(ghpt.config.CONF)")
    assert found.stdout.strip() == str(package / "conf")


def test_the_console_script_lists_the_commands(installed: Installed) -> None:
    (script,) = (installed.site / "bin").glob("ghpt*")
    said = installed.run(str(script), "--help").stdout
    assert [line.split()[0] for line in said.splitlines() if line.startswith("  ")] == [*SUMMARIES]


@pytest.mark.parametrize("name", SUMMARIES)
def test_every_configuration_is_composed_outside_the_clone(installed: Installed, name: str) -> None:
    done = installed.run("-m", "ghpt", name, "--cfg", "job")
    assert (done.returncode, done.stderr) == (0, "")
    assert "\noverwrite: false\n" in done.stdout


def test_help_is_in_the_words_of_the_console(installed: Installed) -> None:
    said = installed.run("-m", "ghpt", "predict", "--help").stdout
    assert "  ghpt predict keypoints=pose/ cameras=Calib.toml output=out/\n" in said
    assert "python predict.py" not in said


def test_a_mistyped_key_ends_in_one_line(installed: Installed) -> None:
    done = installed.run("-m", "ghpt", "train", "dat=cmu1")
    assert done.returncode == 1
    assert done.stderr.startswith("error: dat: no such setting. Did you mean 'data'?")
    assert done.stderr.count("\n") == 1


def test_a_folder_of_a_users_own_configurations_is_added(installed: Installed) -> None:
    own = installed.elsewhere / "conf" / "data" / "mine.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("defaults: [cmu1]\nstride: 7\n", encoding="utf-8")
    words = ("-m", "ghpt", "train", "data=mine", "--config-dir", "conf", "--cfg", "job")
    done = installed.run(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert "  stride: 7\n" in done.stdout
