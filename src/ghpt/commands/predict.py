"""Prediction: from a folder of 2D key points and calibrated cameras to 3D poses."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NotRequired

import numpy as np
import torch
from jaxtyping import Int

from ghpt.commands.app import Command
from ghpt.commands.catalogue import run_by_name
from ghpt.commands.calibrate import from_data
from ghpt.commands.inputs import InputSettings, own_cameras
from ghpt.commands.outputs import Files, check_apart, input_paths
from ghpt.commands.prediction.camera_check import check_cameras
from ghpt.commands.prediction.frames import (
    Detected,
    Frames,
    Seen,
    calibrated,
    evidence,
    frames_of_views,
    in_unit,
)
from ghpt.commands.prediction.gaps import Gaps, after, gap_frames
from ghpt.commands.prediction.next_commands import commands_on
from ghpt.commands.prediction.report import prediction_report, print_prediction, print_verdict
from ghpt.commands.prediction.run import predicted
from ghpt.commands.prediction.statistics import Estimate, counts, estimate_of, evaluate
from ghpt.commands.prediction.stored import frames_of_stored, open_stored
from ghpt.commands.prediction.verdict import Level, Measures
from ghpt.commands.train import display_path
from ghpt.config import build, check_type, suggest
from ghpt.data.formats.key_points import read_people
from ghpt.data.formats.skeletons import joints17
from ghpt.data.people.views import as_one_person, undistort_and_match
from ghpt.errors import GhptCheckpointError, GhptDataError, check
from ghpt.export import WRITERS, Scene
from ghpt.export.scene import origin_note
from ghpt.files import atomic_write, sweep_temporaries, write_json
from ghpt.models.checkpoint import load_model
from ghpt.models.estimators.flips import LeftRightFlips
from ghpt.models.estimators.predictors import Classical, Learned
from ghpt.models.pose.problem import PoseTriangulation
from ghpt.provenance import provenance
from ghpt.reconstruction import About
from ghpt.report.tables import NAMES
from ghpt.skeleton import JOINTS

SHARDS = ".shards"
"""The folder of the shards, within the output. It may be deleted: the next run then starts anew."""
_ALL = tuple(name for name in ("npz", "csv", "trc", "c3d", "html") if name in WRITERS)
"""The formats that need no further package."""
_TIMED = ("trc", "c3d")
_log = logging.getLogger(__name__)


class Settings(InputSettings):
    """What `predict` needs of the configuration."""

    person: int
    ckpt: str | None
    trust: NotRequired[list[str]]
    hypotheses: int | None
    triangulation: str
    fill: int | str | None
    interpolation: str
    smooth: float | None
    formats: list[str] | None
    trc: dict[str, Any]
    compare: list[str]
    evaluated_frames: int
    shard_frames: int
    batch: int
    progress_bar: bool
    baselines: dict[str, Any]
    trainer: dict[str, Any]
    flips: bool
    estimator: dict[str, Any]
    view_weights: dict[str, Any]
    fitted_frames: int
    camera_check: dict[str, Any]
    verdict: dict[str, Any]
    strict: bool
    seed: int


@dataclass(frozen=True)
class Chosen:
    """The estimator of a prediction."""

    name: str
    text: str
    """In words, for people."""
    predictor: Classical | Learned
    flips: LeftRightFlips | None
    weights: torch.nn.Module | None
    identity: dict[str, Any]
    """What its results depend on, as plain data."""


def files(config: dict[str, Any]) -> Files:
    """What a prediction reads and writes. Raises GhptConfigError for settings that cannot work."""
    check_type(config, Settings, "")
    _check(config)
    check_apart(config)
    names = [WRITERS[name].file for name in config["formats"] or _ALL]
    return Files(
        reads=input_paths(config),
        writes=(*names, "prediction.json", "report.md"),
        growing=(SHARDS,),
    )


def predict(config: dict[str, Any], output: Path) -> dict[str, Any]:
    """Predict the 3D joints of ``config["keypoints"]``, or of a recording of ``config["data"]``.

    Writes poses.<format>, prediction.json and report.md into ``output`` and prints the tables; the
    shards that an interrupted run left are gone on with. Returns what prediction.json holds.
    """
    check_type(config, Settings, "")
    _check(config)
    chosen = choose(config)
    compared = {
        name: build(config["baselines"][name], f"baselines.{name}") for name in config["compare"]
    }
    camera_check = build(config["camera_check"], "camera_check")
    judge = build(config["verdict"], "verdict")
    frames = (
        in_unit(from_files(config), camera_check.consensus) if config["keypoints"] else _from_data(config)
    )
    hertz = None if config["smooth"] is None else float(config["smooth"])
    gaps = Gaps(
        gap_frames(config["fill"], frames.rate_hz), config["interpolation"], hertz, frames.rate_hz
    )
    unit = frames.detected.cameras.unit_mm if frames.detected else 1.0
    origin = provenance(config["seed"])
    about = About(
        name=frames.title,
        source=frames.source,
        estimator=chosen.name,
        joints=JOINTS,
        camera_names=frames.camera_names,
        rate_hz=frames.rate_hz,
        smoothed=config["smooth"] is not None,
        provenance=origin
        | {
            "estimator": chosen.text,
            "settings": chosen.identity,
            "fill_frames": gaps.longest,
            "interpolation": gaps.interpolation,
            "smooth_hz": gaps.cut_off_hz,
            "camera_unit_mm": unit,
        },
        origin=tuple(frames.origin.tolist()),
    )
    formats = _formats(config, frames)
    _tell_origin(about, formats)
    _log.info(
        "%s: %d frames, %d views, by %s.",
        frames.title,
        len(frames),
        len(frames.camera_names),
        chosen.text,
    )
    sweep_temporaries(output)
    predictor = chosen.predictor.fitted(frames.batch(frames.spread(config["fitted_frames"])))
    key = _key(frames, chosen, origin)
    with predicted(frames, predictor, chosen.weights, output / SHARDS, key, config) as shards:
        if shards is None:
            return {}
        with after(gaps, shards, len(JOINTS), output) as chunks:
            scene = Scene(frames.cameras, lambda: evidence(frames, shards))
            settings = {"trc": config["trc"], "html": {"scene": scene}, "rerun": {"scene": scene}}
            for name in formats:
                WRITERS[name].write(
                    output / WRITERS[name].file, about, chunks, **settings.get(name, {})
                )
            found = counts(chunks(), about.joints, about.camera_names, len(frames))
    estimates: dict[str, Estimate] = {chosen.name: estimate_of(predictor.rejecting_nothing())}
    estimates |= {name: baseline for name, baseline in compared.items() if name != chosen.name}
    evaluation = evaluate(
        frames, chosen.flips, estimates, config["evaluated_frames"], config["batch"]
    )
    own = evaluation["estimators"][chosen.name]
    numbers = {
        "data": frames.title,
        "source": frames.source,
        "cameras": list(frames.camera_names),
        "estimator": chosen.name,
        "estimator_text": chosen.text,
        "rate_hz": frames.rate_hz,
        "fill_frames": gaps.longest,
        "smooth_hz": gaps.cut_off_hz,
        **found,
        "scales": own["scales"],
        "unit_mm": unit,
        "evaluation": evaluation,
        "formats": formats,
        "provenance": about.provenance,
    }
    measures = Measures.from_numbers(numbers)
    asks = camera_check.is_worthwhile(measures.view_errors)
    mistakes = check_cameras(frames, camera_check) if asks else ()
    verdict = judge(measures, mistakes, unit, commands_on(config, output))
    numbers["verdict"] = verdict.numbers()
    write_json(output / "prediction.json", numbers)
    with atomic_write(output / "report.md", "w") as handle:
        handle.write(prediction_report(numbers))
    print_prediction(numbers)
    files = ", ".join(WRITERS[name].file for name in formats)
    _log.info("Written: %s and report.md in %s.", files, display_path(output))
    print_verdict(numbers["verdict"])
    if config["strict"] and verdict.level != Level.GOOD:
        worst = verdict.findings[0]
        problem = f"{verdict.level.words}: {worst.text}"
        raise GhptDataError(frames.source, "verdict", problem, f"Next: {worst.command}")
    return numbers


def summary(numbers: dict[str, Any]) -> str:
    """What `predict` returned, in words."""
    if not numbers:
        return "done by the first process"
    observed = f"{100 * numbers['share']['observed']:.1f} % observed"
    return (
        f"{numbers['data']}: {numbers['frames']} frames, {observed}, {numbers['verdict']['level']}"
    )


def choose(config: dict[str, Any]) -> Chosen:
    """The checkpoint's model, or without one the classical estimator. Raises GhptCheckpointError
    for a model that does not predict poses.
    """
    kind = "learned" if config["ckpt"] else "classical"
    settings = config["estimator"][kind] | ({} if config["flips"] else {"flips": None})
    if not config["ckpt"]:
        name = config["triangulation"]
        text = (
            f"{NAMES.get(name, name.replace('_', ' '))}, a classical estimator (no ckpt was given)"
        )
        estimator = config["baselines"][name]
        predictor = build(settings, "estimator.classical")(
            estimator=build(estimator, f"baselines.{name}")
        )
        return Chosen(
            name, text, predictor, predictor.flips, None, settings | {"estimator": estimator}
        )
    changes = {"hypotheses": config["hypotheses"], "seed": config["seed"]}
    model, trained = load_model(config["ckpt"], config.get("trust") or (), **changes)
    if not isinstance(model.problem, PoseTriangulation):
        problem = f"is of a {type(model.problem).__name__}: it estimates no poses"
        raise GhptCheckpointError(
            config["ckpt"], problem, "Give one that train.py model=pose wrote."
        )
    digest = hashlib.sha256(Path(config["ckpt"]).read_bytes()).hexdigest()
    text = f"the learned model of {Path(config['ckpt']).name}, trained on {trained['provenance'].get('data', 'unknown')}"
    view_weights = build(config["view_weights"], "view_weights")(model)
    predictor = build(settings, "estimator.learned")(view_weights=view_weights)
    identity = settings | {
        "view_weights": config["view_weights"],
        "ckpt_sha256": digest,
        "hypotheses": model.hypotheses,
        "seed": config["seed"],
    }
    return Chosen("view_weights", text, predictor, predictor.flips, model, identity)


def from_files(config: dict[str, Any]) -> Frames:
    """The user's own key points and cameras."""
    cameras = own_cameras(config, "Calib.toml")
    calibrated(str(config["cameras"]), cameras)
    title = f"{Path(config['keypoints']).resolve().name} with {Path(config['cameras']).name}"
    rate = None if config["rate_hz"] is None else float(config["rate_hz"])
    stored = (
        open_stored(config["keypoints"], config["skeleton"], rate)
        if config["format"] in (None, "npz")
        else None
    )
    if stored is not None:
        return frames_of_stored(stored, cameras, config["match"], config["views"], title)
    people = read_people(config["keypoints"], config["skeleton"], rate, config["format"])
    points, at, ordered = as_one_person(
        people, cameras, config["match"], config["views"], config["person"]
    )
    views = undistort_and_match(points, cameras, config["match"], config["views"])

    def detected(rows: Int[np.ndarray, " N"]) -> Seen:
        values = (
            part[rows][:, at] for part in (points.key_points, points.confidence, points.valid)
        )
        return joints17(points.path, points.joints, *values)

    several = dict(zip(people.views, (people.counts() > 1).sum(0).tolist(), strict=True))
    if any(several.values()):
        words = ", ".join(f"{n} frames of {view}" for view, n in several.items() if n)
        _log.warning(
            "Several people are in %s: person %d is followed (person=).", words, config["person"]
        )
    frames = frames_of_views(views, str(Path(config["keypoints"]).resolve()), title)
    return replace(frames, detected=Detected(ordered, detected))


def _from_data(config: dict[str, Any]) -> Frames:
    case = from_data(config)
    return frames_of_views(case.views, case.source, case.title)


def _key(frames: Frames, chosen: Chosen, origin: dict[str, Any]) -> str:
    """What shards depend on, in one word."""
    made = {name: value for name, value in origin.items() if name != "command"}
    parts = {
        "frames": frames.stamp(),
        "estimator": chosen.name,
        "settings": chosen.identity,
        "made": made,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def _formats(config: dict[str, Any], frames: Frames) -> list[str]:
    """Those that are asked for; without any all that are there, but for those that need a rate that
    is not known.
    """
    if frames.rate_hz:
        return config["formats"] or list(_ALL)
    for name in config["formats"] or ():
        check(
            name not in _TIMED,
            "rate_hz",
            f"is unknown, and {name} needs it",
            "Give rate_hz=60, say.",
        )
    if config["formats"] is None:
        _log.warning(
            "The files do not tell the frame rate: no %s. Give rate_hz=60, say.",
            " and ".join(_TIMED),
        )
    return config["formats"] or [name for name in _ALL if name not in _TIMED]


def _tell_origin(about: About, formats: list[str]) -> None:
    """Say which files are not in the world's own millimetres, and from where they count."""
    files = [WRITERS[name].file for name in formats if WRITERS[name].single]
    if files and any(about.origin):
        text = "The rig is far from its world's zero: in %s, which have single precision, %s."
        _log.warning(text, ", ".join(files), origin_note(about))


def _check(config: dict[str, Any]) -> None:
    for name in ("evaluated_frames", "fitted_frames", "shard_frames", "batch"):
        check(config[name] >= 1, name, f"is {config[name]}", "Give 1 or more.")
    for key, names, existing in (
        ("triangulation", [] if config["ckpt"] else [config["triangulation"]], config["baselines"]),
        ("compare", config["compare"], config["baselines"]),
        ("formats", config["formats"] or [], WRITERS),
    ):
        for name in names:
            check(name in existing, key, f"there is no {name!r}", suggest(name, existing))


COMMAND = Command(name="predict", settings=dict, task=predict, summary=summary, files=files)


if __name__ == "__main__":
    run_by_name("predict")
