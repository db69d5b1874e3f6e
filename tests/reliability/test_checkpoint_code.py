"""A5, checkpoints: nothing in a checkpoint runs, however it is named."""

import copy
import importlib
import os
import pickle
import sys
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

import ghpt.config
import ghpt.models.checkpoint
import toys
from auditing import watch
from ghpt import files
from ghpt.config import build, locate
from ghpt.errors import GhptCheckpointError
from ghpt.models.checkpoint import FIELD, load_model
from signing import checkpoint_around, save_pickle, save_signed, signed, text
from toys import train

WATCHED = (
    "os.",
    "subprocess.",
    "socket.",
    "shutil.",
    "ctypes.",
    "signal.",
    "tempfile.",
    "code.__new__",
)
HARMLESS = ("os.listdir", "os.scandir", "os.walk", "os.fwalk", "os.getxattr", "os.listxattr")


class Call:
    """Pickles as a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    config = copy.deepcopy(toys.TRAIN)
    config["trainer"]["max_epochs"] = 1
    train(config, folder)
    return folder / "last.ckpt"


@pytest.fixture
def victim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the user's, and a module that changes it when it is imported or called."""
    folder = tmp_path / "victim"
    code = tmp_path / "code"
    code.mkdir()
    (code / "evil_module.py").write_text(
        f"import pathlib\nfolder = pathlib.Path({str(folder)!r})\n"
        "(folder / 'imported').touch()\n\n\n"
        "class Evil:\n    def __init__(self):\n        (folder / 'built').touch()\n"
    )
    monkeypatch.syspath_prepend(str(code))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def lay_out(folder: Path) -> None:
    """The folder as it was before; the module is not imported."""
    sys.modules.pop("evil_module", None)
    importlib.invalidate_caches()
    files.shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "keep.txt").write_text("mine")
    (folder / f".keep.{files._HOST}-99999999-00000000.tmp").write_text("of a writer that died")


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path): path.read_bytes() if path.is_file() else b""
        for path in sorted(folder.rglob("*"))
    }


def targets(victim: Path, ckpt: Path) -> dict[str, dict[str, Any]]:
    """Name -> what stands in place of the model's problem."""
    touch = ["touch", str(victim / "ran")]
    order = (
        b'{"_target_": "subprocess.call", "args": ["touch", "'
        + str(victim / "ran").encode()
        + b'"]}'
    )
    evil = {"_target_": "evil_module.Evil"}
    folder = str(victim)
    listed: dict[str, dict[str, Any]] = {
        # those of the system
        "os.system": {"command": "true"},
        "os.getcwd": {},
        "subprocess.call": {"args": touch},
        "shutil.rmtree": {"path": folder},
        "tempfile.mkdtemp": {},
        "pathlib.Path": {},
        "builtins.dict": {"a": 1},
        "torch.load": {"f": str(ckpt)},
        "torch.hub.get_dir": {},
        "evil_module.Evil": {},
        # by another name of ours
        "ghpt.files.shutil.rmtree": {"path": folder},
        "ghpt.files.os.getcwd": {},
        "ghpt.provenance.subprocess.call": {"args": touch},
        "ghpt.config.importlib.import_module": {"name": "evil_module"},
        "ghpt.config.functools.partial": {
            "func": {"_target_": "ghpt.config.suggest", "_partial_": True}
        },
        "torch.optim.adam.torch.load": {"f": str(ckpt)},
        "ghpt.models.registry.sys.exit": {},
        # ours, which read
        "ghpt.export.npz.read_reconstruction": {"path": str(ckpt)},
        "ghpt.data.formats.camera_files.read_cameras": {"path": str(ckpt)},
        "ghpt.data.formats.key_points.read_key_points": {"path": str(ckpt)},
        "ghpt.data.datasets.store.open_store": {"folder": folder},
        "ghpt.data.datasets.store.cache_root": {},
        "ghpt.models.predictions.open_predictions": {"path": str(ckpt), "schema": None},
        "ghpt.models.checkpoint.read_checkpoint": {"path": str(ckpt)},
        "ghpt.models.checkpoint.load_model": {"path": str(ckpt), "trust": ["evil_module"]},
        # ours, which write and delete
        "ghpt.files.sweep_temporaries": {"folder": folder},
        "ghpt.files.atomic_write": {"path": f"{folder}/keep.txt"},
        "ghpt.files.atomic_folder": {"path": folder},
        "ghpt.files.write_json": {"path": f"{folder}/keep.txt", "content": {}},
        "ghpt.report.markdown.write_markdown": {"path": f"{folder}/keep.txt", "document": {}},
        "ghpt.report.tensorboard.write_parts": {"folder": f"{folder}/events", "parts": {}},
        "ghpt.models.rows.RowWriter": {"folder": folder, "count": 1, "layout": {}},
        "ghpt.data.datasets.store.write_store": {
            "folder": f"{folder}/store",
            "recordings": [],
            "provenance": {},
        },
        # ours, which build, start or change something
        "ghpt.config.build": {
            "config": {"_target_": "ghpt.commands.prediction.shards._parse", "line": order}
        },
        "ghpt.config._is_module": {"name": "evil_module"},
        "ghpt.models.registry.check_trust": {"trust": ["mine"]},
        "ghpt.models.registry.register": {"part": "model.problem"},
        "ghpt.models.registry.Part": {
            "kind": {"_target_": "ghpt.config.suggest", "_partial_": True}
        },
        "ghpt.provenance.commit": {},
        "ghpt.provenance.provenance": {"seed": 0},
        "ghpt.commands.app.quieten": {},
        "ghpt.commands.jobs.take_signals": {},
        "ghpt.commands.jobs.first_of_several_ends": {},
        "ghpt.commands.trainer.make_trainer": {"settings": {"logger": False}},
        "ghpt.commands.train.train": {"settings": {}, "output": {"_target_": "ghpt.files.Path"}},
        "ghpt.commands.test.test": {"settings": {}, "output": {"_target_": "ghpt.files.Path"}},
        "ghpt.paper.engine.tasks.read_json": {"path": {"_target_": "ghpt.files.Path"}},
        "ghpt.paper.engine.setup.compose": {
            "conf": {"_target_": "ghpt.files.Path"},
            "name": "x",
            "overrides": [],
        },
        # our classes, and torch's, that no checkpoint has a use for
        "ghpt.models.checkpoint.AtomicCheckpointIO": {},
        "ghpt.models.callbacks.Progress": {},
        "ghpt.models.callbacks.LogHyperparameters": {"values": {}},
        "ghpt.report.logger.ForgivingTensorBoard": {"save_dir": {"_target_": "ghpt.files.Path"}},
        "ghpt.errors.GhptConfigError": {"key": "a", "problem": "b", "hint": "c"},
        "ghpt.models.estimators.classical.Linear": {},
        "ghpt.data.datasets.pairs.PairSettings": {"frames": 8, "draws": 1, "points": 10},
        "torch.nn.Identity": {},
        "torch.nn.modules.module.Module": {},
        "torch.optim.Optimizer": {"params": [], "defaults": {}},
    }
    found = {
        f"_target_ {name}": {"_target_": name, **arguments} for name, arguments in listed.items()
    }
    good = toys.MODEL["problem"]
    found |= {
        "evil as an argument": good | {"coordinates": evil},
        "evil in a list of an argument": good | {"lengths": [evil]},
        "evil in a group of an argument": good | {"lengths": {"a": {"b": evil}}},
        "evil for another part's class": {
            "_target_": "ghpt.models.loss.StochasticLoss",
            "alpha": evil,
        },
        "evil, partial": evil | {"_partial_": True},
    }
    return found


def save_with(trained: Path, path: Path, **model: Any) -> None:
    """A checkpoint whose model has other settings."""
    checkpoint = torch.load(trained, weights_only=True)
    checkpoint[FIELD]["config"]["model"] |= model
    save_signed(checkpoint, path)


def test_a5_no_checkpoint_chooses_what_is_run(
    tmp_path: Path, trained: Path, victim: Path, record_row: Callable[..., None]
) -> None:
    path = tmp_path / "evil.ckpt"
    load_model(trained)  # what is imported at the first use is not the payload's doing
    refused, cases = [], targets(victim, trained)
    for name, problem in cases.items():
        save_with(trained, path, problem=problem)
        lay_out(victim)
        before = content(victim)
        with (
            watch(WATCHED, HARMLESS) as valid,
            pytest.raises(GhptCheckpointError, match=r"evil\.ckpt: ") as caught,
        ):
            load_model(path)
        assert "\n" not in str(caught.value)
        if not valid and content(victim) == before and "evil_module" not in sys.modules:
            refused.append(name)
    record_row("A5", f"{len(cases)} targets in checkpoints, none called", len(refused), len(cases))
    assert refused == list(cases)


def test_every_payload_would_be_called_if_any_target_could_be_named(
    tmp_path: Path, trained: Path, victim: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test above would pass with payloads that do nothing."""
    called: list[Any] = []
    check = ghpt.config.check_arguments

    def passed(target: Any, *arguments: Any) -> None:
        check(target, *arguments)
        called.append(target)  # what comes next is the call

    monkeypatch.setattr(ghpt.config, "check_arguments", passed)
    monkeypatch.setattr(ghpt.models.checkpoint, "check_plain", lambda *_: None)
    monkeypatch.setattr(
        ghpt.models.checkpoint, "build_registered", lambda config, trust=(): build(config, "model")
    )
    path = tmp_path / "evil.ckpt"
    reached, changed, cases = [], [], targets(victim, trained)
    for name, problem in cases.items():
        save_with(trained, path, problem=problem)
        lay_out(victim)
        before = content(victim)
        called.clear()
        with watch(WATCHED, HARMLESS) as valid, suppress(Exception, SystemExit):
            load_model(path)
        wanted = problem if name.startswith("_target_") else {"_target_": "evil_module.Evil"}
        if locate(wanted, "") in called:
            reached.append(name)
        if valid or content(victim) != before:
            changed.append(name)
    print("reached the system:", changed)
    assert reached == list(cases)
    assert {"_target_ ghpt.config.build", "_target_ ghpt.files.sweep_temporaries"} <= set(changed)
    assert len(changed) >= 20


def pickles(trained: Path, sentinel: Path) -> dict[str, Callable[[Path], Any]]:
    """Name -> function that writes a checkpoint that would run a command when unpickled by a reader
    that lets it.
    """
    command = f"touch {sentinel}"
    evil = Call(os.system, command)

    def swapped_pickle(path: Path) -> None:
        with zipfile.ZipFile(trained) as old:
            names = old.namelist()
        assert any(name.endswith("data.pkl") for name in names)
        save_pickle(pickle.dumps(evil, protocol=2), path)

    def script(path: Path) -> None:
        torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), str(path))
        path.write_bytes(signed(path.read_bytes()))

    def pickled(protocol: int) -> Callable[[Path], Any]:
        content = pickle.dumps({"state_dict": evil, FIELD: {}}, protocol=protocol)
        return lambda path: path.write_bytes(signed(content))

    def saved(value: Any, **options: Any) -> Callable[[Path], Any]:
        return lambda path: save_signed(value, path, **options)

    found = {f"pickle, protocol {protocol}": pickled(protocol) for protocol in range(6)}
    found |= {
        "zip": saved({"state_dict": {}, FIELD: evil}),
        "legacy tar": saved({"state_dict": {}, FIELD: evil}, _use_new_zipfile_serialization=False),
        "eval": saved(
            {"state_dict": {"x": Call(eval, f"__import__('os').system('{command}')")}, FIELD: {}}
        ),
        "nested": saved({"state_dict": {"a": [{"b": (evil,)}]}, FIELD: {}}),
        "hyper_parameters": saved({"state_dict": {}, FIELD: {}, "hyper_parameters": evil}),
        "data.pkl swapped": swapped_pickle,
    }
    if sys.version_info < (3, 14):
        found["TorchScript"] = script
    return found


@pytest.mark.filterwarnings(
    "ignore:.torch.jit"
)  # deprecated, first as one category, then as another
def test_a5_no_pickle_runs(tmp_path: Path, trained: Path, record_row: Callable[..., None]) -> None:
    """They are signed: whoever can write a checkpoint can sign it."""
    sentinel, path = tmp_path / "sentinel", tmp_path / "evil.ckpt"
    refused, cases = [], pickles(trained, sentinel)
    for name, write in cases.items():
        write(path)
        with (
            watch(WATCHED, HARMLESS) as valid,
            pytest.raises(GhptCheckpointError, match=r"evil\.ckpt: "),
        ):
            load_model(path)
        if not valid and not sentinel.exists():
            refused.append(name)
    record_row("A5", f"{len(cases)} pickles in checkpoints, none run", len(refused), len(cases))
    assert refused == list(cases)


SCORER = toys.MODEL["scorer"]
ADAM = toys.MODEL["optimizer"]
SHAPES = {
    "target is a list": {"problem": {"_target_": ["os.system"]}},
    "target is a group": {"problem": {"_target_": {"_target_": "os.system"}}},
    "target is a number": {"problem": {"_target_": 3}},
    "target is null": {"problem": {"_target_": None}},
    "target is empty": {"problem": {"_target_": ""}},
    "target of dots": {"problem": {"_target_": "..."}},
    "target is a module": {"problem": {"_target_": "ghpt.files"}},
    "target with a newline": {
        "problem": {"_target_": "ghpt.models.pose.problem.PoseTriangulation\n"}
    },
    "target with a space": {"problem": {"_target_": " ghpt.models.pose.problem.PoseTriangulation"}},
    "target relative": {"problem": {"_target_": ".pose.PoseTriangulation"}},
    "registered for another part": {"problem": toys.MODEL["loss"]},
    "an optimizer as the scorer": {"scorer": ADAM},
    "a class where a number stands": {"hypotheses": toys.MODEL["problem"]},
    "a class where text stands": {"selection": toys.MODEL["problem"]},
    "a class under a name of nobody": {"another": toys.MODEL["problem"]},
    "a class in a list": {"hypotheses": [toys.MODEL["problem"]]},
    "not partial": {"scorer": {k: v for k, v in SCORER.items() if k != "_partial_"}},
    "partial": {"problem": toys.MODEL["problem"] | {"_partial_": True}},
    "partial by a number": {"scorer": SCORER | {"_partial_": 1}},
    "no optimizer": {"optimizer": ADAM | {"_target_": "torch.optim.Optimizer"}},
    "a scheduler": {"optimizer": ADAM | {"_target_": "torch.optim.lr_scheduler.StepLR"}},
    "an optimizer of nobody": {"optimizer": ADAM | {"_target_": "torch.optim.adam.Adam.__init__"}},
    "an interpolation": {"hypotheses": "${oc.env:HOME}"},
    "a tensor": {"hypotheses": torch.tensor(5)},
    "a group with numbers as keys": {"problem": toys.MODEL["problem"] | {1: 2}},
    "a set": {"problem": {1, 2}},
    "a dtype": {"problem": torch.float32},
    "a number of 10,000 digits": {"hypotheses": 10**10_000},
    "negative hypotheses": {"hypotheses": -5},
    "more hypotheses than fit": {"hypotheses": 10**9},
    "layers of a terabyte": {"scorer": SCORER | {"layers": [500_000, 500_000]}},
    "very many layers": {"scorer": SCORER | {"layers": [1] * 150_000}},
    "infinite temperature": {"temperature": float("inf")},
    "a text of escapes": {"selection": "\x1b[31m\nrm"},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_configuration_of_another_shape_is_refused(
    tmp_path: Path, trained: Path, shape: str
) -> None:
    path = tmp_path / "evil.ckpt"
    save_with(trained, path, **SHAPES[shape])
    with pytest.raises(GhptCheckpointError, match=r"evil\.ckpt: ") as caught:
        load_model(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600 + len(str(path))


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        ("a class under a name of nobody", r"model\.another: is no place for a class"),
        (
            "registered for another part",
            r"model\.problem\._target_: .* is no class that a checkpoint may name here",
        ),
        ("not partial", r"model\.scorer\._partial_: is not True"),
        ("partial", r"model\.problem\._partial_: is not False"),
    ],
)
def test_a_class_stands_only_in_its_place(
    tmp_path: Path, trained: Path, shape: str, reason: str
) -> None:
    path = tmp_path / "evil.ckpt"
    save_with(trained, path, **SHAPES[shape])
    with pytest.raises(GhptCheckpointError, match=reason):
        load_model(path)


@pytest.mark.parametrize(
    "model",
    [
        b"]" * 50_000 + b"a" * 49_999,
        (b"}" + text("a")) * 50_000 + b"}" + b"s" * 50_000,
        # 30 lists, each with the one before twice: a thousand million values
        b"](" * 30 + b"]" + b"".join(b"q%ch%ce" % (i, i) for i in range(30)),
    ],
    ids=["lists", "groups", "laughs"],
)
def test_a_deep_configuration_is_refused(tmp_path: Path, model: bytes) -> None:
    path = tmp_path / "evil.ckpt"
    save_pickle(checkpoint_around(model), path)
    with pytest.raises(GhptCheckpointError, match="is larger than any configuration"):
        load_model(path)


def test_no_memory_is_taken_for_weights_that_are_not_there(
    tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The layers that a checkpoint speaks of, beside those that it holds."""
    devices: list[str] = []
    fill = torch.nn.Linear.reset_parameters

    def filled(layer: torch.nn.Linear) -> None:
        devices.append(layer.weight.device.type)
        fill(layer)

    monkeypatch.setattr(torch.nn.Linear, "reset_parameters", filled)
    path = tmp_path / "evil.ckpt"
    save_with(trained, path, scorer=SCORER | {"layers": [33, 16]})
    with pytest.raises(GhptCheckpointError, match="does not fit its own model"):
        load_model(path)
    assert devices == ["meta"] * 3


def test_a_good_one_loads(trained: Path) -> None:
    model, ours = load_model(trained, hypotheses=5)
    assert model.hypotheses == 5
    assert model.scorer.standardise.fitted
    assert ours["provenance"]["data"] == "toy"


def test_the_hostile_ones_are_otherwise_good(tmp_path: Path, trained: Path) -> None:
    """They are refused for what they hold, not for how they are written here."""
    path = tmp_path / "good.ckpt"
    save_with(trained, path)
    assert load_model(path)[0].hypotheses == toys.MODEL["hypotheses"]
    save_pickle(checkpoint_around(b"}"), path)
    with pytest.raises(GhptCheckpointError, match="names no class"):
        load_model(path)
