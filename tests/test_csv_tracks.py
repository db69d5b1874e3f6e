"""CSV of DeepLabCut, LightningPose and SLEAP as their tools write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from damage import damage
from ghpt.data.formats.key_points import read_key_points

NAMES = tuple(
    f"{side}_{part}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
)
POINTS = np.random.default_rng(0).uniform(1, 500, (5, 2, len(NAMES), 2)).round(3)
"""Of 5 frames and 2 people."""
SURE = 0.75


def deeplabcut(path: Path, people=("",), index=lambda t: [str(t)]) -> None:
    """``index``: the first cells of a row, its number or the parts of an image's path."""
    columns = [(who, n, c) for who in people for n in NAMES for c in ("x", "y", "likelihood")]
    empty = [""] * (len(index(0)) - 1)
    rows = [["scorer", *empty, *("net" for _ in columns)]]
    if people != ("",):
        rows.append(["individuals", *empty, *(who for who, _, _ in columns)])
    rows.append(["bodyparts", *empty, *(name for _, name, _ in columns)])
    rows.append(["coords", *empty, *(of for _, _, of in columns)])
    sure = np.full((*POINTS.shape[:3], 1), SURE)
    for t, own in enumerate(np.concatenate([POINTS, sure], -1)[:, : len(people)]):
        rows.append([*index(t), *map(str, own.ravel().tolist())])
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", "utf-8")


def sleap(path: Path) -> None:
    heads = [f"{name}.{of}" for name in NAMES for of in ("x", "y", "score")]
    lines = [",".join(["track", "frame_idx", "instance.score", *heads])]
    for who in range(2):
        for t in range(5):
            own = np.concatenate([POINTS[t, who], np.full((len(NAMES), 1), SURE)], -1)
            lines.append(",".join([f"track_{who}", str(t), "0.9", *map(str, own.ravel().tolist())]))
    path.write_text("\n".join(lines) + "\n", "utf-8")


def of_image(t: int) -> list[str]:
    return ["labeled-data", "cam1", f"img{t + 7:04d}.png"]


@pytest.mark.parametrize(
    ("write", "people", "first"),
    [
        (deeplabcut, 1, 0),
        (lambda path: deeplabcut(path, index=lambda t: [str(t + 3)]), 1, 3),
        (lambda path: deeplabcut(path, people=("anna", "ben")), 2, 0),
        (lambda path: deeplabcut(path, index=of_image), 1, 7),
        (sleap, 2, 0),
    ],
    ids=["one", "numbered", "several", "labels", "sleap"],
)
def test_everybody_is_read(write, people, first, tmp_path):
    for name in ("cam1DLC_resnet50_walkJan1shuffle1_100", "cam2DLC_resnet50_walkJan1shuffle1_100"):
        write(tmp_path / f"{name}.csv")
    found = read_key_points(tmp_path)
    assert found.views == ("cam1", "cam2")
    assert found.joints == NAMES
    assert found.frame.tolist() == list(range(first, first + 5))
    points = POINTS[:, :people].reshape(-1, len(NAMES), 2)
    np.testing.assert_array_equal(found.points.pixels, np.concatenate([points, points]))
    assert (found.points.confidence == SURE).all()
    whose = [0, 1] * 10 if people == 2 else [-1] * 10
    assert found.identity.tolist() == whose


def test_an_empty_cell_is_missing_and_other_columns_are_left_out(tmp_path):
    """LightningPose's ensembles have columns of their own."""
    for view in ("a", "b"):
        path = tmp_path / f"{view}.csv"
        deeplabcut(path)
        rows = [line.split(",") for line in path.read_text().splitlines()]
        for row, cell in zip(rows, ("net", NAMES[0], "x_ens_var", *"01234"), strict=True):
            row.append(cell)
        rows[4][1:4] = ["", "", ""]
        path.write_text("\n".join(",".join(row) for row in rows) + "\n", "utf-8")
    found = read_key_points(tmp_path, format="lightningpose")
    valid = found.points.valid.reshape(2, 5, -1)
    assert not valid[:, 1, 0].any()
    assert valid.sum() == valid.size - 2


@pytest.mark.parametrize("write", [deeplabcut, sleap])
def test_a_damaged_table_is_read_or_named(write, tmp_path):
    path = tmp_path / "cam1.csv"
    write(path)
    assert damage(path, read_key_points, 60) == {"read", "named"}
