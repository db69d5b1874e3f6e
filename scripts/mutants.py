"""Mutation testing: do the tests notice a small change of the source?

    python scripts/mutants.py                # 100 random mutants of the files of TESTS
    python scripts/mutants.py --files src/ghpt/geometry/*.py --count 50 --seed 1
    python scripts/mutants.py --planted      # the bugs of planted_bugs.json instead

One mutant at a time is written into a temporary copy of ``src``, never into the working tree. The
tests of its file run in a fork of this process, which has imported the large libraries already; so
this needs Linux or macOS. Which mutants are drawn depends on the sources and the seed only.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import importlib.util
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.json")
"""Mutants that no test can notice, each with the reason."""
PLANTED = Path(__file__).with_name("planted_bugs.json")
"""Bugs as people make them: a wrong axis, unit or sign, a mask or a limit left out."""

TESTS = {
    "src/ghpt/geometry/cameras.py": ["test_cameras.py"],
    "src/ghpt/geometry/epipolar.py": ["test_epipolar.py"],
    "src/ghpt/geometry/normal_equations.py": ["test_normal_equations.py", "test_triangulation.py"],
    "src/ghpt/geometry/reweighting.py": ["test_reweighting.py"],
    "src/ghpt/geometry/rotations.py": ["test_rotations.py"],
    "src/ghpt/geometry/subsets.py": ["test_subsets.py"],
    "src/ghpt/geometry/triangulation.py": ["test_triangulation.py"],
    "src/ghpt/metrics/pose_error.py": ["test_pose_error.py"],
    "src/ghpt/metrics/pose_prior.py": ["test_pose_prior.py"],
    "src/ghpt/metrics/relative_pose.py": ["test_relative_pose.py"],
    "src/ghpt/models/loss.py": ["test_loss.py"],
    "src/ghpt/models/estimators/uncertainty.py": ["test_uncertainty.py"],
    "src/ghpt/models/relative_pose/scale.py": ["test_scale.py"],
    "src/ghpt/models/aggregation.py": ["test_aggregation.py"],
    "src/ghpt/calibration/observations.py": [
        "test_calibration.py::test_frames_cover_time_and_place",
        "test_calibration.py::test_noise_of_views_and_joints_is_found",
    ],
    "src/ghpt/commands/prediction/shards.py": ["test_shards.py"],
    "src/ghpt/commands/prediction/gaps.py": ["test_gaps.py"],
    "src/ghpt/files.py": ["test_files.py", "test_outputs.py"],
    "src/ghpt/commands/outputs.py": ["test_outputs.py"],
    "src/ghpt/data/formats/json_people.py": ["test_openpose.py", "test_json_key_points.py"],
}
"""What may be mutated, and for each file the tests that must notice it."""

LIBRARIES = (
    "torch",
    "lightning.pytorch",
    "torchmetrics",
    "hydra",
    "scipy.spatial.transform",
    "cv2",
    "hypothesis",
)
"""Imported once, before the forks. Nothing of ghpt may be: it differs from mutant to mutant."""

COMPARISONS = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
PAIRS = [
    ("min", "max"),
    ("amin", "amax"),
    ("any", "all"),
    ("sum", "mean"),
    ("sin", "cos"),
    ("argmin", "argmax"),
]
NAMES = dict(PAIRS) | {second: first for first, second in PAIRS}
DROPPED = ("clamp", "clamp_", "clamp_min", "nan_to_num", "abs", "sqrt", "square", "double")
"""Methods that a mutant leaves out of a chain of calls."""


@dataclass(frozen=True)
class Mutant:
    """One change of a file: ``text`` replaces its bytes from ``start`` to ``end``."""

    file: str
    line: int
    start: int
    end: int
    text: str

    def source(self, original: bytes) -> bytes:
        """The mutated file, given the file."""
        return original[: self.start] + self.text.encode() + original[self.end :]

    def change(self, original: bytes) -> tuple[str, str]:
        """The touched lines before and after, each as one line, given the file."""
        first = original.rfind(b"\n", 0, self.start) + 1
        last = original.index(b"\n", self.end)
        after = original[first : self.start] + self.text.encode() + original[self.end : last]
        return " ".join(original[first:last].decode().split()), " ".join(after.decode().split())


def variants(node: ast.AST) -> Iterator[ast.AST | str]:
    """What may stand in a node's place: nodes of the same kind with one thing changed."""
    match node:
        case ast.Compare(ops=[operator]):
            for other in COMPARISONS.get(type(operator), ()):
                yield ast.Compare(node.left, [other()], node.comparators)
        case ast.BinOp(left=left, op=operator, right=right):
            if type(operator) in OPERATORS:
                yield ast.BinOp(left, OPERATORS[type(operator)](), right)
            if isinstance(operator, ast.BitAnd):  # a mask is left out
                yield left
                yield right
            if isinstance(operator, ast.MatMult):
                yield ast.BinOp(right, operator, left)
        case ast.BoolOp(op=operator):
            yield ast.BoolOp(ast.Or() if isinstance(operator, ast.And) else ast.And(), node.values)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int())):
            # -1 for 1 is the same dimension or the one beside it, which changing the number tries
            pass
        case ast.UnaryOp(operand=operand):
            yield operand
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() as value):
            yield ast.Constant(value + 1)
            yield ast.Constant(value - 1)
        case ast.Constant(value=float() as value):
            yield ast.Constant(value + 1)
        case ast.IfExp():
            yield ast.IfExp(node.test, node.orelse, node.body)
        case ast.Subscript(slice=ast.Tuple(elts=[*others, first, second])):
            yield ast.Subscript(node.value, ast.Tuple([*others, second, first]))
        case ast.Attribute(attr="mT" | "T"):
            yield node.value
        case ast.Call():
            yield from call_variants(node)
        case ast.Break():
            yield "continue"
        case ast.Continue():
            yield "break"
        case ast.Return(value=ast.expr()):
            yield "return None"
        case ast.AugAssign(op=operator):
            yield "pass"
            if type(operator) in OPERATORS:
                yield ast.AugAssign(node.target, OPERATORS[type(operator)](), node.value)
        case ast.Expr(value=ast.Call()):
            yield "pass"


def call_variants(call: ast.Call) -> Iterator[ast.AST]:
    """A call with another function, without it, or with two arguments exchanged."""
    match call.func:
        case ast.Attribute(value=value, attr=name) if name in NAMES:
            yield ast.Call(ast.Attribute(value, NAMES[name]), call.args, call.keywords)
        case ast.Attribute(value=value, attr=name) if name in DROPPED:
            yield value
        case ast.Name(id=name) if name in NAMES:
            yield ast.Call(ast.Name(NAMES[name]), call.args, call.keywords)
    for first, second in ((0, 1), (1, 2)):
        if len(call.args) > second:
            args = list(call.args)
            args[first], args[second] = args[second], args[first]
            yield ast.Call(call.func, args, call.keywords)


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes whose change would change what the program does: no annotations, messages or
    docstrings.
    """
    yield tree
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list", "exc", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                yield from nodes(child)


def mutants(file: str) -> list[Mutant]:
    """All mutants of a file, in the order of its text."""
    source = (ROOT / file).read_bytes()
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    found = set()
    for node in nodes(ast.parse(source)):
        for variant in variants(node):
            text = variant if isinstance(variant, str) else ast.unparse(copy.deepcopy(variant))
            if isinstance(node, ast.expr) and not isinstance(
                variant, ast.Name | ast.Constant | ast.Call
            ):
                text = f"({text})"
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            found.add(Mutant(file, node.lineno, start, end, text))
    in_order = sorted(found, key=lambda mutant: (mutant.start, mutant.end, mutant.text))
    return [mutant for mutant in in_order if differs(mutant, source)]


def differs(mutant: Mutant, original: bytes) -> bool:
    """Whether a mutant is a program, and another one than the file."""
    try:
        return ast.dump(ast.parse(mutant.source(original))) != ast.dump(ast.parse(original))
    except SyntaxError:
        return False


def planted() -> list[Mutant]:
    """The bugs of ``PLANTED``; what stands in the place of each must be in its file once."""
    found = []
    for row in json.loads(PLANTED.read_text(encoding="utf-8")):
        source = (ROOT / row["file"]).read_bytes()
        before = row["before"].encode()
        if source.count(before) != 1:
            raise SystemExit(f"{PLANTED.name}: {row['file']} has not one {row['before']!r}.")
        start = source.index(before)
        line = source.count(b"\n", 0, start) + 1
        found.append(Mutant(row["file"], line, start, start + len(before), row["after"]))
    return found


def equivalent() -> dict[tuple[str, str, str], str]:
    """(file, line before, line after) -> the reason why no test can tell them apart."""
    rows = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    return {(row["file"], row["before"], row["after"]): row["reason"] for row in rows}


def run_tests(tests: list[str], work: Path, limit: float | None) -> str:
    """Run tests against the copy of ``src`` in ``work``: "passed", "failed" or "hangs"."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            status = _in_child(tests, work, cached=limit is None)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    end = time.monotonic() + (limit or 3600)
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return "passed" if status == 0 else "failed"
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hangs"


def _in_child(tests: list[str], work: Path, cached: bool) -> int:
    import pytest

    os.setsid()  # so that what the tests start ends with them
    with open(work / "log.txt", "wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os.chdir(ROOT)
    sys.path.insert(0, str(work / "src"))
    os.environ["PYTHONPATH"] = str(work / "src")
    sys.dont_write_bytecode = not cached
    found = importlib.util.find_spec("ghpt")
    if found is None or not str(found.origin).startswith(str(work)):
        return 1
    options = [
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        f"--basetemp={work / 'tests'}",
    ]
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins among the libraries
    if "PYTEST_DISABLE_PLUGIN_AUTOLOAD" not in os.environ:  # shapes in the signatures kill mutants
        options.append("--jaxtyping-packages=ghpt,beartype.beartype")
    return int(pytest.main([*options, *(f"tests/{test}" for test in tests)]))


def try_mutant(mutant: Mutant, work: Path, limit: float) -> str:
    """Return what the tests of the mutant's file say of it; the copy in ``work`` is restored."""
    path = work / mutant.file
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        compiled.unlink()  # may have the mutant's size and second
    original = path.read_bytes()
    path.write_bytes(mutant.source(original))
    try:
        return run_tests(TESTS[mutant.file], work, limit)
    finally:
        path.write_bytes(original)


def duration(file: str, work: Path) -> float:
    """How long the tests of an unchanged file take, s. They must pass."""
    start = time.monotonic()
    if run_tests(TESTS[file], work, None) != "passed":
        raise SystemExit(
            f"The tests of {file} fail without a mutant:\n{(work / 'log.txt').read_text()[-3000:]}"
        )
    return time.monotonic() - start


def share(
    chosen: list[Mutant], work: Path, same: dict[tuple[str, str, str], str]
) -> Iterator[dict]:
    """Try mutants one after another; yields a row for each."""
    shutil.copytree(ROOT / "src", work / "src", ignore=shutil.ignore_patterns("__pycache__"))
    limits: dict[str, float] = {}
    for mutant in chosen:
        before, after = mutant.change((work / mutant.file).read_bytes())
        row = {"file": mutant.file, "line": mutant.line, "before": before, "after": after}
        if (mutant.file, before, after) in same:
            yield row | {"result": "equivalent"}
            continue
        if mutant.file not in limits:
            limits[mutant.file] = 30 + 4 * duration(mutant.file, work)
        result = try_mutant(mutant, work, limits[mutant.file])
        yield row | {"result": "survived" if result == "passed" else "killed"}


def score(rows: list[dict]) -> tuple[int, int]:
    """Mutants that were killed, and those that could be."""
    killed = sum(row["result"] == "killed" for row in rows)
    return killed, killed + sum(row["result"] == "survived" for row in rows)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", nargs="+", help="which of the files of TESTS; all")
    parser.add_argument(
        "--planted",
        action="store_true",
        help="the bugs of planted_bugs.json instead of random ones",
    )
    parser.add_argument(
        "--count", type=int, default=100, help="how many mutants, drawn among all of these files"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--least", type=float, default=0.0, help="exit with 1 if a smaller share is killed"
    )
    parser.add_argument("--output", default="mutants.json")
    options = parser.parse_args()
    files = options.files or sorted(TESTS)
    every = (
        planted()
        if options.planted
        else [mutant for file in sorted(files) for mutant in mutants(file)]
    )
    if unknown := sorted({mutant.file for mutant in every} - set(TESTS)):
        parser.error(f"no tests are named for {', '.join(unknown)}: add them to TESTS")
    chosen = random.Random(options.seed).sample(every, min(options.count, len(every)))
    for library in LIBRARIES:
        importlib.import_module(library)
    import torch

    torch.set_num_threads(1)  # threads do not survive a fork
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for row in share(
            sorted(chosen, key=lambda m: (m.file, m.start)), Path(folder), equivalent()
        ):
            print(f"{row['result']:10} {row['file']}:{row['line']}", flush=True)
            print(f"    - {row['before']}\n    + {row['after']}", flush=True)
            rows.append(row)
    for file in sorted({row["file"] for row in rows}):
        killed, total = score([row for row in rows if row["file"] == file])
        print(f"{killed:4} of {total:4} killed  {file}")
    killed, total = score(rows)
    print(f"{killed:4} of {total:4} killed  (of {len(every)} possible; seed {options.seed})")
    from ghpt.files import atomic_write  # only now: the forks must import the mutants

    with atomic_write(options.output, "w") as handle:
        json.dump(
            {"seed": options.seed, "killed": killed, "total": total, "mutants": rows},
            handle,
            indent=1,
        )
    return int(killed < options.least * total)


if __name__ == "__main__":
    sys.exit(main())
