"""What a checkpoint may build: the classes that the parts of a model can have.

What comes out of a file must not choose what is run. A name in a checkpoint is therefore looked up
in ``PARTS`` and never imported. Only where the user names a package on the command line (``trust``)
are the classes that it defines imported by the names that the checkpoint gives.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import nn, optim
from torch.optim import lr_scheduler

from ghpt.config import build, locate, suggest
from ghpt.errors import GhptConfigError
from ghpt.models.joint.problem import JointSubsets
from ghpt.models.key_points.problem import KeyPointWeights
from ghpt.models.key_points.scorer import KeyPointScorer
from ghpt.models.loss import PrecisionLoss, StochasticLoss
from ghpt.models.module import StochasticEstimator
from ghpt.models.pose.authors import AuthorsScorer, WorldPoses
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.models.problem import Problem
from ghpt.models.relative_pose.problem import RelativePose
from ghpt.models.relative_pose.scale import BodyHeight, BoneLengths, KnownScale, Scale
from ghpt.models.scorer import Scorer

_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", re.ASCII)
_NEVER_TRUSTED = frozenset(sys.stdlib_module_names) | {"__main__", "ghpt", "torch"}
"""Packages that are not the user's own. What is harmless of ghpt and torch is in ``PARTS``."""


class Untrusted(GhptConfigError):
    """A configuration needs classes of packages that the user has not said to trust."""


@dataclass
class Part:
    """A key of a model's configuration that names a class."""

    kind: type
    """What a class must be derived from."""
    partial: bool = False
    """Whether the model gives the last arguments itself (``_partial_: true``)."""
    classes: dict[str, type] = field(default_factory=dict)
    """The classes that need no trust, by their full names."""


PARTS = {
    "model": Part(StochasticEstimator),
    "model.problem": Part(Problem),
    "model.problem.scale": Part(Scale),
    "model.scorer": Part(nn.Module, partial=True),
    "model.loss": Part(nn.Module),
    "model.optimizer": Part(optim.Optimizer, partial=True),
    "model.schedule": Part(lr_scheduler.LRScheduler, partial=True),
}


def register(part: str, *classes: type) -> None:
    """Let a checkpoint build these classes as this part of a model.

    Their constructors must do nothing but keep their arguments and make weights.
    """
    for one in classes:
        PARTS[part].classes[f"{one.__module__}.{one.__qualname__}"] = one


register("model", StochasticEstimator)
register(
    "model.problem",
    PoseTriangulation,
    JointSubsets,
    KeyPointWeights,
    WorldPoses,
    RelativePose,
)
register("model.problem.scale", KnownScale, BodyHeight, BoneLengths)
register("model.scorer", Scorer, KeyPointScorer, AuthorsScorer)
register("model.loss", StochasticLoss, PrecisionLoss)
register(
    "model.schedule",
    lr_scheduler.ConstantLR,
    lr_scheduler.CosineAnnealingLR,
    lr_scheduler.CosineAnnealingWarmRestarts,
    lr_scheduler.ExponentialLR,
    lr_scheduler.LinearLR,
    lr_scheduler.MultiStepLR,
    lr_scheduler.PolynomialLR,
    lr_scheduler.StepLR,
)
for _name, _one in vars(optim).items():
    if isinstance(_one, type) and issubclass(_one, optim.Optimizer) and _one is not optim.Optimizer:
        register("model.optimizer", _one)
        PARTS["model.optimizer"].classes[f"torch.optim.{_name}"] = _one


def build_registered(config: Any, trust: Sequence[str] = ()) -> Any:
    """Build a model from the plain configuration that a checkpoint holds.

    ``trust``: modules and packages of the user's own whose classes the checkpoint may name too.
    Every class is looked up before the first is built. Raises Untrusted for a package not in
    ``trust``, GhptConfigError for a class that may not stand where it stands and for what `build`
    raises it.
    """
    if not isinstance(config, Mapping) or "_target_" not in config:
        raise GhptConfigError("model", "names no class", "Give a checkpoint that train.py wrote.")
    untrusted = [name for name in packages_to_trust(config) if not _is_within(name, trust)]
    if untrusted:
        words = ",".join(dict.fromkeys([*trust, *untrusted]))
        raise Untrusted(
            "model",
            f"needs classes of {', '.join(untrusted)}, which are not ghpt's",
            f"To run their code, which can do anything, add to the command: 'trust=[{words}]'.",
        )
    found = _classes(config, trust)
    return build(config, "model", lambda node, path: found[node["_target_"]])


def check_registered(config: Mapping[str, Any]) -> None:
    """Raise GhptConfigError if no checkpoint with this configuration can be built."""
    _classes(config, packages_to_trust(config))


def check_trust(trust: Sequence[str]) -> None:
    """Raise GhptConfigError unless these are names of modules that can be the user's own."""
    for name in trust:
        if not _NAME.fullmatch(name) or name.split(".")[0] in _NEVER_TRUSTED:
            hint = "Name the module of your classes, as in trust=[mypackage.scorers]."
            problem = f"{name!r} is no module of your own (Python, ghpt and torch are not)"
            raise GhptConfigError("trust", problem, hint)


def packages_to_trust(config: Mapping[str, Any]) -> list[str]:
    """Return the modules of the user's own classes in a model's configuration, by name."""
    targets = [node["_target_"] for _, node, _ in _nodes(config, "model")]
    return sorted({target.rpartition(".")[0] for target in targets if _is_users(target)})


def _nodes(
    config: Any,
    path: str,
    inside: bool = False,
) -> Iterator[tuple[str, Mapping[str, Any], bool]]:
    """Yield each node with ``_target_``: path, node, whether it is inside a class of the user's."""
    if isinstance(config, Mapping):
        if "_target_" in config:
            yield path, config, inside
            inside = inside or _is_users(config["_target_"])
        for key, value in config.items():
            yield from _nodes(value, f"{path}.{key}", inside)
    elif isinstance(config, list | tuple):
        for number, value in enumerate(config):
            yield from _nodes(value, f"{path}[{number}]", inside)


def _classes(config: Mapping[str, Any], trust: Sequence[str]) -> dict[str, type]:
    """Return the class of every name in a model's configuration."""
    nodes = _nodes(config, "model")
    return {node["_target_"]: _class(node, path, inside, trust) for path, node, inside in nodes}


def _is_users(target: Any) -> bool:
    """Return whether a name can be that of a class of the user's own."""
    if not (isinstance(target, str) and "." in target and _NAME.fullmatch(target)):
        return False
    return target.split(".")[0] not in _NEVER_TRUSTED


def _is_within(module: str, packages: Sequence[str]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def _class(node: Mapping[str, Any], path: str, inside: bool, trust: Sequence[str]) -> type:
    """Return the class of a node.

    What is ``inside`` a class of the user's is that class's business: it may be any registered
    class, and any of the trusted packages.
    """
    target = node["_target_"]
    part = None if inside else PARTS.get(path)
    if part is None and not inside:
        raise GhptConfigError(path, "is no place for a class", f"Existing: {', '.join(PARTS)}.")
    if part is not None and node.get("_partial_", False) is not part.partial:
        raise GhptConfigError(f"{path}._partial_", f"is not {part.partial}", "Train again.")
    registered: dict[str, type] = {}
    for one in PARTS.values() if part is None else (part,):
        registered |= one.classes
    if isinstance(target, str) and target in registered:
        return registered[target]
    if not _is_users(target):
        raise GhptConfigError(
            f"{path}._target_",
            f"{target!r} is no class that a checkpoint may name here",
            suggest(str(target), registered),
        )
    return _users_class(node, path, part.kind if part else object, trust)


def _users_class(node: Mapping[str, Any], path: str, kind: type, trust: Sequence[str]) -> type:
    """Import a class of a trusted package."""
    key = f"{path}._target_"
    target = node["_target_"]
    try:
        found = locate(node, path)
    except GhptConfigError:
        raise
    except Exception as error:  # whatever the user's own module raises
        problem = f"{target} cannot be imported ({type(error).__name__}: {error})"
        raise GhptConfigError(key, problem, "Mend that module.") from error
    if not isinstance(found, type):
        raise GhptConfigError(key, f"{target} is no class", "Name a class.")
    if not _is_within(found.__module__, trust):
        problem = f"{target} is defined elsewhere, in {found.__module__}"
        raise GhptConfigError(key, problem, "Train with the name of the module that defines it.")
    if not issubclass(found, kind):
        name = f"{kind.__module__}.{kind.__qualname__}"
        raise GhptConfigError(key, f"{target} is no {name}", "Derive it from that class.")
    return found
