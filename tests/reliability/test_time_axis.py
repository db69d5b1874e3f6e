"""E5: whatever is missing, doubled or out of order, a frame's pose stands at its own number, or an
error says why.
"""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ghpt.commands.predict import predict
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptDataError
from ghpt.export import read_reconstruction
from ghpt.geometry.cameras import project
from ghpt.reconstruction import State
from predicting import cameras_file, config, openpose_folders, walk, write_people

pytestmark = pytest.mark.usefixtures("blank_figures")

FRAMES = list(range(3, 15))
WORDS = ("skeleton=human36m", "estimator=linear", "formats=[npz]", "rate_hz=50")
PIXELS = project(human36m_rig("S9").cameras, walk())[0]
Case = Callable[[Path], None]


def file(folder: Path, view: int, frame: int) -> Path:
    return folder / f"cam{view}_json" / f"cam{view}_{frame:06d}.json"


def missing(*of: tuple[int, int]) -> Case:
    return lambda folder: [file(folder, view, frame).unlink() for view, frame in of]


def people(view: int, frame: int, found: list[torch.Tensor]) -> Case:
    return lambda folder: write_people(file(folder, view, frame), found)


def crowd(count: int) -> Case:
    """So many people in one view, all but one of them small, in another order in each frame."""

    def change(folder: Path) -> None:
        for frame in FRAMES:
            one = PIXELS[frame, 2]
            others = [50 + 0.1 * one + 10 * other for other in range(count - 1)]
            place = frame % count
            write_people(file(folder, 2, frame), [*others[:place], one, *others[place:]])

    return change


def beside(folder: Path) -> None:
    """A second person in all views, for a part of the time, listed first."""
    second = project(human36m_rig("S9").cameras, walk() + torch.tensor([1200.0, 600.0, 0.0]))[0]
    for frame in FRAMES[4:8]:
        for view in range(4):
            write_people(file(folder, view, frame), [second[frame, view], PIXELS[frame, view]])


def unpadded(folder: Path) -> None:
    """cam0_9 comes after cam0_10 in the order of names."""
    for path in list(folder.rglob("*.json")):
        path.rename(path.with_name(re.sub(r"_0+(\d)", r"_\1", path.name)))


def doubled(folder: Path) -> None:
    shutil.copy(file(folder, 0, 5), file(folder, 0, 5).with_name("cam0_5.json"))


def shifted(folder: Path) -> None:
    for path in sorted((folder / "cam0_json").iterdir()):
        path.rename(path.with_name(f"cam0_{int(path.stem[-6:]) + 5000:06d}.json"))


def unnumbered(folder: Path) -> None:
    file(folder, 0, 5).rename(folder / "cam0_json" / "camera.json")


def truncated(folder: Path) -> None:
    path = file(folder, 1, 7)
    path.write_text(path.read_text()[:200])


def nobody(folder: Path) -> None:
    for path in folder.rglob("*.json"):
        path.write_text('{"people": []}')


def other_names(folder: Path) -> None:
    """Numbers in the camera's name do not count, the last one does."""
    for path in list((folder / "cam3_json").iterdir()):
        path.rename(
            path.with_name(f"2024-05-{path.stem[-2:]}_run7_{path.stem[-6:]}_keypoints.json")
        )


ALL = [(view, 6) for view in range(4)]
READ: dict[str, tuple[Case, list[int], list[int]]] = {
    "nothing is wrong": (lambda folder: None, FRAMES, []),
    "a file is missing in a view": (missing((0, 6)), FRAMES, []),
    "a file is missing in two views": (missing((0, 6), (2, 6)), FRAMES, []),
    "a file is missing in all views but one": (missing(*ALL[:3]), FRAMES, [6]),
    "a frame is missing in all views": (missing(*ALL), [f for f in FRAMES if f != 6], []),
    "nobody in a view": (people(1, 6, []), FRAMES, []),
    "nobody in three views": (lambda f: [people(v, 6, [])(f) for v in range(3)], FRAMES, [6]),
    "nobody in any view": (lambda f: [people(v, 6, [])(f) for v in range(4)], FRAMES, [6]),
    "a person without joints": (people(0, 6, [PIXELS[6, 0] * torch.nan]), FRAMES, []),
    "a view starts late": (missing(*((0, f) for f in FRAMES[:5])), FRAMES, []),
    "a view ends early": (missing(*((3, f) for f in FRAMES[5:])), FRAMES, []),
    "views of unequal lengths": (missing((0, 3), (0, 14), (1, 13), (1, 14), (2, 3)), FRAMES, []),
    "long gap": (missing(*((v, f) for v in range(4) for f in range(5, 13))), [3, 4, 13, 14], []),
    "one frame": (missing(*((v, f) for v in range(4) for f in FRAMES[1:])), [3], []),
    "numbers without leading zeros": (unpadded, FRAMES, []),
    "50 people in a view": (crowd(50), FRAMES, []),
    "a second person for a while": (beside, FRAMES, []),
    "other numbers in the names": (other_names, FRAMES, []),
}
"""What is done, the frame numbers that come out, and those of them without any joint."""

REFUSED: dict[str, tuple[Case, str]] = {
    "a frame number twice": (doubled, "frame number 5"),
    "no frame in all views": (shifted, "no frame is in all views"),
    "a name without a number": (unnumbered, "no frame number"),
    "another number of joints in a frame": (people(0, 6, [PIXELS[6, 0][:14]]), "joints"),
    "another number of joints in a view": (
        lambda folder: [people(2, f, [PIXELS[f, 2][:14]])(folder) for f in FRAMES],
        "joints",
    ),
    "a truncated file": (truncated, "cam1_000007.json"),
    "nobody anywhere": (nobody, "empty|no key point"),
}


def predicted(folder: Path, keypoints: Path, *words: str):
    predict(
        config(f"keypoints={keypoints}", f"cameras={cameras_file(folder)}", *WORDS, *words),
        folder / "out",
    )
    _, parts = read_reconstruction(folder / "out" / "poses.npz")
    return next(iter(parts))


@pytest.mark.parametrize("name", READ)
def test_e5_a_pose_stands_at_its_own_frame(tmp_path, name):
    change, frames, empty = READ[name]
    change(openpose_folders(tmp_path / "pose", FRAMES))
    found = predicted(tmp_path, tmp_path / "pose")
    assert found.frame.tolist() == frames
    placed = found.state == State.OBSERVED
    without = torch.tensor([number in empty for number in frames])
    assert torch.equal(placed.any(1), ~without)
    assert placed[~without].all()
    error = (found.points.double() - walk()[found.frame]).norm(dim=-1)[placed]
    assert float(error.max()) < 1.0  # STEP in the next frame


@pytest.mark.parametrize("name", REFUSED)
def test_e5_or_an_error_says_why(tmp_path, name):
    change, said = REFUSED[name]
    change(openpose_folders(tmp_path / "pose", FRAMES))
    with pytest.raises(GhptDataError, match=said):
        predicted(tmp_path, tmp_path / "pose")
    assert not list((tmp_path / "out").glob("poses.*"))


def arrays(frame: list[int]) -> dict[str, np.ndarray]:
    return {
        "key_points": PIXELS[frame].numpy(),
        "frame": np.array(frame),
        "views": np.array([f"cam{v}" for v in range(4)]),
    }


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    ("frame", "said"),
    [([3, 4, 9, 10, 40], None), ([3, 4, 4, 5], "rise"), ([3, 5, 4], "rise"), ([9, 8, 7], "rise")],
)
def test_e5_numbers_in_an_npz_file(tmp_path, save, frame, said):
    save(tmp_path / "points.npz", **arrays(frame))
    if said:
        with pytest.raises(GhptDataError, match=said):
            predicted(tmp_path, tmp_path / "points.npz")
        return
    found = predicted(tmp_path, tmp_path / "points.npz")
    assert found.frame.tolist() == frame
    assert float((found.points.double() - walk()[found.frame]).norm(dim=-1).max()) < 1.0


def test_e5_shards_of_any_size_keep_the_numbers(tmp_path, record_row):
    openpose_folders(tmp_path / "pose", [3, 4, 6, 7, 8, 20, 21])
    for size in (1, 2, 3, 7, 100):
        found = predicted(tmp_path, tmp_path / "pose", f"shard_frames={size}", "batch=2")
        assert found.frame.tolist() == [3, 4, 6, 7, 8, 20, 21]
        assert float((found.points.double() - walk()[found.frame]).norm(dim=-1).max()) < 1.0
    manifest = (tmp_path / "out" / ".shards" / "manifest.jsonl").read_text().splitlines()
    assert json.loads(manifest[0])["frames"] == 7
    total = len(READ) + len(REFUSED) + 8
    record_row("E5", "index never shifts, or a named error", total, total)
