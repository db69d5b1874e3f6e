"""Draw the pictures of README.md and the documentation into docs/images.

``python scripts/pictures.py`` draws the vectors. The animation is of a synthetic person before the
cameras of Human3.6M; the others are cut out of the reports of ``predict.py``, ``calibrate.py`` and
``cameras.py`` on synthetic recordings. docs/images/sources.json keeps the digests of the code that
each is made by, and a test compares them.

With ``--browser COMMAND`` it also makes the pictures of whole pages, which take a browser: a
command with ``{url}``, ``{out}``, ``{width}`` and ``{height}`` that writes a PNG, such as
``chromium --headless --screenshot={out} --window-size={width},{height} {url}``. ``--page URL
NAME`` makes one of them of a page that is there already, of TensorBoard say.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

import ghpt
from ghpt.data.synthetic.recordings import draw_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.geometry.cameras import project
from ghpt.skeleton import BONES, JOINTS

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "images"
DIGESTS = FOLDER / "sources.json"
REPORT = "src/ghpt/report"
SOURCES = {
    "walk.svg": ("scripts/pictures.py",),
    "predict-course.svg": (f"{REPORT}/course_figure.py", f"{REPORT}/course.py"),
    "calibrate-rig.svg": (f"{REPORT}/rig_figure.py",),
    "cameras-rig.svg": (f"{REPORT}/rig_figure.py",),
    "player.png": ("src/ghpt/export/player.html", "src/ghpt/export/player.js"),
    "predict-report.png": (f"{REPORT}/page.html", "src/ghpt/commands/prediction/page.py"),
    "cameras-report.png": (f"{REPORT}/page.html", f"{REPORT}/camera_check.py"),
    "calibrate-report.png": (f"{REPORT}/page.html",),
    "tensorboard.png": (f"{REPORT}/tensorboard.py", f"{REPORT}/logger.py"),
}
"""The code that decides on a picture's looks."""
REPORTS = {
    "predict-course.svg": ("predict.py", "data=h36m"),
    "calibrate-rig.svg": ("calibrate.py", "data=h36m"),
    "cameras-rig.svg": ("cameras.py", "data=h36m", "spoil=one_rotation_transposed"),
}
"""The commands whose reports hold a picture: the first one in the report."""


@dataclass(frozen=True)
class Screen:
    """A page of a command's output, as a browser shows it."""

    report: str
    """The picture of ``REPORTS`` whose command writes it."""
    page: str
    width: int
    height: int


SCREENS = {
    "player.png": Screen("predict-course.svg", "poses.html#frame=300", 1200, 720),
    "predict-report.png": Screen("predict-course.svg", "report.html", 1100, 1000),
    "calibrate-report.png": Screen("calibrate-rig.svg", "report.html", 1100, 1000),
    "cameras-report.png": Screen("cameras-rig.svg", "report.html", 1100, 1250),
}
TENSORBOARD = (1400, 900)
"""Width and height of the picture of TensorBoard."""
_COLOURS = 128
FRAMES = 200
_EVERY = 6
"""The animation keeps every sixth of 50 frames a second, and browsers draw what is between."""
_NOISE_PX = 6.0
_OUTLIERS = 0.03
_OUTLIER_PX = 60.0
_PANEL = 150
_STYLE = (
    "path{fill:none;stroke-linecap:round;stroke-linejoin:round;stroke-width:3}"
    ".left{stroke:#0072b2}.right{stroke:#d55e00}.middle{stroke:#444}"
    ".point{stroke:#e69f00;stroke-width:5}.frame{fill:#f4f4f2;stroke:#ddd;stroke-width:1}"
    "text{font:13px system-ui,sans-serif;fill:#555}"
    "@media(prefers-color-scheme:dark){.left{stroke:#56b4e9}.right{stroke:#ff8c42}"
    ".middle{stroke:#ccc}.frame{fill:#212429;stroke:#3a3d42}text{fill:#aaa}}"
)


def draw_walk() -> str:
    """Return the animation: what four views see, and the person in 3D."""
    rig = human36m_rig("S9").without_distortion()
    motion = draw_motion(0, "S9", "S9/Walking-1", "Walking", FRAMES, 50.0)
    truth = torch.from_numpy(motion).double()
    pixels = project(rig.cameras, truth)[0].numpy()
    seen = _detect(pixels)
    poses = ghpt.triangulate(seen, rig)
    middle = np.nanmedian(poses.points, axis=(0, 1))
    angle = np.linspace(-0.5, 0.5, FRAMES)
    turned = _orbit(poses.points - middle, angle)
    panels = [
        _panel(seen[:, view], view % 2 * 160.0, view // 2 * 160.0, f"view {view + 1}", True)
        for view in range(4)
    ]
    panels.append(_panel(turned, 350.0, 0.0, "the person in 3D", False, 310))
    body = "\n".join(panels)
    label = "A synthetic person walks before four cameras; from their key points comes the 3D pose"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 662 312" role="img" '
        f'aria-label="{label}"><style>{_STYLE}</style>\n{body}\n</svg>\n'
    )


def _detect(pixels: Float[np.ndarray, "T V J 2"]) -> Float[np.ndarray, "T V J 2"]:
    """Return what a detector sees: noise that lasts for a while, and outliers."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=pixels.shape)
    for t in range(1, len(noise)):
        noise[t] = 0.9 * noise[t - 1] + np.sqrt(1 - 0.9**2) * noise[t]
    outlier = rng.random((FRAMES // 10 + 1, *pixels.shape[1:3])).repeat(10, axis=0)[:FRAMES]
    scale = np.where(outlier < _OUTLIERS, _OUTLIER_PX, _NOISE_PX)
    return pixels + scale[..., None] * noise


def _orbit(points: Float[np.ndarray, "T J 3"], angle: Float[np.ndarray, " T"]) -> np.ndarray:
    """Return the image of points (z up) that are looked at from a direction that turns."""
    right = np.cos(angle)[:, None] * points[..., 0] + np.sin(angle)[:, None] * points[..., 1]
    away = np.cos(angle)[:, None] * points[..., 1] - np.sin(angle)[:, None] * points[..., 0]
    return np.stack([right, -points[..., 2] - 0.25 * away], axis=-1)


def _panel(
    points: Float[np.ndarray, "T J 2"],
    x: float,
    y: float,
    name: str,
    dotted: bool,
    size: int = _PANEL,
) -> str:
    """Return a square in which a skeleton moves; ``dotted``: with its key points."""
    low = np.nanquantile(points, 0.01, axis=(0, 1))
    high = np.nanquantile(points, 0.99, axis=(0, 1))
    scale = 0.8 * (size - 24) / float((high - low).max())
    centred = (points - (low + high) / 2) * scale + (size / 2, size / 2 + 6)
    frames = centred[::_EVERY]
    kinds = {"left": "left", "right": "right"}
    parts = [f'<rect class="frame" width="{size}" height="{size}" rx="6"/>']
    for kind in ("middle", "left", "right"):
        bones = [bone for bone in BONES if _side(bone, kinds) == kind]
        parts.append(_animation(kind, [_lines(frame, bones) for frame in frames]))
    if dotted:
        parts.append(_animation("point", [_dots(frame) for frame in frames]))
    parts.append(f'<text x="8" y="16">{name}</text>')
    return f'<g transform="translate({x:g} {y:g})">{"".join(parts)}</g>'


def _side(bone: tuple[int, int], kinds: dict[str, str]) -> str:
    names = "".join(JOINTS[joint] for joint in bone)
    return next((kind for name, kind in kinds.items() if name in names), "middle")


def _lines(frame: Float[np.ndarray, "J 2"], bones: list[tuple[int, int]]) -> str:
    ends = ((frame[start], frame[end]) for start, end in bones)
    return "".join(f"M{a[0]:.0f} {a[1]:.0f}L{b[0]:.0f} {b[1]:.0f}" for a, b in ends)


def _dots(frame: Float[np.ndarray, "J 2"]) -> str:
    return "".join(f"M{x:.0f} {y:.0f}h0" for x, y in frame)


def _animation(kind: str, paths: list[str]) -> str:
    seconds = FRAMES / 50
    values = ";".join(paths)
    animate = f'<animate attributeName="d" dur="{seconds:g}s" repeatCount="indefinite"'
    return f'<path class="{kind}" d="{paths[0]}">{animate} values="{values}"/></path>'


def draw_reports(browser: str | None) -> Iterator[tuple[str, str]]:
    """Yield the names of the pictures of reports and the pictures; take those of whole pages."""
    for name, (script, *words) in REPORTS.items():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, ROOT / script, *words, "output=out"]
            subprocess.run(command, check=script != "cameras.py", cwd=folder)
            page = (Path(folder) / "out" / "report.html").read_text(encoding="utf-8")
            for screen, wanted in SCREENS.items():
                if browser and wanted.report == name:
                    url = f"file://{folder}/out/{wanted.page}"
                    take_picture(browser, url, screen, (wanted.width, wanted.height))
        found = re.search(r'src="data:image/svg\+xml;base64,([^"]+)"', page)
        if found is None:
            raise SystemExit(f"error: {script}: its report holds no picture")
        yield name, base64.b64decode(found[1]).decode()


def take_picture(browser: str, url: str, name: str, size: tuple[int, int]) -> None:
    """Keep what a browser shows, in few colours."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / name
        values = {"url": url, "out": str(out), "width": size[0], "height": size[1]}
        subprocess.run([word.format(**values) for word in shlex.split(browser)], check=True)
        with Image.open(out) as picture:
            few = picture.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
        few.save(FOLDER / name, optimize=True)
    _keep_digest(name)


def digests() -> dict[str, str]:
    """Return for each picture the digest of the code that makes it."""
    found = {}
    for name, sources in SOURCES.items():
        whole = hashlib.sha256()
        for source in sources:
            whole.update((ROOT / source).read_text(encoding="utf-8").encode())
        found[name] = whole.hexdigest()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--walk", action="store_true", help="draw the animation alone")
    parser.add_argument("--browser", help="command that writes a PNG {out} of a page {url}")
    parser.add_argument("--page", nargs=2, metavar=("URL", "NAME"), help="take this page alone")
    options = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    if options.page:
        if not options.browser:
            parser.error("--page needs a browser: see --browser")
        url, name = options.page
        take_picture(options.browser, url, name, TENSORBOARD)
        return
    _keep("walk.svg", draw_walk())
    if not options.walk:
        for name, picture in draw_reports(options.browser):
            _keep(name, picture)
    if not options.browser:
        print("The pictures of whole pages are left as they are: they need --browser.")


def _keep(name: str, picture: str) -> None:
    """Write a picture and the digest of the code that made it."""
    (FOLDER / name).write_text(picture, encoding="utf-8")
    _keep_digest(name)


def _keep_digest(name: str) -> None:
    known = {}
    with contextlib.suppress(FileNotFoundError):
        known = json.loads(DIGESTS.read_text(encoding="utf-8"))
    known[name] = digests()[name]
    DIGESTS.write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
