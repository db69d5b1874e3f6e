"""The names that published models give to joints: marker sets for TRC and C3D files."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ghpt.config import CONF, read_yaml, suggest
from ghpt.errors import GhptConfigError, check
from ghpt.export.stream import Chunks
from ghpt.reconstruction import About

_FOLDER = CONF / "marker_sets"
_HINT = "See docs/outputs.md for what the file holds."
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MarkerSet:
    """The markers of a model, and the joint that each of them is."""

    name: str
    joints: Mapping[str, str]
    """The joint by the name of the marker."""

    def check_joints(self, joints: tuple[str, ...]) -> None:
        """Warn of markers that no joint gives. Raises GhptConfigError where there is no other."""
        absent = [marker for marker, joint in self.joints.items() if joint not in joints]
        problem = f"{self.name} has no marker among the joints"
        hint = f"The joints are {', '.join(joints)}."
        check(len(absent) < len(self.joints), "markers", problem, hint)
        if absent:
            text = "Markers of %s that these key points do not give are not in the files: %s."
            _log.warning(text, self.name, ", ".join(absent))

    def rename(self, about: About, chunks: Chunks) -> tuple[About, Chunks]:
        """Return what a file of markers holds: those that the joints give, by their names."""
        found = {
            marker: about.joints.index(joint)
            for marker, joint in self.joints.items()
            if joint in about.joints
        }
        chosen = torch.tensor(list(found.values()))
        renamed = replace(about, joints=tuple(found), bones=())
        return renamed, lambda: (chunk.select_joints(chosen) for chunk in chunks())


def find_marker_set(name: str) -> MarkerSet:
    """Return a marker set that ships, by name, or that of a yaml, by path.

    Raises GhptConfigError for a name that is not known, and for a file that is no marker set.
    """
    path = Path(name)
    if path.suffix.lower() not in (".yaml", ".yml"):
        known = {file.stem: file for file in _FOLDER.glob("*.yaml")}
        check(name in known, "markers", f"there is no {name!r}", suggest(name, known))
        path = known[name]
    content = read_yaml(path, "markers")
    joints = {marker: joint for marker, joint in content.items() if isinstance(joint, str)}
    if not joints or len(joints) != len(content):
        raise GhptConfigError("markers", f"{path} is no table of marker: joint", _HINT)
    return MarkerSet(path.stem, joints)
