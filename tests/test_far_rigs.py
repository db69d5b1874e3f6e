"""Rigs far from their world's zero, as national grids have them: positions keep 0.01 mm in every file."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ghpt.data.camera_files import read_cameras
from ghpt.data.camera_writers import write_pose2sim
from ghpt.data.rigs import Rig, human36m_rig
from ghpt.export import read_reconstruction
from ghpt.export.c3d import write_c3d
from ghpt.geometry.cameras import project
from ghpt.predict import predict
from predicting import cameras_file, config, walk
from reconstructions import about, in_parts, random_reconstruction
from test_predict import checkpoint, points_file

FRAMES = 6
METRE = 1000.0
OFFSETS = {
    "at the zero": (0.0, 0.0, 0.0),
    "10 km": (1e4 * METRE, 0.0, 0.0),
    "UTM": (500_321.4 * METRE, 5_412_345.6 * METRE, 312.7 * METRE),
    "10,000 km": (1e7 * METRE, -1e7 * METRE, 1e7 * METRE),
}
LIMIT = 0.01
"""mm, of what a distance may cost."""


def moved_rig(offset) -> Rig:
    rig = human36m_rig("S9")
    cameras = rig.cameras.relative_to(-torch.tensor(offset, dtype=torch.float64))
    names = tuple(f"cam_{i:02d}" for i in range(len(rig)))
    return Rig(names, cameras, 0 * rig.distortion, rig.size)


def predicted(folder: Path, offset, *words: str) -> Path:
    """The walk, seen exactly by the moved rig, in every format."""
    write_pose2sim(folder / "rig.toml", moved_rig(offset), {})
    given = [f"keypoints={points_file(folder, frames=FRAMES)}", f"cameras={folder / 'rig.toml'}"]
    predict(config(*given, "formats=[npz,csv,parquet,trc,c3d,html]", *words), folder / "out")
    return folder / "out"


def in_npz(path: Path) -> np.ndarray:
    with np.load(path / "poses.npz", allow_pickle=False) as stored:
        return stored["points"]


def in_csv(path: Path) -> np.ndarray:
    lines = [line.split(",") for line in (path / "poses.csv").read_text(encoding="utf-8").splitlines()]
    columns = [i for i, name in enumerate(lines[0]) if re.search(r"_[xyz]_mm$", name)]
    return np.array([[float(row[i]) for i in columns] for row in lines[1:]]).reshape(FRAMES, 17, 3)


def in_parquet(path: Path) -> np.ndarray:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow reads Parquet; it comes with ghpt[io]")
    table = parquet.read_table(path / "poses.parquet")
    names = [name for name in table.column_names if re.search(r"_[xyz]_mm$", name)]
    return np.stack([table[name].to_numpy() for name in names], axis=-1).reshape(FRAMES, 17, 3)


def in_trc(path: Path) -> np.ndarray:
    lines = (path / "poses.trc").read_text(encoding="utf-8").splitlines()
    rows = [line.rstrip("\t").split("\t") for line in lines[6:]]
    return np.array([[float(cell) for cell in row[2:]] for row in rows]).reshape(FRAMES, 17, 3)


def in_c3d(path: Path) -> np.ndarray:
    ezc3d = pytest.importorskip("ezc3d", reason="ezc3d reads C3D; it comes with ghpt[test]")
    file = ezc3d.c3d(str(path / "poses.c3d"))
    ours = file["parameters"]["GHPT"]
    origin = [float(x) for x in ours["ORIGIN"]["value"]] if "ORIGIN" in ours else [0.0, 0.0, 0.0]
    return file["data"]["points"][:3].transpose(2, 1, 0) + origin


def in_html(path: Path) -> np.ndarray:
    text = (path / "poses.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'application/json">(.*?)</script>', text, re.DOTALL)[1])
    points = np.frombuffer(base64.b64decode(data["points"]), "<f4").astype(float).reshape(FRAMES, 17, 3)
    stated = re.search(r"zero is at \((.*?)\) mm", data["about"])
    origin = [float(x) for x in stated[1].split(",")] if stated else [0.0, 0.0, 0.0]
    return points @ np.array(data["axes"]).T + origin


READERS = {
    "npz": in_npz, "csv": in_csv, "parquet": in_parquet, "trc": in_trc, "c3d": in_c3d, "html": in_html,
}  # fmt: skip


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> dict[str, Path]:
    return {name: predicted(tmp_path_factory.mktemp("far"), offset) for name, offset in OFFSETS.items()}


@pytest.mark.parametrize("format", READERS)
@pytest.mark.parametrize("name", OFFSETS)
def test_positions_are_exact_in_every_format(outputs, name, format):
    truth = walk()[:FRAMES].numpy() + OFFSETS[name]
    error = np.abs(READERS[format](outputs[name]) - truth).max()
    at_the_zero = np.abs(READERS[format](outputs["at the zero"]) - walk()[:FRAMES].numpy()).max()
    assert error <= at_the_zero + LIMIT
