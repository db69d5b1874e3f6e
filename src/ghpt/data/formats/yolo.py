"""Ultralytics' labels of poses: a text file for each image, in shares of the image's size."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.frame_files import Person, read_frame_files
from ghpt.data.formats.layout import find_files
from ghpt.data.formats.skeletons import SKELETONS, joints_of
from ghpt.data.formats.source import Source
from ghpt.data.formats.validate import open_input
from ghpt.data.people.detections import Detections, check_people, joint_values, merge_views
from ghpt.errors import GhptDataError

_LARGEST = 1 << 20
"""Bytes of a file: 64 people of 136 joints need a fifth of that."""
_BOX = 5
"""Columns before the key points: class, centre and size of the box."""
_MOST_EXTRA = 2
"""Columns after them: the box's confidence (save_conf) and the track (track)."""
_LINE = re.compile(r"\d+(?:\.0+)?(?: -?\d+(?:\.\d+)?(?:e-?\d+)?){14,}")
_OF_VIDEO = re.compile(r".+_[1-9]\d*")
"""Labels of a video are named by its frames from 1 on, without zeros before; labels of images are
named as the images."""
_HINT = "It must be a file that yolo pose wrote with save_txt=True."


def looks_like_yolo(text: str) -> bool:
    """Return whether a file that begins so may be a label of somebody's pose."""
    return _LINE.match(text.partition("\n")[0]) is not None


def read_yolo(source: Source) -> Detections:
    """Return everybody in the labels, with pixels as shares of the image's width and height.

    The first frame of a video, whose label ends in ``_1``, is frame 0, as other tools count; labels
    of images keep the images' numbers. A label of 17 joints is COCO's; a joint at 0, 0 is missing,
    and its confidence is 1 where the files have none. Tracks are of one view alone and are not
    read. Raises GhptDataError.
    """
    files = find_files(source.path, (".txt",))
    # a list of classes or a note may lie beside them
    labels = [file for file in files if any(sign.isdigit() for sign in file.stem)]
    if not labels:
        problem = "holds no label, such as cam1_12.txt"
        raise GhptDataError(source.path, "", problem, "Detect with save_txt=True.")
    wanted = None if source.skeleton is None else len(joints_of(source.path, source.skeleton))
    found = read_frame_files(source, labels, lambda file: _people(file, wanted))
    if all(_OF_VIDEO.fullmatch(file.stem) for file in labels):
        found = [replace(view, frame=view.frame - 1) for view in found]
    counts = {view.points.valid.shape[1] for view in found if len(view)}
    skeleton = source.skeleton
    if skeleton is None and counts == {len(SKELETONS["coco_17"])}:
        skeleton = "coco_17"
    return replace(merge_views(source.path, found, skeleton), normalised=True)


def _people(file: Path, joints: int | None) -> list[Person]:
    with open_input(file) as handle:
        data = handle.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise GhptDataError(file, "", f"has more than {_LARGEST >> 20} MiB", _HINT)
    if data and not data.endswith((b"\n", b"\r")):
        problem = "ends in the middle of a line: it is truncated"
        raise GhptDataError(file, "", problem, "Copy it again, or end its last line.")
    lines = data.decode("utf-8", "replace").splitlines()
    rows = [line.split() for line in lines if line.strip()]
    check_people(file, "", len(rows))
    return [Person(_joints(file, index, row, joints)) for index, row in enumerate(rows)]


def _joints(file: Path, index: int, row: list[str], joints: int | None) -> Float[np.ndarray, "K 3"]:
    field = f"line {index + 1}"
    try:
        numbers = [float(cell) for cell in row[_BOX:]]
    except ValueError as error:
        raise GhptDataError(file, field, "holds what is no number", _HINT) from error
    each, count = _form(file, field, len(numbers), joints)
    values = joint_values(file, field, numbers[: each * count], each)
    if each == 2:
        values = np.concatenate([values, np.ones((count, 1))], axis=1)
    values[(values[:, :2] == 0).all(1)] = 0
    return values


def _form(file: Path, field: str, columns: int, joints: int | None) -> tuple[int, int]:
    """Return how many numbers a joint has, and how many joints there are.

    With or without a confidence for each joint and what may follow: the first form that gives a
    known number of joints, or a whole number of them.
    """
    known = {len(names) for names in SKELETONS.values()} if joints is None else {joints}
    forms = [
        (each, (columns - extra) // each)
        for each in (3, 2)
        for extra in range(_MOST_EXTRA + 1)
        if columns > extra and (columns - extra) % each == 0
    ]
    for form in forms:
        if form[1] in known:
            return form
    if joints is None and forms:
        return forms[0]
    problem = f"has {columns} numbers after the box, which are no key points"
    raise GhptDataError(file, field, problem, _HINT)
