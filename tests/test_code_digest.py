"""A task's digest changes with the code that decides its result, and with nothing else."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ghpt
from ghpt.paper.engine.code import (
    code_digest,
    data_files,
    import_closure,
    imported_names,
    source_meaning,
    target_names,
)

CHANGES = {
    "a setting's type": ("config.py", "\nONE = 1\n"),
    "the container of predictions": ("data/formats/stored_npz.py", "\nONE = 1\n"),
    "a class that the configuration names": ("models/relative_pose/baselines.py", "\nONE = 1\n"),
    "a camera of the synthetic data": ("data/synthetic/human36m_cameras.json", "\n"),
    "a comment": ("config.py", "\n# one\n"),
    "a docstring": ("config.py", '\n"""One."""\n'),
    "a figure": ("report/figures.py", "\nONE = 1\n"),
}
PROGRAM = """
import functools, json, sys
from pathlib import Path
from ghpt.paper.engine import code
names = frozenset({
    "ghpt.paper.camera.sweep.errors_of_draws",
    "ghpt.models.relative_pose.baselines.PoseLib",
    "ghpt.data.datasets.arrangements.Human36M",
})
def by_content(function):
    cached = functools.cache(lambda content, *given: function(*given))
    return lambda *given: cached(given[-1].read_bytes(), *given)
code.source_meaning = by_content(code.source_meaning.__wrapped__)
code.imported_names = by_content(code.imported_names)
code.data_files = by_content(code.data_files)
def digest():
    code.code_digest.cache_clear()
    return code.code_digest(names)
before = digest()
changed = {}
for name, (file, text) in json.loads(sys.argv[1]).items():
    path = Path(code.__file__).parents[2] / file
    content = path.read_bytes()
    path.write_bytes(content + text.encode())
    changed[name] = digest() != before
    path.write_bytes(content)
print(json.dumps(changed))
"""


def test_the_digest_changes_with_what_decides_a_number_alone(tmp_path: Path):
    source = Path(ghpt.__file__).parent
    shutil.copytree(source, tmp_path / "ghpt", ignore=shutil.ignore_patterns("__pycache__"))
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(CHANGES)],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(run.stdout) == {
        "a setting's type": True,
        "the container of predictions": True,
        "a class that the configuration names": True,
        "a camera of the synthetic data": True,
        "a comment": False,
        "a docstring": False,
        "a figure": False,
    }


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "own_code"
    folder.mkdir()
    (folder / "__init__.py").touch()
    return folder


def test_the_closure_of_a_user_s_own_class_is_its_own_package_and_ghpt(package: Path):
    (package / "scorer.py").write_text(
        "import numpy\nfrom typing import TYPE_CHECKING\nfrom .layers import Layer\n"
        "if TYPE_CHECKING:\n    from . import types_only\n"
        "def f():\n    from ghpt.randomness import key\n"
    )
    (package / "layers.py").write_text("class Layer: pass\n")
    (package / "types_only.py").touch()
    closure = import_closure(["own_code.scorer.Scorer"])
    own = {name for name in closure if not name.startswith("ghpt")}
    assert own == {"own_code.scorer", "own_code.layers"}
    assert "ghpt.randomness" in closure


def test_imported_names_are_absolute(package: Path):
    file = package / "a.py"
    file.write_text("import x.y\nfrom . import b\nfrom .c import d\nfrom ..e import f\n")
    assert imported_names("own_code.inner.a", file) == [
        "x.y",
        "own_code.inner",
        "own_code.inner.b",
        "own_code.inner.c",
        "own_code.inner.c.d",
        "own_code.e",
        "own_code.e.f",
    ]


def test_comments_docstrings_and_layout_have_no_meaning(tmp_path: Path):
    def meaning(name: str, text: str) -> str:
        (tmp_path / name).write_text(text)
        return source_meaning(tmp_path / name)

    plain = meaning("a.py", "def f(x):\n    return x + 1\n")
    documented = '"""About."""\n\n\ndef f(x):\n    """More."""\n    # why\n    return (x\n  + 1)\n'
    assert meaning("b.py", documented) == plain
    assert meaning("c.py", "def f(x):\n    return x + 2\n") != plain


def test_weights_that_ship_count_where_they_are_loaded():
    file = import_closure({"ghpt.models.estimators.frame_learned"})["ghpt.models.weights"]
    assert [path.name for path in data_files(file)] == ["joint.npz", "key_points.npz"]


def test_classes_that_a_configuration_names_count():
    config = {"data": {"_target_": "a.B"}, "more": [{"x": {"_target_": "c.D", "y": 1}}], "z": 2}
    assert list(target_names(config)) == ["a.B", "c.D"]
    assert code_digest(frozenset({"ghpt.skeleton"})) != code_digest(frozenset({"ghpt.errors"}))
