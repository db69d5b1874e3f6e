"""A5, checkpoints: nothing in a checkpoint runs, and a damaged or foreign one is refused with a reason."""

import copy
import io
import os
import pickle
import sys
import zipfile

import pytest
import torch

import toys
from ghpt.errors import GhptCheckpointError
from ghpt.models.checkpoint import FIELD, load_model, read_checkpoint
from ghpt.train import train

RAN = []


class Payload:
    """Runs a command when unpickled by a reader that lets it."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    config = copy.deepcopy(toys.TRAIN)
    config["trainer"]["max_epochs"] = 1
    train(config, folder)
    return folder / "last.ckpt"


def with_config(trained, path, **model):
    checkpoint = torch.load(trained, weights_only=True)
    checkpoint[FIELD]["config"]["model"] |= model
    torch.save(checkpoint, path)


def payloads(trained, sentinel):
    """Name -> function that writes a hostile checkpoint to a path."""
    command = f"touch {sentinel}"

    def pickled(value, protocol):
        def write(path):
            path.write_bytes(pickle.dumps(value, protocol=protocol))

        return write

    def saved(value, **options):
        return lambda path: torch.save(value, path, **options)

    def script(path):
        module = torch.jit.script(torch.nn.Linear(2, 2))
        torch.jit.save(module, str(path))

    def swapped_pickle(path):
        """A real checkpoint whose data.pkl is replaced."""
        with zipfile.ZipFile(trained) as old, zipfile.ZipFile(path, "w") as new:
            for item in old.infolist():
                evil = pickle.dumps(Payload(os.system, command), protocol=2)
                new.writestr(item, evil if item.filename.endswith("data.pkl") else old.read(item))

    evil = Payload(os.system, command)
    result = {f"pickle, protocol {p}": pickled({"state_dict": evil, FIELD: {}}, p) for p in range(6)}
    result |= {
        "zip": saved({"state_dict": {}, FIELD: evil}),
        "legacy tar": saved({"state_dict": {}, FIELD: evil}, _use_new_zipfile_serialization=False),
        "eval": saved({"state_dict": {"x": Payload(eval, f"__import__('os').system('{command}')")}, FIELD: {}}),
        "nested": saved({"state_dict": {"a": [{"b": (evil,)}]}, FIELD: {}}),
        "hyper_parameters": saved({"state_dict": {}, FIELD: {}, "hyper_parameters": evil}),
        "data.pkl swapped": swapped_pickle,
    }
    if sys.version_info < (3, 14):
        result["TorchScript"] = script
    targets = [
        "os.system",
        "ghpt.files.os.system",
        "logging.os.system",
        "builtins.eval",
        "ghpt.config.importlib.sys.exit",
    ]
    for target in targets:
        node = {"_target_": target, "command": command}
        result[f"_target_ {target}"] = lambda path, node=node: with_config(trained, path, problem=node)
    result["interpolation"] = lambda path: with_config(trained, path, hypotheses="${oc.env:HOME}")
    return result


@pytest.mark.filterwarnings("ignore:.torch.jit")  # deprecated, first as one category, then as another
def test_a5_no_checkpoint_runs_code(tmp_path, trained, record_row):
    sentinel, path = tmp_path / "sentinel", tmp_path / "evil.ckpt"
    watched, armed = [], []

    def audit(event, arguments):
        if armed and event in ("os.system", "subprocess.Popen", "socket.connect", "os.exec", "os.posix_spawn"):
            watched.append((event, arguments))

    sys.addaudithook(audit)
    refused, names = 0, payloads(trained, sentinel)
    for name, write in names.items():
        write(path)
        armed.append(True)
        try:
            with pytest.raises(GhptCheckpointError):
                load_model(path)
            refused += 1
        finally:
            armed.clear()
        assert not sentinel.exists(), name
    record_row("A5", f"{len(names)} hostile checkpoints: {len(watched)} ran code", refused, len(names))
    assert not watched


def test_a_good_one_loads(trained):
    model, ours = load_model(trained, hypotheses=5)
    assert model.hypotheses == 5
    assert model.scorer.standardise.fitted
    assert ours["provenance"]["data"] == "toy"


def test_truncated_and_flipped_checkpoints_are_refused(tmp_path, trained):
    whole, path = trained.read_bytes(), tmp_path / "cut.ckpt"
    for size in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(GhptCheckpointError, match=r"cut\.ckpt: cannot be read"):
            read_checkpoint(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: c.pop(FIELD), "is not a checkpoint of ghpt"),
        (lambda c: c[FIELD].update(format_version=99), "has format version 99"),
        (lambda c: c["state_dict"].popitem(), "does not fit its own model"),
        (lambda c: c[FIELD]["config"]["model"].update(colour=1), "does not fit its own model"),
        (lambda c: c[FIELD]["config"]["model"]["scorer"].update(layers=[7]), "does not fit its own model"),
        (lambda c: c[FIELD].pop("config"), "does not fit its own model"),
    ],
)
def test_another_models_checkpoint_is_refused(tmp_path, trained, change, reason):
    checkpoint = torch.load(io.BytesIO(trained.read_bytes()), weights_only=True)
    change(checkpoint)
    torch.save(checkpoint, tmp_path / "other.ckpt")
    with pytest.raises(GhptCheckpointError, match=reason):
        load_model(tmp_path / "other.ckpt")


def test_a_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(GhptCheckpointError, match=r"none\.ckpt: there is no such file"):
        load_model(tmp_path / "none.ckpt")
