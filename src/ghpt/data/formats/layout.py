"""Which file of a folder is which view and which frame, whatever the format.

People lay out the same files in many ways: a folder for each camera, all cameras in one folder,
a file for each image or one for each video, several trials together, raw and filtered results side
by side. The rules here are about names alone, so they hold for all formats, and also for the names
of images in one file of results.
"""

from __future__ import annotations

import logging
import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

from ghpt.data.formats.names import Name, chosen_name
from ghpt.data.formats.validate import check_view_count
from ghpt.errors import GhptDataError

_log = logging.getLogger(__name__)

_MOST_FILES = 2_000_000
_DEEPEST = 6
"""Folders below the one that was named."""
_MOST_DIGITS = 15
"""Of a frame number."""
_CLEARLY_MORE = 2
"""A number before another one is the frame's if it has so many times as many values."""
_SEPARATORS = " _.-"
_DIGITS = re.compile(r"\d+")
_FIELDS = re.compile(r"[ _.-]+")
_BEFORE_FRAME = re.compile(r"(?:frame|frm|img|image)[ _.-]*$", re.IGNORECASE)
_BEFORE_OTHER = re.compile(
    r"(?:cam|camera|view|kinect|gopro|port|person|id|(?<![a-z])[cvp])[ _.-]*$", re.IGNORECASE
)
_CAMERA = re.compile(
    r"(?:cam(?:era)?|view|kinect|gopro|iphone|phone|device|port|hd|vga)[ _.-]?[a-z]?\d*(?:_\d+)?",
    re.IGNORECASE,
)
"""What a camera is called in a name that also tells something else."""
_STAGES = ("raw", "sync", "associated", "smoothed", "filtered", "proofread", "corrected")
"""What tools write into the names of the same results at later stages; the last one counts."""
_STAGE = re.compile(
    r"[ _.-]?(?<![a-z])(raw|sync(?:ed|hroni[sz]ed)?|associated|smoothed|filt(?:ered)?|proofread"
    r"|corrected)(?![a-z])",
    re.IGNORECASE,
)
_TOOL_BEFORE = re.compile(r"^(?:results|predictions|alphapose-results)[_.-](?=.)")
_TOOL_AFTER = re.compile(r"(?<=.)(?:DLC_.*|[_.-]?(?:predictions|analysis).*)$")
_SYSTEM_FOLDERS = ("__MACOSX",)


@dataclass(frozen=True)
class Frames:
    """The files of one view, each of one frame."""

    view: str
    files: dict[int, int]
    """By frame number: the index of the name that was given."""


@dataclass(frozen=True)
class _Item:
    """What belongs together: the files of a view in a folder, or a file of a whole recording."""

    folders: tuple[str, ...]
    name: str
    shown: str
    """By which an error names it."""
    stage: int = 0
    session: str = ""
    view: str = ""

    @property
    def place(self) -> tuple[str, str]:
        return self.session, self.view


def find_files(root: Path, endings: Collection[str]) -> list[Path]:
    """Return the files under a folder that end so, in order, or the file itself.

    Hidden files and folders are none of them, nor the ``._`` files that macOS leaves on foreign
    disks. Links to folders are followed, each folder once.
    """
    if not root.is_dir():
        return [root]
    found: list[Path] = []
    seen: set[str] = set()
    for folder, inside, files in os.walk(root, followlinks=True):
        depth = len(Path(folder).relative_to(root).parts)
        own = os.path.realpath(folder)
        if own in seen or depth >= _DEEPEST:
            inside.clear()
        if own in seen:
            continue
        seen.add(own)
        inside[:] = sorted(name for name in inside if not _is_hidden(name))
        names = (name for name in files if not _is_hidden(name))
        found += [Path(folder, name) for name in names if _ending(name) in endings]
        if len(found) > _MOST_FILES:
            problem = f"holds more than {_MOST_FILES} files"
            raise GhptDataError(root, "", problem, "Split the recording.")
    return sorted(found)


def without_strays(files: Sequence[Path], accept: Callable[[Path], bool]) -> list[Path]:
    """Return the files without those of folders above others that are not accepted.

    Calibrations and settings often lie there; a folder that holds nothing deeper has data alone.
    """
    above = {folder for file in files for folder in file.parent.parents}
    return [file for file in files if file.parent not in above or accept(file)]


def arrange_frames(
    where: Path, names: Sequence[PurePath], session: Name = None
) -> tuple[Frames, ...]:
    """Return the views of files that hold one frame each, by view name.

    The frame's number is, of the numbers in a name that change within a folder, the last one,
    unless one before it has clearly more values; words like ``frame`` and ``cam`` before a number
    tell more than both. The rest of the name and the folders tell view and session as `_assign`
    says. Raises GhptDataError.
    """
    names = _compose(names)
    rest, frames = _frame_numbers(where, names)
    series: dict[tuple[tuple[str, ...], str, str], dict[int, int]] = defaultdict(dict)
    for index, name in enumerate(names):
        folders = _inner_folders(name)
        numbered = series[folders, *rest[index]]
        other = numbered.setdefault(frames[index], index)
        if other != index:
            problem = f"has the frame number {frames[index]}, as {names[other].name} has"
            hint = "Keep one file for each frame of a view."
            raise GhptDataError(where / name, "", problem, hint)
    own_before = len({before for _, before, _ in series}) > 1
    own_after = len({after for _, _, after in series}) > 1
    items = []
    for (folders, before, after), numbered in series.items():
        first = names[next(iter(numbered.values()))]
        kept_before = before if own_before or not own_after else ""
        text = _join((kept_before, after if own_after else ""))
        items.append(_Item(folders, text, str(first)))
    chosen = _assign(where, items, session)
    listed = list(series.values())
    views = [Frames(item.view or where.name, listed[index]) for index, item in chosen.items()]
    return tuple(sorted(views, key=lambda view: view.view))


def arrange_recordings(
    where: Path, names: Sequence[PurePath], session: Name = None
) -> tuple[tuple[str, int], ...]:
    """Return the views of files that hold a whole recording of a view each: name and file's index.

    Raises GhptDataError.
    """
    named = _compose(names)
    items = [_Item(_inner_folders(name), name.stem, str(name)) for name in named]
    chosen = _assign(where, items, session)
    return tuple(sorted((item.view, index) for index, item in chosen.items()))


def frame_numbers(where: Path, names: Sequence[PurePath]) -> list[int]:
    """Return the frame numbers in the names of one view's images. Raises GhptDataError."""
    flat = [PurePath(name.name) for name in names]
    return _frame_numbers(where, flat)[1]


def _compose(names: Sequence[PurePath]) -> list[PurePath]:
    """Return the names with a letter and its accent as one character, as people type them.

    macOS stores them apart.
    """
    return [
        name if str(name).isascii() else PurePath(unicodedata.normalize("NFC", str(name)))
        for name in names
    ]


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name in _SYSTEM_FOLDERS


def _ending(name: str) -> str:
    return os.path.splitext(name)[1].lower()


def _inner_folders(name: PurePath) -> tuple[str, ...]:
    return tuple(part for part in name.parent.parts if part not in ("/", "."))


def _trim_tool(stem: str) -> str:
    """Return a file's name without what tools add to the video's."""
    return _TOOL_AFTER.sub("", _TOOL_BEFORE.sub("", stem)).strip(_SEPARATORS) or stem


def _frame_numbers(
    where: Path, names: Sequence[PurePath]
) -> tuple[list[tuple[str, str]], list[int]]:
    """Return what stands before and after each name's frame number, and the number."""
    forms: dict[tuple[str, ...], list[int]] = defaultdict(list)
    numbers = []
    for index, name in enumerate(names):
        numbers.append(_DIGITS.findall(name.stem))
        forms[tuple(_DIGITS.split(name.stem))].append(index)
    rest = [("", "")] * len(names)
    frames = [0] * len(names)
    for texts, indices in forms.items():
        if len(texts) == 1:
            problem = "its name has no frame number"
            hint = "Name the files like cam1_000012.json, and put other files elsewhere."
            raise GhptDataError(where / names[indices[0]], "", problem, hint)
        folders: dict[PurePath, list[int]] = defaultdict(list)
        for index in indices:
            folders[names[index].parent].append(index)
        slot = _frame_slot(texts, [[numbers[i] for i in inside] for inside in folders.values()])
        for inside in folders.values():
            rows = [numbers[index] for index in inside]
            alone = len({int(row[slot][-_MOST_DIGITS:]) for row in rows}) == len(rows)
            kept = rows[0] if alone else None
            for index, row in zip(inside, rows, strict=True):
                if len(row[slot].lstrip("0")) > _MOST_DIGITS:
                    problem = "its name has no frame number"
                    hint = f"A number of more than {_MOST_DIGITS} digits is none."
                    raise GhptDataError(where / names[index], "", problem, hint)
                frames[index] = int(row[slot])
                rest[index] = _around(texts, kept or row, slot)
    return rest, frames


def _around(texts: Sequence[str], numbers: Sequence[str], slot: int) -> tuple[str, str]:
    """Return what stands before and after the number at ``slot``."""
    words = [texts[0]]
    for number, text in zip(numbers, texts[1:], strict=True):
        words += [number, text]
    place = 2 * slot + 1
    before = _BEFORE_FRAME.sub("", "".join(words[:place])).strip(_SEPARATORS)
    return before, "".join(words[place + 1 :]).strip(_SEPARATORS)


def _frame_slot(texts: Sequence[str], folders: Sequence[Sequence[Sequence[str]]]) -> int:
    """Return which of the numbers in names of one form is the frame's.

    ``folders`` has the numbers of each name of each folder.
    """
    scores = []
    for slot in range(len(texts) - 1):
        values = [{int(row[slot][-_MOST_DIGITS:]) for row in rows} for rows in folders]
        most = max(values, key=len)
        hint = 0
        if _BEFORE_FRAME.search(texts[slot]):
            hint = 1
        elif _BEFORE_OTHER.search(texts[slot]):
            hint = -1
        # of a frame number and a time that change together the frame number has smaller steps
        alone = any(len(own) == len(rows) > 1 for own, rows in zip(values, folders, strict=True))
        span = max(most) - min(most) if alone else 0
        scores.append((len(most) > 1, hint, len(most), -span, slot))
    best = max(scores)
    same = [score for score in scores if score[:2] == best[:2]]
    last = same[-1]
    # a few frames may be fewer than the cameras
    alone = best[3] != 0 or last[3] != 0
    return best[-1] if alone or best[2] > _CLEARLY_MORE * last[2] else last[-1]


def _assign(where: Path, items: Sequence[_Item], session: Name) -> dict[int, _Item]:
    """Return, by index, those of the items that are read, with their views.

    1. Of the same results at several stages (raw, filtered) the last stage is read.
    2. Where folders differ, a folder is a view: the one whose names are cameras', or else the
       innermost. Other folders that differ, and different files within a view's folder, are
       sessions.
    3. Where one folder holds all files, a file's name is the view's; it is a session's too where a
       camera's name in it is there again with something else around it.

    Raises GhptDataError where several sessions are there and ``session`` chooses none, and for two
    files of one view.
    """
    cleaned = [_without_stage(item) for item in items]
    kept = _last_stages([replace(item, name=_trim_tool(item.name)) for item in cleaned])
    left_out = [item.shown for index, item in enumerate(items) if index not in kept]
    if left_out:
        example = next(iter(kept.values())).shown
        text = "%s: %d files are left out beside later stages of them, such as %s for %s"
        _log.info(text, where, len(left_out), example, left_out[0])
    indices = list(kept)
    placed = dict(zip(indices, _place(list(kept.values()), session), strict=True))
    chosen = _choose_session(where, placed, session)
    check_view_count(where, len(chosen))
    shown: dict[str, str] = {}
    for item in chosen.values():
        other = shown.setdefault(item.view, item.shown)
        if other != item.shown:
            problem = f"{other} and {item.shown} are both of the view {item.view}"
            raise GhptDataError(where, "", problem, "Keep one of them there.")
    return chosen


def _without_stage(item: _Item) -> _Item:
    """Return the item with the stage taken out of its names."""
    found = []
    names = []
    for name in (*item.folders, item.name):
        found += [word.lower() for word in _STAGE.findall(name)]
        names.append(_STAGE.sub("", name).strip(_SEPARATORS) or name)
    stages = [at for at, stage in enumerate(_STAGES) for w in found if w.startswith(stage[:4])]
    folders = tuple(names[:-1])
    return replace(item, folders=folders, name=names[-1], stage=max(stages, default=0))


def _last_stages(items: Sequence[_Item]) -> dict[int, _Item]:
    last: dict[tuple[tuple[str, ...], str], int] = {}
    for index, item in enumerate(items):
        key = (item.folders, item.name)
        if key not in last or items[last[key]].stage < item.stage:
            last[key] = index
    # two files of one stage are two: whoever reads them is told
    stages = {key: items[index].stage for key, index in last.items()}
    return {
        index: item
        for index, item in enumerate(items)
        if item.stage == stages[item.folders, item.name]
    }


def _place(items: Sequence[_Item], session: Name) -> list[_Item]:
    """Return the items with their session and view."""
    names = [item.name for item in items]
    columns = _folder_columns(items)
    if not columns:
        places = _split_names(names, session)
    else:
        several = len(set(zip(*columns, strict=True))) < len(items)
        named = _are_cameras(names) and not any(map(_are_cameras, columns))
        if several or (named and len(set(names)) > 1):
            columns = [*columns, names]
        at = _view_column(columns, columns[-1] is names, session)
        views = columns[at]
        others = [column for place, column in enumerate(columns) if place != at]
        cleaned = [_residual(own, views) if own is names else own for own in others]
        sessions = [_join(words) for words in zip(*cleaned, strict=True)] or [""] * len(items)
        if columns[at] is names:
            views = _residual(names, sessions)
        places = list(zip(sessions, views, strict=True))
    views_once = session is None and len({view for _, view in places}) == len(places)
    return [
        replace(item, session="" if views_once else own, view=view or item.name)
        for item, (own, view) in zip(items, places, strict=True)
    ]


def _folder_columns(items: Sequence[_Item]) -> list[list[str]]:
    """Return the names of each level of folders that differ; of levels that tell the same, one."""
    depth = max(len(item.folders) for item in items)
    padded = [("",) * (depth - len(item.folders)) + item.folders for item in items]
    columns = [list(column) for column in zip(*padded, strict=True) if len(set(column)) > 1]
    columns.sort(key=_are_cameras)
    kept: list[list[str]] = []
    for place, column in enumerate(columns):
        if not any(_same_division(column, other) for other in columns[place + 1 :]):
            kept.append(column)
    return kept


def _same_division(a: Sequence[str], b: Sequence[str]) -> bool:
    return len(set(a)) == len(set(b)) == len(set(zip(a, b, strict=True)))


def _are_cameras(names: Sequence[str]) -> bool:
    return all(_CAMERA.search(name) for name in names)


def _view_column(columns: Sequence[Sequence[str]], names_last: bool, session: Name) -> int:
    """Return which of the columns names the views."""
    wanted = [str(session) in column for column in columns]
    cameras = [
        place for place, column in enumerate(columns) if _are_cameras(column) and not wanted[place]
    ]
    folders = [place for place in range(len(columns) - names_last) if not wanted[place]]
    # the names of the files repeat their camera's: a folder of cameras comes first
    found = [place for place in cameras if place in folders] or cameras or folders
    return found[-1] if found else len(columns) - 1


def _residual(names: Sequence[str], others: Sequence[str]) -> list[str]:
    """Return the names without their fields that all share, or that go with ``others``."""
    fields = [_FIELDS.split(name) for name in names]
    if len({len(own) for own in fields}) > 1:
        return list(names)
    kept = []
    for column in zip(*fields, strict=True):
        if len(set(column)) > 1 and not _same_division(column, others):
            kept.append(column)
    if not kept:
        return list(names)
    return ["_".join(own) for own in zip(*kept, strict=True)]


def _split_names(names: Sequence[str], session: Name) -> list[tuple[str, str]]:
    """Return session and view of files that lie in one folder."""
    found = [_CAMERA.search(name) for name in names]
    views = [match[0] if match else name for match, name in zip(found, names, strict=True)]
    if session is not None:
        fields = [_FIELDS.split(name) for name in names]
        own = [str(session) if str(session) in words else "" for words in fields]
        left = [[word for word in words if word != str(session)] for words in fields]
        if any(own):
            return [(name, _join(words)) for name, words in zip(own, left, strict=True)]
    if not all(found) or len(set(views)) == len(names):
        return [("", name) for name in names]
    rest = [
        name.replace(view, "", 1).strip(_SEPARATORS)
        for name, view in zip(names, views, strict=True)
    ]
    return list(zip(rest, views, strict=True))


def _join(words: Sequence[str]) -> str:
    return "_".join(word for word in words if word)


def _choose_session(where: Path, items: dict[int, _Item], session: Name) -> dict[int, _Item]:
    """Return the items of the session that was chosen, or of the only one."""
    counts = Counter(item.session for item in items.values())
    there = ", ".join(sorted(name or "(without a name)" for name in counts))
    if session is None:
        if len(counts) > 1:
            example = next(name for name in sorted(counts) if name)
            problem = f"several sessions are in it: {there}"
            raise GhptDataError(where, "", problem, f"Choose one: session={example}.")
        return items
    chosen = chosen_name(session, counts)
    if chosen not in counts:
        problem = f"there is no session {chosen!r}"
        hint = f"There are: {there}." if any(counts) else "It holds one session: leave this out."
        raise GhptDataError(where, "session", problem, hint)
    return {index: item for index, item in items.items() if item.session == chosen}
