"""Key points of any detector beside a Panoptic sequence, in any format that is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.formats.skeletons import map_to_joints
from ghpt.data.people.detections import Detections
from ghpt.data.people.matching import match_views
from ghpt.data.people.persons import undistort_detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, project

_NEAR = 0.5
"""Share of the true person's size in the image within which a detection is of that person."""


def read_person(
    folder: Path,
    calibration: Path,
    names: Sequence[str],
    frame: Int[np.ndarray, " T"],
    truth: Float[np.ndarray, "T 17 3"],
    truth_valid: Bool[np.ndarray, "T 17"],
) -> KeyPoints:
    """Return the true person's undistorted key points [T V 17] in the cameras of these names.

    Of several people in a view the one is taken who is nearest to the projected truth, if near at
    all; frames are matched by number, views by name. Raises GhptDataError for key points that
    cannot be read, and for frames that are others than the truth's.
    """
    people = read_key_points(folder)
    if not np.isin(people.frame, frame).any():
        problem = f"holds none of the frames {frame[0]} to {frame[-1]} of the body3DScene files"
        raise GhptDataError(folder, "frame", problem, "Number the frames as Panoptic does.")
    at, cameras = match_views(people.path, people.views, read_cameras(calibration), None, names)
    ideal = map_to_joints(undistort_detections(people, cameras, at), people.skeleton)
    distance = _distances(people, ideal, at, cameras.cameras, frame, truth, truth_valid)
    shape = (len(frame), len(names))
    chosen = np.full(shape, -1)
    views = [list(names).index(name) for name in cameras.names]
    of_view = np.full(len(people.views), -1)
    of_view[at] = views
    # the nearest comes last, and stays
    for index in np.argsort(-distance, kind="stable"):
        if distance[index] < _NEAR:
            row = np.searchsorted(frame, people.frame[people.row[index]])
            chosen[row, of_view[people.view[index]]] = index
    return ideal.take(chosen)


def _distances(
    people: Detections,
    ideal: KeyPoints,
    at: Sequence[int],
    cameras: Cameras,
    frame: Int[np.ndarray, " T"],
    truth: Float[np.ndarray, "T 17 3"],
    truth_valid: Bool[np.ndarray, "T 17"],
) -> Float[np.ndarray, " N"]:
    """Return how far each detection is from the truth, in sizes of the person; inf for nobody's."""
    distance = np.full(len(people), np.inf)
    number = people.frame[people.row]
    row = np.minimum(np.searchsorted(frame, number), len(frame) - 1)
    has_truth = frame[row] == number
    pixels, depth = project(cameras, torch.from_numpy(truth).double())
    for camera, view in enumerate(at):
        own = np.flatnonzero((people.view == view) & has_truth)
        seen = pixels[row[own], camera].numpy()
        valid = truth_valid[row[own]] & (depth[row[own], camera] > 0).numpy()
        both = valid & ideal.valid[own]
        apart = np.linalg.norm(ideal.pixels[own] - seen, axis=-1)
        size = _extent(seen, valid)
        mean = np.where(both, apart, 0).sum(-1) / np.maximum(both.sum(-1), 1)
        comparable = (both.sum(-1) > 0) & (size > 0)
        distance[own] = np.where(comparable, mean / np.maximum(size, 1e-9), np.inf)
    return distance


def _extent(pixels: Float[np.ndarray, "N J 2"], valid: Bool[np.ndarray, "N J"]) -> np.ndarray:
    """Return the larger side of the box around valid points; 0 where there are none."""
    low = np.where(valid[..., None], pixels, np.inf).min(1)
    high = np.where(valid[..., None], pixels, -np.inf).max(1)
    sides = np.where(np.isfinite(high - low), high - low, 0)
    return np.asarray(sides.max(-1))
