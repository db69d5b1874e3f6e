"""Prediction: from a folder of 2D key points and calibrated cameras to 3D poses."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ghpt.calibration.check.camera_check import CameraCheck
from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.display import display_path
from ghpt.commands.inputs import (
    InputSettings,
    own_cameras,
    own_people,
    own_title,
    recording_sequence,
    resolve_unit,
)
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.beside import compared_poses, find_videos
from ghpt.commands.prediction.camera_check import check_cameras
from ghpt.commands.prediction.gaps import OWN, Gaps, apply_gaps, gap_frames
from ghpt.commands.prediction.next_commands import commands_on
from ghpt.commands.prediction.page import PicturedPerson, limbs_of, write_page
from ghpt.commands.prediction.pictures import write_pictures
from ghpt.commands.prediction.report import report_document, summary_document, verdict_document
from ghpt.commands.prediction.result import PersonSummary, PredictionResult
from ghpt.commands.prediction.run import RunSettings, predict_shards
from ghpt.commands.prediction.shards import Shards
from ghpt.commands.prediction.statistics import (
    Evaluation,
    evaluate,
    measure_coverage,
)
from ghpt.commands.prediction.verdict import Judge, Level, Measures
from ghpt.commands.prediction.world import World, choose_world
from ghpt.commands.time import clock_of, people_in_one_time
from ghpt.config import Target, build, suggest
from ghpt.data.people.retimed import retime
from ghpt.data.people.sequence import Sequence
from ghpt.data.people.stored import open_stored, stored_sequence
from ghpt.errors import GhptCheckpointError, GhptDataError, check
from ghpt.export import WRITERS, Chunks, Evidence, Scene, find_marker_set
from ghpt.export.scene import images_of, origin_note
from ghpt.files import remove, sweep_temporaries, write_json
from ghpt.geometry.cameras import CameraSet
from ghpt.models.checkpoint import load_model
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.flips import LeftRightFlips
from ghpt.models.estimators.joint_means import JointMeans, all_joints, human_joints
from ghpt.models.estimators.predictors import Classical, Estimate, Learned, Predictor
from ghpt.models.estimators.trajectory.predictor import TrajectoryPredictor
from ghpt.models.estimators.trajectory.priors import NOMINAL_RATE
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.provenance import provenance
from ghpt.reconstruction import About, Reconstruction
from ghpt.report.course import sample_course
from ghpt.report.course_figure import ViewCourse
from ghpt.report.markdown import write_markdown
from ghpt.report.tables import NAMES
from ghpt.report.terminal import print_document
from ghpt.skeleton import Skeleton

_REPORTS = ("prediction.json", "report.md", "report.html")
SHARDS = ".shards"
"""The folder of the shards, within the output. It may be deleted: the next run then starts anew."""
_OWN_FORMATS = tuple(name for name in ("npz", "csv", "trc", "c3d", "html") if name in WRITERS)
"""The formats that need no further package."""
_TIMED_FORMATS = ("trc", "c3d")
_NOT_OF_SHARDS = ("command", "seed")
"""What shards do not depend on; where an estimator draws by the seed, its identity holds it."""
_LEAST_FRAMES = 10
"""Of a person beside the first, seen by two views: fewer tell nothing of the noise."""
_DEFAULTS = {
    "person": None,
    "ckpt": None,
    "joints": "detector",
    "world": "cameras",
    "floor": None,
    "markers": None,
}
"""Of conf/predict.yaml, which the commands to type next repeat where they are others."""
_FEW_JOINTS = (
    "%s: the key points give too few of the 17 joints by name: the size of the person, the cameras "
    "and exchanged sides are not checked (docs/skeletons.md)."
)
_UNKNOWN_RATE = "%s: the frame rate is unknown; %g Hz are assumed of its motion (rate_hz=60, say)."
_log = logging.getLogger(__name__)


TRAJECTORY = "trajectory"
"""The estimator of all frames together."""
ONLINE = "online"
"""The same while they are recorded."""
_ALIASES = {"frame": "adaptive_ransac"}
"""Other names of baselines."""


@dataclass(frozen=True)
class PredictorSettings:
    """How key points become joints: frame by frame, by a checkpoint's model, or together."""

    classical: Target
    learned: Target
    trajectory: Target
    online: Target


@dataclass(frozen=True, kw_only=True)
class PredictSettings(InputSettings):
    """The settings of predict.py."""

    videos: str | None
    person: int | None
    joints: Literal["detector", "human36m"]
    ckpt: str | None
    trust: list[str]
    hypotheses: int | None
    estimator: str
    lag: float
    fill: int | str | None
    interpolation: str | None
    smooth: float | None
    formats: list[str] | None
    trc: dict[str, Any]
    markers: str | None
    world: Literal["cameras", "people", "first"]
    floor: list[str] | None
    compare: list[str]
    evaluated_frames: int
    shard_frames: int
    batch: int
    progress_bar: bool
    baselines: dict[str, Target]
    trainer: dict[str, Any]
    flips: bool
    predictor: PredictorSettings
    view_weights: Target
    fitted_frames: int
    camera_check: Target
    verdict: Target
    strict: bool
    seed: int

    def non_defaults(self) -> dict[str, object]:
        """Return what says whose joints are written how, where it is not the default."""
        values = {name: getattr(self, name) for name in _DEFAULTS}
        return {name: value for name, value in values.items() if value != _DEFAULTS[name]}

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("evaluated_frames", "fitted_frames", "shard_frames", "batch"):
            count = getattr(self, name)
            check(count >= 1, name, f"is {count}", "Give 1 or more.")
        if not self.ckpt:
            names = (TRAJECTORY, ONLINE, *_ALIASES, *self.baselines)
            _check_exists("estimator", self.estimator, dict.fromkeys(names))
        for name in self.compare:
            _check_exists("compare", name, self.baselines)
        for name in self.formats or ():
            _check_exists("formats", name, WRITERS)
            WRITERS[name].check_installed(name)


def _check_exists(key: str, name: str, existing: Mapping[str, object]) -> None:
    check(name in existing, key, f"there is no {name!r}", suggest(name, existing))


@dataclass(frozen=True)
class PoseEstimator:
    """The estimator of a prediction."""

    name: str
    text: str
    """In words, for people."""
    predictor: Predictor
    flips: LeftRightFlips | None
    weights: torch.nn.Module | None
    identity: dict[str, Any]
    """What its results depend on, as plain data."""


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
        found = _predict_person(settings, setup, sequence, world, folder, shards)
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
    return _Setup(
        estimator=build_estimator(settings),
        compared={
            name: build(settings.baselines[name], f"baselines.{name}") for name in settings.compare
        },
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
    world: World | None,
    output: Path,
    folder: Path,
) -> _Predicted | None:
    """Predict one person and write their poses into ``output``, with shards in ``folder``.

    ``world`` is that of the files, None where it is to be chosen by this person. Returns None in
    the processes beside the first.
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
            world = world or _choose_world(settings, sequence, about, own)
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
    )


def summary(result: PredictionResult | None) -> str:
    """Return in words what `predict` returned."""
    if result is None or result.verdict is None:
        return "done by the first process"
    observed = f"{100 * result.coverage.share['observed']:.1f} % observed"
    frames = f"{result.coverage.frames} frames"
    return f"{result.data}: {frames}, {observed}, {result.verdict.level.words}"


def build_estimator(settings: PredictSettings) -> PoseEstimator:
    """Return the estimator of the checkpoint's model, or without one the classical estimator.

    Raises GhptCheckpointError for a model that does not predict poses.
    """
    if settings.ckpt:
        return _learned_estimator(settings, settings.ckpt)
    name = _ALIASES.get(settings.estimator, settings.estimator)
    if name == TRAJECTORY:
        text = "the trajectory of the whole recording (no ckpt was given)"
        group = _with_exchange(settings, settings.predictor.trajectory)
        return _trajectory(settings, TRAJECTORY, text, group)
    if name == ONLINE:
        text = f"the trajectory with a lag of {settings.lag:g} s (no ckpt was given)"
        online = dict(settings.predictor.online)
        own = _with_exchange(settings, online["settings"]) | {"lag_s": settings.lag}
        return _trajectory(settings, ONLINE, text, online | {"settings": own})
    group = _with_flips(settings, settings.predictor.classical)
    baseline = settings.baselines[name]
    factory = build(group, "predictor.classical")
    estimator: Estimator = build(baseline, f"baselines.{name}")
    predictor: Classical = factory(estimator=estimator)
    shown = NAMES.get(name, name.replace("_", " "))
    return PoseEstimator(
        name=name,
        text=f"{shown}, {estimator.sort} (no ckpt was given)",
        predictor=predictor,
        flips=predictor.flips,
        weights=None,
        identity=group | {"estimator": baseline},
    )


def _with_exchange(settings: PredictSettings, group: Target) -> dict[str, Any]:
    """Return what holds a trajectory, without exchanged sides if none are looked for."""
    if settings.flips:
        return dict(group)
    trajectory = dict(group["trajectory"])
    solver = dict(trajectory["solver"]) | {"exchange": None}
    return dict(group) | {"trajectory": trajectory | {"solver": solver}}


def _trajectory(
    settings: PredictSettings, name: str, text: str, group: dict[str, Any]
) -> PoseEstimator:
    flips: LeftRightFlips | None = build(settings.predictor.classical["flips"], "flips")
    return PoseEstimator(
        name=name,
        text=text,
        predictor=build(group, f"predictor.{name}"),
        flips=flips if settings.flips else None,
        weights=None,
        identity=group,
    )


def _learned_estimator(settings: PredictSettings, ckpt: str) -> PoseEstimator:
    changes = {"hypotheses": settings.hypotheses, "seed": settings.seed}
    model, trained = load_model(ckpt, settings.trust, **changes)
    if not isinstance(model.problem, PoseTriangulation):
        problem = f"is of a {type(model.problem).__name__}: it estimates no poses"
        raise GhptCheckpointError(ckpt, problem, "Give one that train.py model=pose wrote.")
    view_weights = build(settings.view_weights, "view_weights")(model)
    group = _with_flips(settings, settings.predictor.learned)
    predictor: Learned = build(group, "predictor.learned")(view_weights=view_weights)
    data = trained["provenance"].get("data", "unknown")
    return PoseEstimator(
        name="view_weights",
        text=f"the learned model of {Path(ckpt).name}, trained on {data}",
        predictor=predictor,
        flips=predictor.flips,
        weights=model,
        identity=group
        | {
            "view_weights": settings.view_weights,
            "ckpt_sha256": hashlib.sha256(Path(ckpt).read_bytes()).hexdigest(),
            "hypotheses": model.hypotheses,
            "seed": settings.seed,
        },
    )


def _with_flips(settings: PredictSettings, group: Target) -> dict[str, Any]:
    return dict(group) if settings.flips else dict(group) | {"flips": None}


def open_sequences(settings: PredictSettings, camera_check: CameraCheck) -> list[Sequence]:
    """Return who is predicted: the people in the user's own key points, or a recording of the data
    set.

    The most visible person comes first, and tells the unit of length.
    """
    if not settings.keypoints:
        return [recording_sequence(settings)]
    found = _files_sequences(settings, camera_check)
    sequences = [needed_key_points(settings, sequence) for sequence in found]
    first = sequences[0]
    first.cameras.check_calibrated(first.source)
    first = resolve_unit(first, camera_check.consensus, ask=True)
    return [replace(sequence, cameras=first.cameras) for sequence in sequences]


def needed_key_points(settings: PredictSettings, sequence: Sequence) -> Sequence:
    """Return the sequence of those key points that the joints of the files are made of.

    Raises GhptDataError where the 17 joints are needed, and the detector gives too few of them.
    """
    skeleton = sequence.skeleton
    if settings.ckpt or settings.joints == "human36m":
        skeleton.require_joints(sequence.source)
    if not skeleton.has_joints:
        _log.warning(_FEW_JOINTS, sequence.source)
    if settings.joints == "detector":
        return sequence
    parts = np.flatnonzero(skeleton.joint_weights.any(0))
    return sequence.select_key_points(parts.tolist())


def _files_sequences(settings: PredictSettings, camera_check: CameraCheck) -> list[Sequence]:
    cameras = own_cameras(settings, "Calib.toml")
    cameras.check_calibrated(str(settings.cameras))
    if settings.format in (None, "npz") and settings.session is None:
        path = str(settings.keypoints)
        least = settings.least_confidence
        stored = open_stored(path, settings.skeleton, settings.rate_hz, least)
        if stored is not None:
            title = own_title(settings)
            sequence = stored_sequence(stored, cameras, settings.match, settings.views, title)
            return [retime(sequence, clock_of(settings.time, sequence, camera_check.time))]
    people = own_people(settings)
    found = people_in_one_time(settings, people, cameras, settings.person, camera_check.time)
    if settings.person is None:
        return _long_enough(found)
    crowded = people.crowded_frames()
    if crowded:
        words = ", ".join(f"{count} frames of {view}" for view, count in crowded.items())
        _log.warning("Several people are in %s: person %d is followed.", words, settings.person)
    return found


def _long_enough(found: list[Sequence]) -> list[Sequence]:
    """Return the first person, and those of the others who can be predicted, with their numbers."""
    frames = [int((each.detected().valid.any(-1).sum(1) >= 2).sum()) for each in found]
    kept = [each for each, count in zip(found, frames, strict=True) if count >= _LEAST_FRAMES]
    left_out = sum(count < _LEAST_FRAMES for count in frames[1:])
    if left_out:
        text = "Left out: %d more, of whom each is seen by two views in fewer than %d frames."
        _log.warning(text, left_out, _LEAST_FRAMES)
    if len(kept) < 2:
        return found[:1]
    if frames[0] < _LEAST_FRAMES:
        kept = [found[0], *kept]
    names = enumerate(kept)
    return [replace(each, title=f"{each.title}, person {number}") for number, each in names]


def _interpolation(estimator: PoseEstimator) -> str:
    return OWN if estimator.name == TRAJECTORY else "pchip"


def _map_chunks(chunks: Chunks, function: Callable[[Reconstruction], Reconstruction]) -> Chunks:
    return lambda: map(function, chunks())


def _choose_world(
    settings: PredictSettings, sequence: Sequence, about: About, chunks: Chunks
) -> World:
    cameras = sequence.cameras.cameras
    total = len(sequence)
    return choose_world(settings.world, settings.floor, cameras, about.joints, chunks, total)


def joints_of(settings: PredictSettings, skeleton: Skeleton) -> JointMeans:
    """Return the joints of the files."""
    return human_joints(skeleton) if settings.joints == "human36m" else all_joints(skeleton)


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
