"""The commands and the code of README.md and the pages of the site: where they stand, and what they
need to run.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ghpt.data.formats.camera_writers import write_opencv, write_pose2sim
from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.synthetic.rigs import human36m_rig, panoptic_rig
from ghpt.geometry.cameras import CameraSet, project
from ghpt.skeleton import JOINT, JOINTS
from predicting import walk, write_people
from real_layout import upright19, write_cmu_layout, write_human36m_layout
from single_person import SinglePerson, write_person

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").glob("notebooks/*.ipynb")),
    ROOT / "benchmarks" / "README.md",
]
FRAMES = 80


@dataclass(frozen=True)
class Block:
    """A fenced block: what stands between the fences, and in which line that begins."""

    page: Path
    line: int
    language: str
    text: str


@dataclass(frozen=True)
class Command:
    """One command of a shell."""

    page: Path
    line: int
    words: tuple[str, ...]

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}: {shlex.join(self.words)}"

    @property
    def script(self) -> str | None:
        """``train.py`` of ``python train.py``."""
        return self.words[1] if self.words[0] == "python" and len(self.words) > 1 else None


def is_notebook(page: Path) -> bool:
    """Whether a page is a notebook, whose cells follow from each other."""
    return page.suffix == ".ipynb"


def _cells(page: Path, kind: str) -> Iterator[tuple[int, str]]:
    """The numbers and the texts of a notebook's cells of a kind."""
    for number, cell in enumerate(json.loads(page.read_text(encoding="utf-8"))["cells"], start=1):
        if cell["cell_type"] == kind:
            yield number, "".join(cell["source"]) + "\n"


def _cell_block(page: Path, number: int, text: str) -> Block:
    """A cell of code as a block: one that writes a file, commands, or Python."""
    if written := re.match(r"%%writefile (\S+)\n", text):
        language = "yaml" if written[1].endswith(".yaml") else "python"
        return Block(page, number, language, f"# {written[1]}\n{text[written.end() :]}")
    if text.startswith("!"):
        typed = re.sub(r"^!ghpt (\w+)", r"python \1.py", text, flags=re.MULTILINE)
        return Block(page, number, "bash", typed.replace("--config-dir conf ", ""))
    return Block(page, number, "python", text)


def text_of(page: Path) -> str:
    """What a reader reads: a page, or the text between a notebook's cells of code."""
    if is_notebook(page):
        return "\n".join(text for _, text in _cells(page, "markdown"))
    return page.read_text(encoding="utf-8")


def blocks(page: Path) -> list[Block]:
    """The page's fenced blocks in their order."""
    if is_notebook(page):
        return [_cell_block(page, number, text) for number, text in _cells(page, "code")]
    found, text = [], page.read_text(encoding="utf-8")
    for match in re.finditer(r"^```(.*)\n((?:(?!```).*\n)*)```$", text, flags=re.MULTILINE):
        found.append(
            Block(page, text[: match.start(2)].count("\n") + 1, match[1].strip(), match[2])
        )
    assert 2 * len(found) == len(re.findall(r"^```", text, flags=re.MULTILINE)), (
        f"{page}: a fence is not closed"
    )
    return found


def commands_of(block: Block) -> Iterator[Command]:
    """The commands of a bash block, a line each or more, or of a console block's prompts."""
    for number, line in enumerate(block.text.splitlines()):
        if block.language != "console" or line.startswith("$ "):
            yield from _split(block.page, block.line + number, line.removeprefix("$ "))


def inline_commands(page: Path) -> Iterator[Command]:
    """Commands between backticks in the text, which may go over a line's end."""
    text = text_of(page)
    prose = re.sub(
        r"^```.*?^```$", lambda m: "\n" * m[0].count("\n"), text, flags=re.MULTILINE | re.DOTALL
    )
    for match in re.finditer(r"`((?:python|pip|tensorboard|mkdocs|pytest)\s[^`]+)`", prose):
        yield from _split(page, prose[: match.start()].count("\n") + 1, match[1])


def _split(page: Path, line: int, text: str) -> Iterator[Command]:
    """``a && b`` are two."""
    words: list[str] = []
    for word in [*shlex.split(text, comments=True), "&&"]:
        if word != "&&":
            words.append(word)
        elif words:
            yield Command(page, line, tuple(words))
            words = []


def workplace(folder: Path) -> Path:
    """A folder with every file that the pages name: a person who walks before four cameras, in each
    format.
    """
    rig = human36m_rig("S9")
    rig = CameraSet.from_cameras(
        ("cam01", "cam02", "cam03", "cam04"), rig.cameras, 0 * rig.distortion, rig.size
    )
    points = walk()[:FRAMES]
    pixels = project(rig.cameras, points)[0].numpy()
    pixels = pixels + np.random.default_rng(0).normal(0, 1, pixels.shape)
    for name in ("pose", "walk", "run", "openpose"):
        write_openpose(folder / name, rig, pixels)
    valid = np.ones(pixels.shape[:-1], bool)
    given = SinglePerson(
        "",
        rig.names,
        JOINTS,
        np.arange(FRAMES),
        pixels,
        valid.astype(float),
        valid,
        50.0,
    )
    for name in ("points.npz", "blazepose.npz"):
        write_person(folder / name, given)
    R, t = rig.cameras.R[:1].expand(4, 3, 3), rig.cameras.t[:1].expand(4, 3)
    write_pose2sim(folder / "intrinsics.toml", replace(rig, R=R, t=t), {})
    for name in ("Calib.toml", "Calib_qualisys.toml"):
        write_pose2sim(folder / name, rig, {})
    write_opencv(folder, rig)
    write_caliscope(folder, rig, pixels)
    write_human36m_layout(folder / "human36m", takes(), chunk=40)
    person = upright19() * 10 + np.random.default_rng(0).normal(0, 15, (FRAMES, 19, 3))
    write_cmu_layout(folder / "cmu", panoptic_rig(range(31)), person)
    return folder


def detected(view: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """What a detector of 13 joints would say of the walk: pixels [13, 2] and scores [13]."""
    limbs = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    names = ["nose", *(f"{side}_{limb}" for limb in limbs for side in ("left", "right"))]
    rig = human36m_rig("S9")
    pixels = project(rig.cameras, walk()[frame : frame + 1])[0][0]
    return pixels[
        int(view.removeprefix("cam")) - 1, [JOINT[name] for name in names]
    ].numpy(), np.ones(len(names))


def takes() -> list[tuple[str, str, np.ndarray]]:
    """A take of 40 frames for each subject of Human3.6M."""
    subjects = ("S1", "S5", "S6", "S7", "S8", "S9", "S11")
    return [(subject, "Walking-1", walk()[:40].numpy()) for subject in subjects]


def write_openpose(folder: Path, rig: CameraSet, pixels: np.ndarray) -> None:
    """OpenPose's folders, a file for each frame."""
    for view, name in enumerate(rig.names):
        (folder / f"{name}_json").mkdir(parents=True)
        for frame in range(len(pixels)):
            person = torch.from_numpy(pixels[frame, view])
            write_people(folder / f"{name}_json" / f"{name}_{frame:06d}.json", [person])


def write_caliscope(folder: Path, rig: CameraSet, pixels: np.ndarray) -> None:
    """caliscope's table of MediaPipe's landmarks, and its cameras."""
    rows = [
        "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
    ]
    there = [
        (number, JOINT[name])
        for number, name in enumerate(SKELETONS["mediapipe_33"])
        if name in JOINT
    ]
    for frame, view in np.ndindex(pixels.shape[:2]):
        for number, joint in there:
            x, y = pixels[frame, view, joint].tolist()
            rows.append(f"{frame},{view},{frame},{frame / 50},{number},{x},{y},,")
    (folder / "xy_HOLISTIC.csv").write_text("\n".join(rows) + "\n")
    tables = []
    for view in range(len(rig)):
        camera = {
            "size": rig.size[view],
            "matrix": rig.cameras.K[view],
            "distortions": rig.distortion[view],
            "translation": rig.cameras.t[view] / 1000,
            "rotation": rig.cameras.R[view],
        }
        tables.append(
            "\n".join(
                [
                    f"[cameras.{view}]",
                    *(f"{key} = {value.tolist()}" for key, value in camera.items()),
                ]
            )
        )
    (folder / "camera_array.toml").write_text("\n\n".join(tables) + "\n")


def own_conf(folder: Path) -> Path:
    """A copy of conf/, to which a page may add."""
    return Path(shutil.copytree(ROOT / "conf", folder / "conf"))
