"""What the player shows beside the prediction."""

from pathlib import Path

import pytest
import torch

from composed import compose
from ghpt.commands.prediction.beside import compared_poses, find_videos
from ghpt.commands.prediction.world import World
from ghpt.config import build
from ghpt.errors import GhptDataError
from ghpt.geometry.similarity import Similarity
from predicting import sequence_of, walk


def files(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    ("names", "views", "found"),
    [
        (("cam1.mp4", "cam10.mp4"), ("cam1", "cam10"), ("cam1.mp4", "cam10.mp4")),
        (
            ("walk_left.MOV", "walk_right.mov"),
            ("left", "right"),
            ("walk_left.MOV", "walk_right.mov"),
        ),
        (("c1.webm", "c2.webm", "c1.txt"), ("cam_02", "cam_01"), ("c2.webm", "c1.webm")),
        (("a b#1.mp4",), ("a b#1", "x"), ("a%20b%231.mp4", None)),
    ],
)
def test_videos_are_found_by_the_names_of_the_views(tmp_path, names, views, found):
    folder = files(tmp_path / "videos", *names)
    shown = find_videos(folder, views, tmp_path / "out")
    assert shown == tuple(name and f"../videos/{name}" for name in found)


def test_a_folder_without_a_view_s_video_is_refused(tmp_path):
    with pytest.raises(GhptDataError, match="videos"):
        find_videos(files(tmp_path / "videos", "other.mp4"), ("left", "right"), tmp_path)


def test_another_estimator_s_poses_are_in_the_files_world_and_at_the_asked_frames():
    sequence = sequence_of(40, noise=0.0, gaps=0.0)
    linear = build(compose("predict")["baselines"]["linear"], "linear")
    shift = torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64)
    world = World("people", Similarity(torch.eye(3, dtype=torch.float64), 1.0, shift))
    (other,) = compared_poses(sequence, {"linear": linear}, None, 20, world)
    found = other.points(torch.tensor([3, 17]))
    torch.testing.assert_close(found, walk()[[3, 17]] + shift, atol=0.1, rtol=0)
