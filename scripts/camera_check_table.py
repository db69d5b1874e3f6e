"""The camera check's confusion table: how good rigs were spoilt, and what was said of them.

``python scripts/camera_check_table.py`` takes the synthetic recordings; ``--real FOLDER`` adds
Pose2Sim's example and caliscope's recording from a folder with ``pose2sim_single`` and
``caliscope``.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import hydra
import torch

from ghpt.calibration.check.breakages import BREAKAGES, Case
from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.calibration.check.evidence import gather
from ghpt.calibration.check.setup import setup_of
from ghpt.commands.cameras import synthetic_evidence
from ghpt.config import build, plain
from ghpt.data.datasets.store import prepare
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.key_points import read_key_points
from ghpt.data.people.persons import person_sequence
from ghpt.report.document import Document, Table
from ghpt.report.markdown import render_markdown

ROOT = Path(__file__).resolve().parents[1]


def compose(overrides: list[str]) -> dict:
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return plain(hydra.compose("cameras", [*overrides, "output=unused"]))


def synthetic(
    camera_check: CameraCheck,
    names: list[str],
    splits: list[str],
    detector: str | None,
    frames: int,
    take: int,
) -> Iterator[tuple[str, Case]]:
    """The middle ``frames`` frames of ``take`` recordings of each arrangement, over all of its
    subjects in the splits; ``detector``: None for each arrangement's own.
    """
    own = [f"detector@data.synthetic.detector={detector}"] if detector else []
    for name in names:
        for split in splits:
            words = [f"data={name}", f"data.evaluate={split}", *own]
            data = build(compose(words)["data"], "data")
            made = {"source": data.source, "split": split}
            stored = prepare(
                data.cache,
                data.cache_key(split),
                lambda data=data, split=split: data.generate(split),
                made,
            )
            subjects = defaultdict(list)
            for recording in stored:
                subjects[recording.subject].append(recording)
            for number, of in enumerate(subjects.values()):
                for recording in of[number % 7 :: max(1, len(of) // take)][:take]:
                    evidence, file = synthetic_evidence(recording, data, camera_check, frames)
                    yield f"{name} {recording.name}", Case(evidence, setup_of(file))


def real(camera_check: CameraCheck, folder: Path) -> Iterator[tuple[str, Case]]:
    for name, points, cameras in (
        ("pose2sim", "pose2sim_single/pose", "pose2sim_single/Calib_qualisys.toml"),
        ("caliscope", "caliscope/xy_HOLISTIC.csv", "caliscope/camera_array.toml"),
    ):
        people = read_key_points(folder / points)
        file = read_cameras(folder / cameras)
        sequence = person_sequence(people, file, person=None, check_sizes=False)
        evidence = gather(sequence, camera_check.frames, camera_check.shift)
        yield name, Case(evidence, setup_of(sequence.cameras))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", nargs="*", default=["h36m", "cmu1", "cmu2", "cmu3", "cmu4"])
    parser.add_argument("--splits", nargs="*", default=["train", "validation", "test"])
    parser.add_argument("--detector", help="another than each arrangement's own: field")
    parser.add_argument("--frames", type=int, default=200, help="of each recording")
    parser.add_argument("--take", type=int, default=1, help="recordings of each subject")
    parser.add_argument("--limit", type=int, default=1 << 30, help="recordings of all")
    parser.add_argument("--kinds", nargs="*", default=[*BREAKAGES])
    parser.add_argument("--views", type=int, help="the first so many views alone")
    parser.add_argument("--real", type=Path, help="folder with pose2sim_single and caliscope")
    options = parser.parse_args()
    camera_check = build(compose([])["camera_check"], "camera_check")
    wanted = (options.data, options.splits, options.detector, options.frames, options.take)
    cases = list(islice(synthetic(camera_check, *wanted), options.limit))
    if options.real:
        cases += real(camera_check, options.real)
    table: dict[str, Counter] = defaultdict(Counter)
    seconds = []
    for name, case in cases:
        if options.views:
            case = first_views(case, options.views)
        for kind in ("nothing", *options.kinds):
            expected = "nothing" if kind == "nothing" else BREAKAGES[kind].code
            start = time.perf_counter()
            spoilt = case if kind == "nothing" else BREAKAGES[kind].spoil(case)
            result = camera_check(spoilt.evidence, spoilt.setup)
            seconds.append(time.perf_counter() - start)
            words = said(result.findings)
            table[kind][words] += 1
            if words != expected:
                before, after = (
                    " ".join(f"{x:.1f}" for x in e.tolist())
                    for e in (result.given_px, result.error_px)
                )
                print(f"{name}, {kind}: {words} [{before} -> {after} px]", flush=True)
    print_table(table)
    median = torch.tensor(seconds).median()
    times = f"seconds: median {median:.1f}, most {max(seconds):.1f}"
    print(f"\n{len(cases)} recordings; {times}")


def first_views(case: Case, count: int) -> Case:
    evidence = case.evidence
    setup = case.setup
    of_views = {name: value for name, value in vars(setup).items() if name != "unit_mm"}
    tensors = {name: value[:count] for name, value in of_views.items()}
    return Case(
        replace(
            evidence,
            names=evidence.names[:count],
            pixels=evidence.pixels[:count],
            valid=evidence.valid[:count],
        ),
        replace(setup, **tensors),
    )


def said(findings: tuple) -> str:
    return " + ".join(f.code + ("" if f.mended else "?") for f in findings) or "nothing"


def print_table(table: dict[str, Counter]) -> None:
    """A row for each way to spoil, with all that was said and how often."""
    rows = [
        [
            kind,
            "nothing" if kind == "nothing" else BREAKAGES[kind].code,
            ", ".join(f"{words} {count}" for words, count in row.most_common()),
        ]
        for kind, row in table.items()
    ]
    print(render_markdown(Document("", [Table(["broken", "to be said", "said, times"], rows)])))


if __name__ == "__main__":
    main()
