"""caliscope's CSV of a tracker's points: a row for each point, camera and synchronised frame."""

from __future__ import annotations

import csv
import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.formats.csv_tables import open_table, read_header, read_numbers
from ghpt.data.formats.skeletons import SKELETONS, joints_of, recognise_beginning
from ghpt.data.formats.source import Source
from ghpt.data.people.detections import Detections, check_people
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

_log = logging.getLogger(__name__)
_CAMERAS = ("port", "cam_id")
"""What the column of the camera's number is called, until 2025 and since."""
_FRAME = "sync_index"
_POINTS = ("point_id", "keypoint_id")
"""What the column of the point's number is called, until 2025 and since."""
_PIXELS = ("img_loc_x", "img_loc_y")
_PERSON = "object_id"
"""The column of whose point it is, which a tracker of several people tells; since 2025."""
_MOST_PORTS = 1000
_WRITE = "It must be an xy_*.csv that caliscope wrote."
_BODY = len(SKELETONS["mediapipe_33"])
_HANDS = 100
"""From this number on MediaPipe's tracker counts the points of hands and face."""
_PLACES = np.full(221, -1)
"""The place in ``mediapipe_75`` of a ``point_id``: of the body, the right and the left hand."""
_PLACES[:33] = np.arange(33)
_PLACES[100:121] = np.arange(33, 54)
_PLACES[200:221] = np.arange(54, 75)

_LARGEST_NUMBER = 1e12
_LARGEST_POINT = 1 << 20


def is_caliscope(text: str) -> bool:
    """Return whether a file that starts so is one of caliscope's 2D tables.

    Its columns may be parted by commas or not.
    """
    header = text.splitlines()[0] if text else ""
    names = {name.strip().strip('"') for name in re.split("[,;\t]", header)}
    numbered = not names.isdisjoint(_CAMERAS) and not names.isdisjoint(_POINTS)
    return {_FRAME, *_PIXELS} <= names and numbered


def read_caliscope(source: Source) -> Detections:
    """Return everybody in the table, in the views ``cam_<number>``.

    The frame numbers are ``sync_index``; there is no confidence in these files. What a point's
    number means depends on the tracker, which the file does not name: it is the skeleton of as many
    points, or more, whose bones fit. MediaPipe's numbers leave a gap before hands and face; the
    body has 33 points, with hands 75, and the face is left out. Raises GhptDataError for a table
    that is damaged, or that has a point twice.
    """
    path = source.path
    table = _table(path)
    table = table[np.isfinite(table).all(1) & (table[:, 2] >= 0)]
    numbering = _number_joints(path, table[:, 2], source.skeleton)
    count = numbering.count
    left_out = len(np.unique(table[numbering.joint < 0, 2]))
    if left_out:
        _log.info("%s: %d points of face or hands are not read.", path, left_out)
    table = table[numbering.joint >= 0]
    joint = numbering.joint[numbering.joint >= 0]
    frames, row = np.unique(table[:, 0].astype(np.int64), return_inverse=True)
    ports, view = np.unique(table[:, 1].astype(np.int64), return_inverse=True)
    if len(ports) > _MOST_PORTS:
        raise GhptDataError(path, "port", f"names {len(ports)} cameras", _WRITE)
    objects, identity = np.unique(table[:, 5], return_inverse=True)
    cell = (view * len(frames) + row) * len(objects) + identity
    people, person = np.unique(cell, return_inverse=True)
    image, identity = np.divmod(people, len(objects))
    check_people(path, "", int(np.unique(image, return_counts=True)[1].max(initial=0)))
    if len(np.unique(person * count + joint)) != len(joint):
        problem = "a point is there twice in a frame of a camera"
        raise GhptDataError(path, "point_id", problem, _WRITE)
    name = numbering.skeleton
    points = np.zeros((len(people), count, 2))
    valid = np.zeros((len(people), count), np.bool_)
    points[person, joint] = table[:, 3:5]
    valid[person, joint] = True
    if name is None:
        name = recognise_beginning(path, points, valid)
    joints = joints_of(path, name)
    missing = len(joints) - count
    points = np.pad(points, ((0, 0), (0, missing), (0, 0)))
    valid = np.pad(valid, ((0, 0), (0, missing)))
    return Detections(
        path=str(path),
        views=tuple(f"cam_{port}" for port in ports),
        joints=joints,
        frame=frames,
        row=image % len(frames),
        view=image // len(frames),
        identity=identity if len(objects) > 1 else np.full(len(people), -1),
        points=KeyPoints(points, valid.astype(np.float64), valid),
    )


@dataclass(frozen=True)
class _Numbering:
    """Which joint each row of the table is of."""

    joint: Int[np.ndarray, " N"]
    """-1 for one that is left out."""
    count: int
    """Of joints; the last of the skeleton may never have been seen."""
    skeleton: str | None
    """Its name, where that is known."""


def _number_joints(path: Path, point: Float[np.ndarray, " N"], skeleton: str | None) -> _Numbering:
    """Return the joints of points by their numbers. Raises GhptDataError."""
    there = np.unique(point)
    body = there[there < _HANDS]
    if not len(body):
        problem = f"has no point below {_HANDS}, and so none of a body"
        raise GhptDataError(path, "point_id", problem, _WRITE)
    name = skeleton
    if body[-1] < _BODY and there[-1] >= _HANDS:
        known = point < len(_PLACES)
        joint = np.where(known, _PLACES[np.where(known, point, 0).astype(np.int64)], -1)
        has_hands = bool((joint >= _BODY).any())
        name = name or ("mediapipe_75" if has_hands else "mediapipe_33")
        if name == "mediapipe_33":
            joint[joint >= _BODY] = -1
    else:
        joint = np.minimum(point, _LARGEST_POINT).astype(np.int64)
    count = int(joint.max()) + 1
    most = len(joints_of(path, name)) if name else max(map(len, SKELETONS.values()))
    if count > most:
        problem = f"has a point of number {there[-1]:.0f}, and {name or 'a skeleton'} has {most}"
        raise GhptDataError(path, "point_id", problem, "Name the tracker's skeleton: skeleton=.")
    return _Numbering(joint, count, name)


def _table(path: Path) -> Float[np.ndarray, "N 6"]:
    """Return frame, camera, point, x, y and person of each row; the person is 0 where none is told.

    Raises GhptDataError.
    """
    try:
        with open_table(path) as handle:
            header = read_header(handle)
            camera = next((name for name in _CAMERAS if name in header), _CAMERAS[0])
            point = next((name for name in _POINTS if name in header), _POINTS[0])
            names = [_FRAME, camera, point, *_PIXELS]
            names += [_PERSON] if _PERSON in header else []
            table = read_numbers(handle, [header.index(name) for name in names])
    except (ValueError, csv.Error) as error:
        raise GhptDataError(path, "", f"is damaged ({error})", _WRITE) from error
    table = np.pad(table, ((0, 0), (0, 6 - table.shape[1])))
    index = table[:, [0, 1, 2, 5]]
    index = index[np.isfinite(index)]
    whole = (index == np.round(index)).all()
    if not whole or not (np.abs(np.nan_to_num(table)) < _LARGEST_NUMBER).all():
        problem = "holds an index that is not whole, or a number beyond 1e12"
        raise GhptDataError(path, "", problem, _WRITE)
    return table
