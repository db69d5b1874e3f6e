"""CMU Panoptic as the paper's authors prepare it: one flat folder of arrays.

It holds ``all_2d_preds.npy`` [T, C, 17, 2] (pixels of the 384-high crop), ``all_bboxes.npy``
[T, C, 2, 2], ``all_3d_gt.npy`` [T, 19, 3] and ``cmu-multiview-labels-MRCNNbboxes.npy``, a pickle
with the cameras. The files say neither their unit of length, nor whether the images were
undistorted before the detector saw them, nor on which side its joint 0 is (the authors' table pairs
it with COCO19's left ankle): the truth, projected onto the key points, tells all three.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ghpt.data.datasets.detections import uncrop, undistort_key_points
from ghpt.data.datasets.labels import read_label_cameras
from ghpt.data.datasets.panoptic_joints import COCO19, joints17
from ghpt.data.formats.validate import check_cameras, check_names, npy_header, open_input, read_npy
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.lens import distort
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINT, MIRROR

PREDICTIONS = "all_2d_preds.npy"
_BOXES = "all_bboxes.npy"
_TRUTH = "all_3d_gt.npy"
_LABELS = "cmu-multiview-labels-MRCNNbboxes.npy"
_RATE_HZ = 29.97
_ALL_CAMERAS = 31
_BLOCK = 4096
"""Frames worked on at once."""
_SAMPLE = 64
"""Frames, evenly spread, by which the truth is laid onto the key points."""
_UNITS_MM = (1.0, 10.0, 1000.0)
_TRUNK_MM = 480.0
"""Between pelvis and thorax of an adult."""
_FITS = 0.1
"""Share of a box's height up to which the truth is taken to lie on the key points."""
_LIMBS = [
    JOINT[f"{side}_{part}"]
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_HINT = "Get the authors' files again, all from one place."
_log = logging.getLogger(__name__)


def authors_files(root: Path) -> list[Path]:
    """Return the files of a flat folder. Raises GhptDataError if one is missing."""
    files = [root / name for name in (PREDICTIONS, _BOXES, _TRUTH)]
    for file in files:
        if not file.is_file():
            hint = f"Beside it there must be {PREDICTIONS}, {_BOXES}, {_TRUTH} and {_LABELS}."
            raise GhptDataError(file, "", "there is no such file", hint)
    return [*files, _labels_file(root)]


def is_authors_folder(root: Path) -> bool:
    """Return whether a folder is in the authors' flat layout."""
    return (root / PREDICTIONS).is_file() and (root / _TRUTH).is_file()


def authors_recording(
    root: Path, numbers: Sequence[int], part: tuple[float, float]
) -> LabelledRecording:
    """Return a part in time (shares of all frames) in the HD cameras of these numbers.

    Frames are numbered from 0 on, as the files do not number them; nor do they hold confidences,
    which are 1. Raises GhptDataError for files that are missing, damaged or do not fit together.
    """
    arrays = _open(root, numbers)
    how = _interpret(arrays)
    count = len(arrays.truth)
    rows = np.arange(int(part[0] * count), int(part[1] * count))
    views = len(arrays.views)
    shape = (len(rows), views, len(JOINT))
    key_points = np.zeros((*shape, 2), np.float32)
    valid = np.zeros(shape, np.bool_)
    for start in range(0, len(rows), _BLOCK):
        block = slice(start, start + _BLOCK)
        pixels, found = arrays.pixels(rows[block], how.mirrored)
        for view in range(views):
            key_points[block, view], valid[block, view] = undistort_key_points(
                pixels[:, view],
                found[:, view],
                arrays.cameras.K[view].numpy(),
                arrays.distortion[view] * how.distorted,
            )
    truth, truth_valid = arrays.true_joints(rows, how.truth_mm)
    return LabelledRecording(
        name=root.name,
        subject=root.name,
        action="unknown",
        rate_hz=_RATE_HZ,
        camera_names=arrays.names,
        cameras=how.cameras(arrays.cameras),
        key_points=key_points,
        confidence=valid.astype(np.float32),
        valid=valid,
        truth=truth,
        truth_valid=truth_valid,
        frame=rows,
    )


@dataclass(frozen=True)
class _Arrays:
    """The files of a folder, memory-mapped, in the views that are wanted."""

    root: Path
    names: tuple[str, ...]
    views: list[int]
    """Of the arrays' C."""
    cameras: Cameras
    """In the labels' own unit."""
    distortion: Float[np.ndarray, "V 5"]
    predictions: Float[np.ndarray, "T C 17 2"]
    boxes: np.ndarray
    """[T, C, 2, 2] or [T, C, 4]."""
    truth: Float[np.ndarray, "T 19 3"]

    def pixels(
        self, rows: Int[np.ndarray, " N"], mirrored: bool
    ) -> tuple[Float[np.ndarray, "N V 17 2"], Bool[np.ndarray, "N V 17"]]:
        """Return the pixels of the images, and which are valid."""
        crop = self.predictions[rows][:, self.views].astype(np.float64)
        pixels, valid = uncrop(crop, self.corners(rows))
        valid = valid & np.isfinite(pixels).all(-1)
        order = list(MIRROR) if mirrored else slice(None)
        return pixels[:, :, order], valid[:, :, order]

    def corners(self, rows: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N V 2 2"]:
        """Return the two corners of each box, pixels."""
        boxes = self.boxes[rows][:, self.views].astype(np.float64)
        return boxes.reshape(*boxes.shape[:2], 2, 2)

    def true_joints(
        self, rows: Int[np.ndarray, " N"], unit_mm: float
    ) -> tuple[Float[np.ndarray, "N 17 3"], Bool[np.ndarray, "N 17"]]:
        """Return the poses, mm, and which joints are valid."""
        points = self.truth[rows].astype(np.float64)
        there = np.isfinite(points).all(-1)
        return joints17(np.where(there[..., None], points, 0) * unit_mm, there)


@dataclass(frozen=True)
class _Interpretation:
    """What the files do not say."""

    truth_mm: float
    """The unit of the truth."""
    camera_mm: float
    """The unit of the cameras' t."""
    distorted: bool
    """Whether the key points are of images as the lenses show them."""
    mirrored: bool
    """Whether left and right of the key points are exchanged against the truth."""

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras in mm."""
        return replace(cameras, t=cameras.t * self.camera_mm)


def _open(root: Path, numbers: Sequence[int]) -> _Arrays:
    predictions_file, boxes_file, truth_file, labels_file = authors_files(root)
    check_names(root, numbers, range(_ALL_CAMERAS))
    labels = read_label_cameras(labels_file)
    views = [_view(labels_file, labels.names, number) for number in numbers]
    names = tuple(f"00_{number:02d}" for number in numbers)
    count = len(labels.names)
    # the authors use the first of the actions' calibrations for all
    cameras, distortion = check_cameras(
        labels_file,
        names,
        labels.K[0][views],
        labels.R[0][views],
        labels.t[0][views],
        labels.distortion[0][views],
    )
    predictions = read_npy(predictions_file, (None, count, len(JOINT), 2), "f")
    frames = len(predictions)
    boxes = read_npy(boxes_file, (frames, count, *_box_shape(boxes_file)), "fiu")
    truth = read_npy(truth_file, (frames, len(COCO19), 3), "f")
    return _Arrays(root, names, views, cameras, distortion, predictions, boxes, truth)


def _box_shape(file: Path) -> tuple[int, ...]:
    """Return how the four numbers of a box lie: in two corners, or flat."""
    with open_input(file) as handle:
        shape, *_ = npy_header(file, "", handle, file.stat().st_size)
    return (4,) if len(shape) == 3 else (2, 2)


def _labels_file(root: Path) -> Path:
    for file in (root / _LABELS, root / "extra" / _LABELS):
        if file.is_file():
            return file
    raise GhptDataError(root, "", f"there is no {_LABELS}, nor extra/{_LABELS}", _HINT)


def _view(where: Path, names: Sequence[str], number: int) -> int:
    """Return the place of an HD camera in the arrays."""
    name = f"00_{number:02d}"
    if name in names:
        return names.index(name)
    if len(names) == _ALL_CAMERAS:
        return number
    problem = f"there is no camera {name} among {', '.join(names)}"
    raise GhptDataError(where, "camera_names", problem, "Choose others: data.cameras=[...].")


def _interpret(arrays: _Arrays) -> _Interpretation:
    """Return under which interpretation the truth lies best on the key points.

    Raises GhptDataError where it lies on them under none.
    """
    count = len(arrays.truth)
    rows = np.unique(np.linspace(0, count - 1, min(_SAMPLE, count)).astype(np.int64))
    truth_mm = _truth_unit(arrays, rows)
    truth, valid = arrays.true_joints(rows, truth_mm)
    corners = arrays.corners(rows)
    heights = np.abs(corners[..., 1, 1] - corners[..., 0, 1])
    has_box = heights > 0
    errors: dict[_Interpretation, float] = {}
    for camera_mm, distorted, mirrored in product(_UNITS_MM, (True, False), (False, True)):
        how = _Interpretation(truth_mm, camera_mm, distorted, mirrored)
        pixels, found = arrays.pixels(rows, mirrored)
        seen, in_front = _project(arrays, how, truth)
        distance = np.linalg.norm(pixels - seen, axis=-1)
        distance = np.where(in_front, distance, np.inf)[..., _LIMBS]
        compared = distance[(found & valid[:, None])[..., _LIMBS]]
        errors[how] = float(np.median(compared)) if compared.size else np.inf
    best = min(errors, key=lambda how: errors[how])
    limit = _FITS * float(np.median(heights[has_box])) if has_box.any() else 0.0
    if not errors[best] <= limit:
        problem = f"the truth lies {errors[best]:.0f} px from the key points (median)"
        raise GhptDataError(arrays.root, _TRUTH, problem, _HINT)
    _log.info(
        "%s: a unit of %g mm; key points of %s images%s; the truth lies %.1f px from them.",
        arrays.root,
        truth_mm,
        "distorted" if best.distorted else "undistorted",
        ", left and right exchanged" if best.mirrored else "",
        errors[best],
    )
    return best


def _truth_unit(arrays: _Arrays, rows: Int[np.ndarray, " N"]) -> float:
    """Return the unit (mm) in which the person has the size of one."""
    truth, valid = arrays.true_joints(rows, 1.0)
    trunk = np.linalg.norm(truth[:, JOINT["thorax"]] - truth[:, JOINT["pelvis"]], axis=-1)
    seen = trunk[valid[:, JOINT["thorax"]] & valid[:, JOINT["pelvis"]]]
    length = float(np.median(seen)) if len(seen) else 0.0
    fits = [unit for unit in _UNITS_MM if 0.5 < unit * length / _TRUNK_MM < 2]
    if not fits:
        problem = f"a trunk is {length:g} long, which is none in mm, cm or m"
        raise GhptDataError(arrays.root / _TRUTH, "", problem, _HINT)
    return fits[0]


def _project(
    arrays: _Arrays, how: _Interpretation, truth: Float[np.ndarray, "N 17 3"]
) -> tuple[Float[np.ndarray, "N V 17 2"], Bool[np.ndarray, "N V 17"]]:
    """Return where the images show the truth, and what is in front of the cameras."""
    cameras = how.cameras(arrays.cameras)
    pixels, depth = project(cameras, torch.from_numpy(truth).double())
    if how.distorted:
        frames, views, joints, _ = pixels.shape
        flat = pixels.transpose(0, 1).reshape(views, frames * joints, 2)
        shown = distort(flat, cameras.K, torch.from_numpy(arrays.distortion))
        pixels = shown.reshape(views, frames, joints, 2).transpose(0, 1)
    return pixels.numpy(), (depth > 0).numpy()
