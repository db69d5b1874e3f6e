import ast
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "mutants.py"
TOY = '''"""A docstring of 1 line."""
LIMIT: "1 + 1" = 3


def larger(a: int, b: int) -> bool:
    if a < 0:
        raise ValueError("not 1")
    return a > b
'''
TEST = """
from ghpt.toy import larger

def test_larger():
    assert larger(2, 1)
    assert not larger(1, 2)
"""
RUN = """
import sys
from pathlib import Path
sys.path.insert(0, {scripts!r})
import mutants
mutants.ROOT = Path({root!r})
mutants.TESTS = {{"src/ghpt/toy.py": ["test_toy.py"]}}
toy = (mutants.ROOT / "src/ghpt/toy.py").read_bytes()
every = mutants.mutants("src/ghpt/toy.py")
chosen = [mutant for mutant in every if mutant.change(toy)[1] in {chosen!r}]
for row in mutants.share(chosen, Path({work!r}), {same!r}):
    print(row["result"] + ": " + row["after"])
"""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("mutants", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutants"] = module  # dataclasses look for it there
    spec.loader.exec_module(module)
    yield module
    del sys.modules["mutants"]


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A project with one module and its test."""
    for name, text in (
        ("src/ghpt/__init__.py", ""),
        ("src/ghpt/toy.py", TOY),
        ("tests/test_toy.py", TEST),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_mutants_change_what_is_computed_and_nothing_that_is_said(script, toy, monkeypatch):
    monkeypatch.setattr(script, "ROOT", toy)
    found = script.mutants("src/ghpt/toy.py")
    assert found == script.mutants("src/ghpt/toy.py")
    assert {mutant.change(TOY.encode())[1] for mutant in found} == {
        'LIMIT: "1 + 1" = 2',
        'LIMIT: "1 + 1" = 4',
        "if (a <= 0):",
        "if (a >= 0):",
        "if a < -1:",
        "if a < 1:",
        "return None",
        "return (a >= b)",
        "return (a <= b)",
    }
    assert all(ast.parse(mutant.source(TOY.encode())) for mutant in found)


@pytest.mark.posix
def test_a_mutant_is_killed_by_a_test_that_fails_and_the_source_is_as_before(toy, tmp_path):
    same = {("src/ghpt/toy.py", 'LIMIT: "1 + 1" = 3', 'LIMIT: "1 + 1" = 4'): "Nobody reads it."}
    chosen = ('LIMIT: "1 + 1" = 4', "return (a <= b)", "return (a >= b)")
    paths = {"scripts": str(SCRIPT.parent), "root": str(toy), "work": str(tmp_path / "work")}
    child = subprocess.run(
        [sys.executable, "-c", RUN.format(**paths, chosen=chosen, same=same)],
        env=os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    assert child.stdout.splitlines() == [
        'equivalent: LIMIT: "1 + 1" = 4',
        "killed: return (a <= b)",
        "survived: return (a >= b)",
    ]
    assert (toy / "src/ghpt/toy.py").read_text(encoding="utf-8") == TOY


def test_the_planted_bugs_and_the_equivalent_mutants_are_of_today_s_source(script):
    bugs = script.planted()
    assert len(bugs) == 30
    assert all(ast.parse(bug.source((script.ROOT / bug.file).read_bytes())) for bug in bugs)
    for row in json.loads(script.EQUIVALENT.read_text(encoding="utf-8")):
        source = (script.ROOT / row["file"]).read_text(encoding="utf-8")
        assert row["before"] in {" ".join(line.split()) for line in source.splitlines()}, row
        assert row["reason"]


def test_every_mutated_file_has_its_tests(script):
    for file, tests in script.TESTS.items():
        assert (script.ROOT / file).is_file()
        assert all((script.ROOT / "tests" / test.split("::")[0]).is_file() for test in tests)
