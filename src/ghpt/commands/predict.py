"""Prediction: from a folder of 2D key points and calibrated cameras to 3D poses."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.inputs import (
    own_title,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.beside import compared_poses, find_videos
from ghpt.commands.prediction.camera_check import check_cameras
from ghpt.commands.prediction.estimator import PoseEstimator, build_estimator
from ghpt.commands.prediction.gaps import OWN, Gaps, apply_gaps, gap_frames
from ghpt.commands.prediction.next_commands import commands_on
from ghpt.commands.prediction.page import PicturedPerson, limbs_of, write_page
from ghpt.commands.prediction.pictures import write_pictures
from ghpt.commands.prediction.report import report_document, summary_document, verdict_document
from ghpt.commands.prediction.result import PersonSummary, PredictionResult
from ghpt.commands.prediction.run import RunSettings, predict_shards
from ghpt.commands.prediction.sequences import joints_of, open_sequences
from ghpt.commands.prediction.settings import ONLINE, TRAJECTORY, PredictSettings
from ghpt.commands.prediction.shards import Shards
from ghpt.commands.prediction.statistics import (
    Evaluation,
    evaluate,
    measure_coverage,
)
from ghpt.commands.prediction.verdict import Judge, Level, Measures
from ghpt.commands.prediction.world import Seen, World, choose_world
from ghpt.config import build
from ghpt.data.people.sequence import Sequence
from ghpt.errors import GhptDataError, check
from ghpt.export import WRITERS, Chunks, Evidence, Scene, find_marker_set
from ghpt.export.scene import images_of, origin_note
from ghpt.files import remove, sweep_temporaries, write_json
from ghpt.geometry.cameras import CameraSet
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.joint_means import JointMeans
from ghpt.models.estimators.predictors import Estimate, Predictor
from ghpt.models.estimators.trajectory.predictor import TrajectoryPredictor
from ghpt.models.estimators.trajectory.priors import NOMINAL_RATE
from ghpt.models.relative_pose.scale import MEASURED_FRAMES
from ghpt.provenance import provenance
from ghpt.reconstruction import About, Reconstruction
from ghpt.report.course import sample_course
from ghpt.report.course_figure import ViewCourse
from ghpt.report.markdown import write_markdown
from ghpt.report.terminal import print_document

_REPORTS = ("prediction.json", "report.md", "report.html")
SHARDS = ".shards"
"""The folder of the shards, within the output. It may be deleted: the next run then starts anew."""
_OWN_FORMATS = tuple(name for name in ("npz", "csv", "trc", "c3d", "html") if name in WRITERS)
"""The formats that need no further package."""
_TIMED_FORMATS = ("trc", "c3d")
_NOT_OF_SHARDS = ("command", "seed")
"""What shards do not depend on; where an estimator draws by the seed, its identity holds it."""
_UNKNOWN_RATE = "%s: the frame rate is unknown; %g Hz are assumed of its motion (rate_hz=60, say)."
_log = logging.getLogger(__name__)


def files(settings: PredictSettings) -> Files:
    """Return what a prediction reads and writes."""
    check_apart(settings.keypoints, settings.output)
    root = settings.data.get("root")
    names = [WRITERS[name].file for name in settings.formats or _OWN_FORMATS]
    return Files(
        reads=input_paths(settings.ckpt, settings.cameras, settings.keypoints, root),
        writes=(*names, *_REPORTS),
        growing=(SHARDS,),
    )


def predict(settings: PredictSettings, output: Path) -> PredictionResult | None:
    """Predict the 3D joints of everybody in the user's key points, or of a recording of the data
    set.

    Writes poses.<format>, prediction.json and report.md of the most visible person into ``output``,
    those of the others into its folders person_1, person_2, ..., and prints the tables; the shards
    that an interrupted run left are gone on with. The pictures in ``output`` show everybody.
    Returns what prediction.json holds, and None in the processes beside the first.
    """
    setup = _prepare(settings)
    sequences = open_sequences(settings, setup.camera_check)
    sweep_temporaries(output)
    results: list[PredictionResult] = []
    pictured: list[PicturedPerson] = []
    world: World | None = None
    for person, sequence in enumerate(sequences):
        folder = _person_folder(output, person)
        folder.mkdir(parents=True, exist_ok=True)
        shards = _person_folder(output / SHARDS, person)
        others = sequences[person + 1 :]
        found = _predict_person(settings, setup, sequence, others, world, folder, shards)
        if found is not None:
            world = found.world
            results.append(_judge(settings, setup, sequence, found.result, person, output))
            pictured.append(found.pictured)
    if world is None:
        return None
    _remove_others(output, len(sequences))
    first = results[0]
    cameras = world.cameras(sequences[0].cameras.cameras)
    if len(results) > 1:
        own = sequences[0].cameras
        scene = Scene(cameras, images=images_of(own, _videos(settings, own, output)))
        folders = [_person_folder(output, person) for person in range(len(results))]
        write_pictures(output, folders, own_title(settings), first.formats, scene)
        first = replace(first, people=tuple(map(_about_person, results)))
    for person, result in enumerate([first, *results[1:]]):
        folder = _person_folder(output, person)
        write_page(folder, result, pictured[person], pictured, world, cameras)
        _write_report(result, folder)
    verdict = first.verdict
    if settings.strict and verdict is not None and verdict.level != Level.GOOD:
        worst = verdict.findings[0]
        problem = f"{verdict.level.words}: {worst.text}"
        raise GhptDataError(first.source, "verdict", problem, f"Next: {worst.command}")
    return first


@dataclass(frozen=True)
class _Setup:
    """What a prediction is made with, for everybody alike."""

    estimator: PoseEstimator
    compared: dict[str, Estimator]
    camera_check: CameraCheck
    judge: Judge
    origin: dict[str, Any]


def _prepare(settings: PredictSettings) -> _Setup:
    comparable = settings.baselines | settings.peers
    return _Setup(
        estimator=build_estimator(settings),
        compared={name: build(comparable[name], f"compare.{name}") for name in settings.compare},
        camera_check=build(settings.camera_check, "camera_check"),
        judge=build(settings.verdict, "verdict"),
        origin=provenance(settings.seed),
    )


def _person_folder(output: Path, person: int) -> Path:
    """Return where a person's files are: the first person's are those of the output itself."""
    return output / f"person_{person}" if person else output


def _remove_others(output: Path, count: int) -> None:
    """Remove the files of people of an earlier run who are not among the ``count`` of this one."""
    names = (*(writer.file for writer in WRITERS.values()), *_REPORTS)
    for folder in output.glob("person_*"):
        number = folder.name.removeprefix("person_")
        if number.isdecimal() and int(number) >= count:
            for name in names:
                remove(folder / name)


@dataclass(frozen=True)
class _Predicted:
    """What became of a person."""

    result: PredictionResult
    """Without a verdict."""
    world: World
    """That of the files."""
    pictured: PicturedPerson


def _predict_person(
    settings: PredictSettings,
    setup: _Setup,
    sequence: Sequence,
    others: list[Sequence],
    world: World | None,
    output: Path,
    folder: Path,
) -> _Predicted | None:
    """Predict one person and write their poses into ``output``, with shards in ``folder``.

    ``world`` is that of the files, None where it is to be chosen by this person and the ``others``.
    Returns None in the processes beside the first.
    """
    estimator = setup.estimator
    gaps = Gaps(
        longest=gap_frames(settings.fill, sequence.rate_hz),
        interpolation=settings.interpolation or _interpolation(estimator),
        cut_off_hz=settings.smooth,
        rate_hz=sequence.rate_hz,
    )
    if settings.smooth and estimator.name in (TRAJECTORY, ONLINE):
        _log.info("smooth: a trajectory is smooth already; it is filtered once more.")
    if sequence.rate_hz is None and estimator.name in (TRAJECTORY, ONLINE):
        _log.info(_UNKNOWN_RATE, sequence.title, NOMINAL_RATE)
    joints = joints_of(settings, sequence.skeleton)
    about = _about(sequence, joints, estimator, gaps, setup.origin)
    if settings.markers:
        find_marker_set(settings.markers).check_joints(about.joints)
    formats = _formats(settings, sequence)
    videos = _videos(settings, sequence.cameras, output)
    _warn_of_origin(about, formats)
    _log.info(
        "%s: %d frames, %d views, by %s.",
        sequence.title,
        len(sequence),
        len(about.camera_names),
        estimator.text,
    )
    predictor = _fit(estimator, sequence, settings)
    key = _shard_key(sequence, estimator, setup.origin)
    how = RunSettings(
        settings.shard_frames, settings.batch, settings.progress_bar, settings.trainer
    )
    weights = estimator.weights
    with predict_shards(sequence, predictor, weights, folder, key, how) as shards:
        if shards is None:
            return None
        with apply_gaps(gaps, shards, len(sequence.skeleton), output) as key_points:
            own = _map_chunks(key_points, joints)
            world = world or _choose_world(settings, sequence, others, about, own)
            chunks = _map_chunks(own, world.reconstruction)
            scene = _scene(settings, setup, world, sequence, shards, videos)
            _write_formats(settings, output, world, about, chunks, formats, scene)
            views = about.camera_names
            coverage = measure_coverage(chunks(), about.joints, views, len(sequence))
            course = sample_course(chunks(), len(sequence), limbs_of(about.joints))
    evaluation, view_course = _evaluate(estimator, predictor, setup.compared, sequence, settings)
    result = PredictionResult(
        data=sequence.title,
        source=sequence.source,
        cameras=about.camera_names,
        estimator=estimator.name,
        estimator_text=estimator.text,
        rate_hz=sequence.rate_hz,
        fill_frames=gaps.longest,
        smooth_hz=gaps.cut_off_hz,
        coverage=coverage,
        scales=evaluation.estimators[estimator.name].scales,
        unit_mm=sequence.cameras.unit_mm,
        evaluation=evaluation,
        formats=formats,
        world=world.numbers(),
        provenance=about.provenance,
    )
    return _Predicted(result, world, PicturedPerson(about, view_course, course))


def _judge(
    settings: PredictSettings,
    setup: _Setup,
    sequence: Sequence,
    result: PredictionResult,
    person: int,
    output: Path,
) -> PredictionResult:
    """Return the result with its verdict. The first person alone is asked what the cameras lack."""
    measures = _measures(result)
    asked = not person and setup.camera_check.is_worthwhile(measures.view_errors)
    mistakes = check_cameras(sequence.as_joints(), setup.camera_check) if asked else ()
    own = settings.non_defaults() | ({"person": person} if person else {})
    commands = commands_on(settings, own, output)
    verdict = setup.judge(measures, mistakes, result.unit_mm, commands)
    return replace(result, verdict=verdict)


def _about_person(result: PredictionResult) -> PersonSummary:
    coverage = result.coverage
    level = result.verdict.level.words if result.verdict else ""
    return PersonSummary(coverage.share["observed"], coverage.stature_mm, level)


def _measures(result: PredictionResult) -> Measures:
    """Return what the verdict rests on."""
    rejected = result.coverage.share["rejected"]
    placed = rejected + result.coverage.share["observed"]
    return Measures(
        stature_mm=result.coverage.stature_mm,
        held_out_error=result.scales.all,
        view_errors=result.scales.views,
        rejected=rejected / placed if placed else 0.0,
        completeness=result.coverage.completeness,
    )


def summary(result: PredictionResult | None) -> str:
    """Return in words what `predict` returned."""
    if result is None or result.verdict is None:
        return "done by the first process"
    observed = f"{100 * result.coverage.share['observed']:.1f} % observed"
    frames = f"{result.coverage.frames} frames"
    return f"{result.data}: {frames}, {observed}, {result.verdict.level.words}"


def _interpolation(estimator: PoseEstimator) -> str:
    return OWN if estimator.name == TRAJECTORY else "pchip"


def _map_chunks(chunks: Chunks, function: Callable[[Reconstruction], Reconstruction]) -> Chunks:
    return lambda: map(function, chunks())


def _choose_world(
    settings: PredictSettings,
    sequence: Sequence,
    others: list[Sequence],
    about: About,
    chunks: Chunks,
) -> World:
    cameras = sequence.cameras.cameras
    floor = settings.floor
    total = len(sequence)
    seen = (_see(settings, other) for other in others)
    return choose_world(settings.world, floor, cameras, about.joints, chunks, total, seen)


def _see(settings: PredictSettings, sequence: Sequence) -> Seen:
    """Return the joints of a person in a few frames, each on its own."""
    estimator: Estimator = build(settings.baselines["adaptive_ransac"], "baselines.adaptive_ransac")
    poses = estimator(sequence.read(sequence.spread(MEASURED_FRAMES)))
    joints = joints_of(settings, sequence.skeleton).average_points(poses)
    return joints.points + sequence.origin, joints.estimated


def _fit(estimator: PoseEstimator, sequence: Sequence, settings: PredictSettings) -> Predictor:
    """Return the predictor for a sequence's key points, with what they tell of the recording."""
    predictor = estimator.predictor.for_skeleton(sequence.skeleton)
    return predictor.fit(sequence, settings.fitted_frames)


def _evaluate(
    estimator: PoseEstimator,
    predictor: Predictor,
    compared: Mapping[str, Estimator],
    sequence: Sequence,
    settings: PredictSettings,
) -> tuple[Evaluation, ViewCourse]:
    """Return what the estimators are worth on the 17 joints, or on all key points without them, and
    the held-out errors of the prediction's own over time. ``predictor``: fitted to the sequence.
    """
    judged = sequence.as_joints() if sequence.skeleton.has_joints else sequence
    sample = judged.read(judged.spread(settings.fitted_frames))
    own = predictor if judged is sequence else _fit(estimator, judged, settings)
    estimates: dict[str, Estimate] = {estimator.name: own.estimate}
    for name, other in compared.items():
        estimates.setdefault(name, other.fit_to(sample))
    flips = estimator.flips and estimator.flips.for_skeleton(judged.skeleton)
    test_halves = None
    if isinstance(own, TrajectoryPredictor):
        test_halves = own.trajectory.test_halves
    return evaluate(judged, flips, estimates, settings.evaluated_frames, test_halves)


def _about(
    sequence: Sequence,
    joints: JointMeans,
    estimator: PoseEstimator,
    gaps: Gaps,
    origin: dict[str, Any],
) -> About:
    made = {
        "estimator": estimator.text,
        "settings": estimator.identity,
        "fill_frames": gaps.longest,
        "interpolation": gaps.interpolation,
        "smooth_hz": gaps.cut_off_hz,
        "camera_unit_mm": sequence.cameras.unit_mm,
    }
    x, y, z = sequence.origin.tolist()
    return About(
        name=sequence.title,
        source=sequence.source,
        estimator=estimator.name,
        joints=joints.joints,
        bones=joints.bones,
        camera_names=sequence.cameras.names,
        rate_hz=sequence.rate_hz,
        smoothed=gaps.cut_off_hz is not None,
        provenance=origin | made,
        origin=(x, y, z),
    )


def _shard_key(sequence: Sequence, estimator: PoseEstimator, origin: dict[str, Any]) -> str:
    """Return what shards depend on, in one word."""
    parts = {
        "frames": sequence.digest(),
        "estimator": estimator.name,
        "settings": estimator.identity,
        "made": {name: value for name, value in origin.items() if name not in _NOT_OF_SHARDS},
    }
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _formats(settings: PredictSettings, sequence: Sequence) -> list[str]:
    """Return the formats that are asked for.

    Without any these are all that need no further package, but for those that need a rate where
    none is known.
    """
    if sequence.rate_hz:
        return settings.formats or list(_OWN_FORMATS)
    for name in settings.formats or ():
        problem = f"is unknown, and {name} needs it"
        check(name not in _TIMED_FORMATS, "rate_hz", problem, "Give rate_hz=60, say.")
    if settings.formats is None:
        timed = " and ".join(_TIMED_FORMATS)
        _log.warning("The files do not tell the frame rate: no %s. Give rate_hz=60, say.", timed)
    return settings.formats or [name for name in _OWN_FORMATS if name not in _TIMED_FORMATS]


def _warn_of_origin(about: About, formats: list[str]) -> None:
    """Say which files are not in the world's own millimetres, and from where they count."""
    single = [WRITERS[name].file for name in formats if WRITERS[name].single]
    if single and any(about.origin):
        text = "The rig is far from its world's zero: in %s, which have single precision, %s."
        _log.warning(text, ", ".join(single), origin_note(about))


def _scene(
    settings: PredictSettings,
    setup: _Setup,
    world: World,
    sequence: Sequence,
    shards: Shards,
    videos: tuple[str | None, ...],
) -> Scene:
    """Return what the pictures show beside the person."""
    cameras = sequence.cameras
    return Scene(
        world.cameras(cameras.cameras),
        evidence=lambda: _evidence(sequence, shards),
        images=images_of(cameras, videos),
        key_point_joints=joints_of(settings, sequence.skeleton).key_point_joints,
        others=compared_poses(
            sequence, setup.compared, setup.estimator.flips, settings.fitted_frames, world
        ),
    )


def _videos(settings: PredictSettings, cameras: CameraSet, output: Path) -> tuple[str | None, ...]:
    return find_videos(Path(settings.videos), cameras.names, output) if settings.videos else ()


def _write_formats(
    settings: PredictSettings,
    output: Path,
    world: World,
    about: About,
    chunks: Chunks,
    formats: list[str],
    scene: Scene,
) -> None:
    up = {"world_up": "z"} if world.name == "people" else {}
    given = {name: value for name, value in settings.trc.items() if value is not None}
    arguments: dict[str, dict[str, Any]] = {
        "trc": up | given,
        "html": {"scene": scene},
        "rerun": {"scene": scene},
    }
    about = world.about(about)
    markers = find_marker_set(settings.markers) if settings.markers else None
    for name in formats:
        writer = WRITERS[name]
        content = (about, chunks)
        if markers is not None and writer.has_markers:
            content = markers.rename(about, chunks)
        writer.write(output / writer.file, *content, **arguments.get(name, {}))


def _evidence(sequence: Sequence, shards: Shards) -> Iterator[Evidence]:
    """Yield the key points of each shard."""
    for shard in range(len(shards)):
        observations = sequence.read(np.array(shards.rows(shard)))
        yield Evidence(observations.key_points, observations.valid, None)


def _write_report(result: PredictionResult, output: Path) -> None:
    """Write prediction.json and report.md, and print the tables and the verdict."""
    write_json(output / "prediction.json", result.plain())
    write_markdown(output / "report.md", report_document(result))
    print_document(summary_document(result))
    written = ", ".join(WRITERS[name].file for name in result.formats)
    _log.info("Written: %s and report.md in %s.", written, display_path(output))
    print_document(verdict_document(result, display_path(output / "report.html")))


COMMAND = Command(
    name="predict", settings=PredictSettings, task=predict, summary=summary, files=files
)


if __name__ == "__main__":
    run_by_name("predict")
