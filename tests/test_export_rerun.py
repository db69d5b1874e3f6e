"""The Rerun recording, where rerun-sdk is installed; and that its absence is named."""

import importlib.util
import re
import subprocess
import sys

import pytest
import torch

from ghpt.errors import GhptConfigError
from ghpt.export import WRITERS, Evidence, Scene
from ghpt.export.stream import part
from reconstructions import about, in_parts, random_reconstruction, rig


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(GhptConfigError, match=r"rerun: needs rerun-sdk.*pip install rerun-sdk"):
        WRITERS["rerun"].write(tmp_path / "poses.rrd", about(), in_parts(random_reconstruction(3)))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def entities(tmp_path_factory):
    """What Rerun's own program finds in a recording of three views: the paths of its entities."""
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("rerun-sdk, 170 MB, comes with ghpt[viz]")
    folder = tmp_path_factory.mktemp("rerun")
    made = random_reconstruction(20)
    evidence = Evidence(torch.randn(20, 3, 17, 2), made.views, torch.randn(20, 4, 17, 3))
    parts = [evidence.part(0, 7), evidence.part(7, 20)]
    scene = Scene(rig(3), lambda: iter(parts))
    WRITERS["rerun"].write(
        folder / "poses.rrd",
        about(cameras=("a/b", "..", "c d")),
        in_parts(part(made, 0, 7), part(made, 7, 20)),
        scene=scene,
    )
    assert [path.name for path in folder.iterdir()] == ["poses.rrd"]
    command = [sys.executable, "-m", "rerun_cli", "rrd", "stats", str(folder / "poses.rrd")]
    stats = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    return re.findall(r"^(/.*): \d+$", stats, re.MULTILINE)


def test_the_recording_has_cameras_rays_key_points_joints_and_hypotheses(entities):
    paths = " ".join(entities)
    for entity in (
        "/world/joints",
        "/world/bones",
        "/world/hypotheses",
        "/world/rays/",
        "key_points",
        "reprojected",
    ):
        assert entity in paths


def test_the_viewer_opens_with_3d_images_and_the_error_and_without_rays(entities):
    kinds = [re.sub(r"/[0-9a-f-]{36}", "", path) for path in entities]
    assert kinds.count("/view") == 1 + 3 + 1
    hidden = "/view/ViewContents/overrides/world/{}/visualizers"
    assert {hidden.format("rays"), hidden.format("hypotheses")} <= set(kinds)


def test_the_world_says_which_way_is_up(entities):
    assert "/world" in entities
