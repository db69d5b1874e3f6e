"""The page's data, its player's logic in Node, and the page itself in a headless browser, where
these are installed.
"""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from importlib import resources

import matplotlib.image
import numpy as np
import pytest
import torch

from ghpt.export import WRITERS, Evidence, Scene
from ghpt.export.html import MOST_FRAMES
from ghpt.export.scene import Images, frustum, to_z_up, upward
from ghpt.geometry.cameras import project
from ghpt.geometry.lens import distort
from ghpt.reconstruction import State
from ghpt.skeleton import BONES, JOINT, JOINTS
from reconstructions import about, in_parts, random_reconstruction, rig

LOGIC = """
const fs = require("fs"), p = require(process.argv[2]);
const page = fs.readFileSync(process.argv[3], "utf8");
p.load(/application\\/json">(.*?)<\\/script>/s.exec(page)[1]).then(data => {
const { view } = p.overview(data, 800, 600);
const frames = Float64Array.of(3, 4, 8, 9);
console.log(JSON.stringify({
  count: data.frame.length, first: Array.from(data.points.slice(0, 3)),
  drawn: Array.from(data.frame, (_, i) => p.drawn(data, i).joints.map(j => [j.j, j.filled])),
  bones: p.drawn(data, 0).bones.length,
  none: p.drawn(data, -1), at: [2, 3, 3.9, 4.5, 5, 7.9, 8, 20].map(n => p.indexAt(frames, n, 1)),
  middle: p.look(view, view.target),
  behind: p.look({ ...view, yaw: 0, pitch: 0 }, [view.target[0], view.target[1] - 1e6, 0]),
  up: p.look(view, [view.target[0], view.target[1], view.target[2] + 100])[1] < 300,
  points: Array.from(data.points, value => Number.isNaN(value) ? 0 : value),
  cameras: data.cameras.map(camera => p.look(view, camera.centre)),
  pixels: data.cameras.map(camera => p.project(camera, [100, 200, 300])),
  errors: data.cameras.map((_, v) => p.viewError(data, v, 0)),
}));
});
"""


def scene():
    return Scene(rig(3))


def page(tmp_path, made, who=None, scene=None):
    WRITERS["html"].write(tmp_path / "poses.html", who or about(), in_parts(made), scene=scene)
    return (tmp_path / "poses.html").read_text(encoding="utf-8")


def data_of(text):
    return json.loads(re.search(r'application/json">(.*?)</script>', text, re.DOTALL)[1])


def in_browser(path, *options):
    browser = next(
        (
            found
            for name in ("chromium", "google-chrome", "chrome")
            if (found := shutil.which(name))
        ),
        None,
    )
    if browser is None:
        pytest.skip("no browser: chromium or google-chrome")
    command = [
        browser,
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--window-size=900,700",
        *options,
    ]
    run = subprocess.run(
        [*command, f"{path.as_uri()}"], capture_output=True, text=True, timeout=300, check=True
    )
    return run.stdout


def test_the_page_loads_nothing_and_tells_what_it_shows(tmp_path):
    text = page(tmp_path, random_reconstruction(20), scene=scene())
    assert not re.search(r"https?://|//cdn|src=|@import|fetch\(|XMLHttp", text)
    assert "default-src 'none'" in text
    data = data_of(text)
    assert data["title"] == "S1/Walking-1 (synthetic data)"
    assert [camera["name"] for camera in data["cameras"]] == ["cam_1", "cam_2", "cam_3"]
    assert "20 frames" in data["about"]


def test_names_cannot_become_code(tmp_path):
    who = replace(about(), name="</script><script>alert(1)</script>", source="<!--")
    text = page(tmp_path, random_reconstruction(3), who)
    assert text.count("</script>") == 2
    assert data_of(text)["title"].startswith("</script><script>alert(1)")


def test_long_recordings_are_thinned_with_a_note(tmp_path):
    made = random_reconstruction(2 * MOST_FRAMES + 5, joints=1)
    data = data_of(page(tmp_path, made, about(("a",))))
    assert data["stride"] == 3
    assert f"{len(made)} frames" in data["about"]
    assert "1 frame of 3, 26669 in all" in data["about"]
    assert data["frame"] == [[0, 3, 26669]]


def test_up_is_the_body_s(tmp_path):
    for axis, sign in ((0, 1), (1, -1), (2, 1), (2, -1)):
        up = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
        up[axis] = 50.0 * sign
        turn = to_z_up(up)
        assert (turn @ up)[2] == 50
        torch.testing.assert_close(turn @ turn.T, torch.eye(3, dtype=torch.float64))
        assert torch.linalg.det(turn) == 1
    assert torch.equal(
        to_z_up(torch.zeros(3, dtype=torch.float64)), torch.eye(3, dtype=torch.float64)
    )


def test_the_corners_of_a_frustum_are_the_image_s():
    cameras = rig(3)
    pixels, depth = project(cameras, frustum(cameras, 250.0).flatten(0, 1))
    own = torch.stack([pixels[v, 4 * v : 4 * v + 4] for v in range(3)])
    c = cameras.K[:, None, :2, 2]
    factors = c.new_tensor([[0, 0], [2, 0], [2, 2], [0, 2]])
    torch.testing.assert_close(own, c * factors, atol=1e-6, rtol=0)
    torch.testing.assert_close(depth[0, :4], depth.new_full((4,), 250.0))


def test_the_player_s_logic(tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to run the player's logic")
    made = random_reconstruction(6)
    cameras = rig(3)
    lens = torch.tensor(
        [[0.1, -0.2, 0.01, 0.02, 0.05, 0.1, 0, 0, 0], [0.1, 0.02, 0, 0, 0, 0, 0, 0, 1]]
    )
    lens = torch.cat([lens, torch.zeros(1, 9)]).double()
    ideal = project(cameras, made.points)[0]
    beside = ideal[:, 2] + torch.tensor([3.0, 4.0])  # the last view has an ideal lens
    key_points = torch.cat([ideal[:, :2], beside[:, None]], dim=1)
    evidence = Evidence(key_points, torch.ones(key_points.shape[:-1], dtype=torch.bool), None)
    shown = Scene(
        cameras,
        lambda: iter([evidence]),
        Images(lens, 2 * cameras.K[:, :2, 2]),
        tuple((joint, joint) for joint in range(17)),
    )
    page(tmp_path, made, scene=shown)
    (tmp_path / "logic.js").write_text(LOGIC, encoding="utf-8")
    player = resources.files("ghpt.export") / "player.js"
    command = [node, tmp_path / "logic.js", str(player), tmp_path / "poses.html"]
    found = json.loads(
        subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    )
    assert found["count"] == 6
    for t, joints in enumerate(found["drawn"]):
        placed = torch.nonzero(made.has_position[t])[:, 0].tolist()
        assert joints == [[j, bool(made.state[t, j] == State.FILLED)] for j in placed]
    assert found["bones"] == sum(bool(made.has_position[0, [a, b]].all()) for a, b in BONES)
    assert found["none"] == {"joints": [], "bones": []}
    assert found["at"] == [-1, 0, 0, 1, -1, -1, 2, -1]
    assert found["middle"][:2] == [400, 300]
    assert found["behind"] is None
    assert found["up"]
    for x, y, *_ in found["cameras"]:
        assert 0 < x < 800
        assert 0 < y < 600
    points = torch.tensor(found["points"], dtype=torch.float64).reshape(6, 17, 3)
    to_world = to_z_up(upward(JOINTS, made))
    points = points @ to_world
    there = made.has_position
    assert float((points - made.points)[there].abs().max()) <= 0.2501
    point = torch.tensor([[100.0, 200.0, 300.0]], dtype=torch.float64) @ to_world
    pixels = distort(project(cameras, point)[0], cameras.K, lens)[:, 0]
    np.testing.assert_allclose(np.array(found["pixels"]), pixels.numpy(), atol=1e-3)
    assert found["errors"][2] == pytest.approx(5, abs=0.5)


def test_the_page_in_a_browser_draws_observed_filled_and_nothing_missing(tmp_path):
    """Blue for the left side, orange for the right one, hollow or not, and no colour in a frame
    without joints.
    """
    made = random_reconstruction(3, missing=0.0)
    state = torch.full_like(made.state, State.FEW_VIEWS)
    left = [
        JOINT[f"left_{joint}"] for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ]
    state[0, left] = State.OBSERVED
    state[1, [JOINT["right_hip"], JOINT["right_knee"], JOINT["right_ankle"]]] = State.FILLED
    page(tmp_path, replace(made, state=state), scene=scene())
    counts = []
    for frame in range(3):
        shot = tmp_path / f"{frame}.png"
        copy = tmp_path / f"{frame}.html"
        copy.write_text(
            (tmp_path / "poses.html")
            .read_text(encoding="utf-8")
            .replace("window.location.hash", f'"#frame={frame}"'),
            encoding="utf-8",
        )
        in_browser(copy, f"--screenshot={shot}", "--virtual-time-budget=2000")
        image = np.round(matplotlib.image.imread(shot)[:500, :, :3] * 255).astype(int)
        near = [np.abs(image - colour).max(-1) < 12 for colour in ((0, 114, 178), (213, 94, 0))]
        counts.append([int(mask.sum()) for mask in near])
    (blue0, orange0), (blue1, orange1), last = counts
    assert blue0 > 100
    assert orange0 == 0
    assert blue1 == 0
    assert orange1 > 30
    assert last == [0, 0]


def test_the_page_in_a_browser_plays(tmp_path):
    text = page(tmp_path, random_reconstruction(300))
    # A headless browser paints too seldom to wait for.
    paints = "window.requestAnimationFrame = f => setTimeout(() => f(performance.now()), 16);"
    click = f'<script>{paints} document.getElementById("play").click()</script></body>'
    (tmp_path / "play.html").write_text(text.replace("</body>", click), encoding="utf-8")
    shown = in_browser(tmp_path / "play.html", "--dump-dom", "--virtual-time-budget=3000")
    frame = int(re.search(r'id="where">frame (\d+)', shown)[1])
    assert frame > 10
    assert ">Pause<" in shown
