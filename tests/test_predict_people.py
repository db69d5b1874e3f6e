"""predict.py with several people in view: everybody, one of them, and another run on fewer."""

import json
import shutil
import subprocess
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch

from ghpt.commands.outputs import OutputFolder
from ghpt.commands.predict import files, predict
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.export import read_reconstruction
from ghpt.geometry.cameras import project
from predicting import cameras_file, config, walk, write_people

pytestmark = pytest.mark.usefixtures("blank_figures")

FRAMES = 16
WORDS = ("rate_hz=50", "estimator=linear", "formats=[npz,html]")


def truths() -> list[torch.Tensor]:
    """Two walkers side by side, and one farther off who comes in for the last six frames."""
    first = walk()[:FRAMES]
    return [
        first,
        first.flip(0) + torch.tensor([0.0, 1400.0, 0.0]),
        first + 900.0 * torch.eye(3)[0],
    ]


def key_points(folder: Path) -> Path:
    """What four cameras see of them, exactly."""
    pixels = [project(human36m_rig("S9").cameras, points)[0] for points in truths()]
    for view in range(4):
        (folder / f"cam{view}_json").mkdir(parents=True)
        for frame in range(FRAMES):
            people = [own[frame, view] for own in pixels]
            there = people if frame >= 10 else people[:2]
            write_people(folder / f"cam{view}_json" / f"cam{view}_{frame:06d}.json", there)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("several")
    key_points(place / "pose")
    cameras_file(place)
    return place


def run(folder: Path, output: Path, *words: str):
    given = f"keypoints={folder / 'pose'}", f"cameras={folder / 'cameras.toml'}"
    settings = config(*given, *WORDS, f"output={output}", *words)
    with OutputFolder(output, files(settings)):
        return predict(settings, output)


@pytest.fixture(scope="module")
def everybody(folder):
    output = folder / "out"
    return run(folder, output), output


def points_of(path: Path) -> torch.Tensor:
    _, parts = read_reconstruction(path)
    return torch.cat([part.points for part in parts])


def test_everybody_has_files_of_their_own(everybody):
    """The one who is there for six frames is left out, and said."""
    _, output = everybody
    found = [points_of(output / name / "poses.npz") for name in ("", "person_1")]
    errors = [[float((a - b).norm(dim=-1).mean()) for b in truths()[:2]] for a in found]
    assert sorted(np.argmin(errors, 1).tolist()) == [0, 1]
    assert np.min(errors, 1).max() < 0.1
    assert not (output / "person_2").exists()


def test_the_first_result_lists_everybody(everybody):
    result, output = everybody
    assert len(result.people) == 2
    written = json.loads((output / "prediction.json").read_text())
    assert [person["verdict"] for person in written["people"]] == ["good", "good"]
    other = json.loads((output / "person_1" / "prediction.json").read_text())
    assert other["people"] == []


def test_the_player_shows_everybody(everybody):
    _, output = everybody
    page = (output / "poses.html").read_text(encoding="utf-8")
    data = json.loads(page.partition('application/json">')[2].partition("</script>")[0])
    assert [len(person) for person in data["people"]] == [17, 17]
    alone = (output / "person_1" / "poses.html").read_text(encoding="utf-8")
    data = json.loads(alone.partition('application/json">')[2].partition("</script>")[0])
    assert [len(person) for person in data["people"]] == [17]


HEADS = """
const fs = require("fs"), p = require(process.argv[1]);
const page = fs.readFileSync(process.argv[2], "utf8");
p.load(/application\\/json">(.*?)<\\/script>/s.exec(page)[1]).then(data =>
  console.log(JSON.stringify(p.heads(data, p.drawn(data, 0).joints).map(head => head.person))));
"""


def test_the_player_writes_names_where_there_are_several(everybody):
    _, output = everybody
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node")
    named = []
    for folder in (output, output / "person_1"):
        with resources.as_file(resources.files("ghpt.export") / "player.js") as player:
            command = [node, "-e", HEADS, str(player), str(folder / "poses.html")]
            run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
        named.append(json.loads(run.stdout))
    assert named == [[0, 1], []]


def test_one_who_is_asked_for_is_alone_and_the_others_files_go(everybody, folder):
    _, output = everybody
    second = points_of(output / "person_1" / "poses.npz")
    result = run(folder, output, "person=1")
    assert result.people == ()
    assert torch.equal(points_of(output / "poses.npz"), second)
    assert not (output / "person_1" / "poses.npz").exists()
