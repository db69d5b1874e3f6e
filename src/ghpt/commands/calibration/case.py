"""What is calibrated, and what it can be compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ghpt.calibration.findings import Finding
from ghpt.calibration.intrinsics import IntrinsicsEstimation
from ghpt.calibration.mistakes import SEVERAL_PEOPLE
from ghpt.calibration.rig import RigCalibration
from ghpt.calibration.uncertainty import LensErrors
from ghpt.calibration.whose import same_people
from ghpt.commands.calibration.settings import CalibrateSettings
from ghpt.commands.inputs import (
    own_cameras,
    own_people,
    own_title,
    recording_sequence,
    resolve_unit,
)
from ghpt.config import build
from ghpt.data.formats.names import Name
from ghpt.data.people.detections import Detections
from ghpt.data.people.matching import match_views
from ghpt.data.people.persons import detector_sequence, detector_sequences, tracks_of_views
from ghpt.data.people.sequence import Rows, Sequence
from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Recording


@dataclass(frozen=True)
class Crowd:
    """Detections of several people, who are told apart once a rig is known."""

    people: Detections
    match: dict[Name, Name] | None
    views: list[Name] | None

    def follow(self, cameras: CameraSet, calibration: RigCalibration, seed: int) -> list[Sequence]:
        """Return people who are the same in all views, the surest first; cameras need no
        extrinsics.
        """
        tracks = self.tracks(cameras)
        return same_people(tracks, calibration.pairs, calibration.noise, seed)

    def among(self, cameras: CameraSet, placed: list[int]) -> list[Sequence]:
        """Return everybody whom some calibrated cameras tell apart, the most visible first."""
        at, _ = match_views(self.people.path, self.people.views, cameras, self.match, self.views)
        views = [self.people.views[at[view]] for view in placed]
        return detector_sequences(self.people, cameras.select(placed), self.match, views)

    def tracks(self, cameras: CameraSet) -> list[Sequence]:
        """Return those whom each view follows by itself."""
        return tracks_of_views(self.people, cameras, self.match, self.views)

    def persons(self, cameras: CameraSet) -> list[Sequence]:
        """Return everybody whom calibrated cameras tell apart, the most visible first."""
        return detector_sequences(self.people, cameras, self.match, self.views)


@dataclass(frozen=True)
class Case:
    """What is calibrated, and what it can be compared with."""

    sequence: Sequence
    """The 17 joints."""
    evidence: Sequence
    """All key points of the detector, which the rig is calibrated from."""
    reference: str
    """What the extrinsics of the sequence's cameras, where there are any, are, in words.

    They are never used but for the comparison and the world.
    """
    is_own: bool
    """Whether they are the user's, which may be wrong."""
    notes: tuple[Finding, ...] = ()
    crowd: Crowd | None = None
    """Everybody's detections, where the views show several people."""
    more: tuple[Crowd, ...] = ()
    """What other detectors found of the same recording."""
    intrinsics: str | None = None
    """What was estimated of the intrinsics, in words; None where they were given."""
    lenses: LensErrors | None = None
    """What is not known of them."""

    @property
    def reference_cameras(self) -> Cameras | None:
        """The calibrated cameras to compare with, if there are any."""
        cameras = self.sequence.cameras
        return cameras.cameras if cameras.calibrated else None

    def recording(self, views: list[int], cameras: Cameras) -> Recording:
        """Return the recording as a calibration of some of its cameras sees it."""
        sequence = self.sequence.select_views(views)
        points = sequence.undistorted()
        return Recording(
            name=sequence.title,
            subject=sequence.title,
            action="unknown",
            rate_hz=sequence.rate_hz or float("nan"),
            camera_names=sequence.cameras.names,
            cameras=cameras.index(views),
            key_points=points.pixels,
            confidence=points.confidence,
            valid=points.valid,
            frame=sequence.frame,
        )


def open_case(settings: CalibrateSettings, estimator: Estimator) -> Case:
    """Return the user's own key points and cameras, or without any a recording of the data set,
    whose true extrinsics serve the comparison alone.

    Extrinsics are in mm where the person tells their unit.
    """
    if not settings.keypoints:
        recording = recording_sequence(settings)
        return Case(recording, recording, "the truth", is_own=False)
    people = own_people(settings)
    cameras = _given_cameras(settings, people)
    people.skeleton.require_joints(people.path)
    wanted = (settings.match, settings.views, None, own_title(settings))
    evidence = detector_sequence(people, cameras, *wanted)
    evidence = replace(evidence, source=str(Path(str(settings.keypoints)).resolve()))
    sequence = resolve_unit(evidence.as_joints(), estimator, ask=False)
    notes = people_findings(people)
    own = "the file's own calibration"
    crowd = Crowd(people, settings.match, settings.views) if notes else None
    more = tuple(_other_detector(settings, path) for path in settings.more_keypoints or [])
    return Case(sequence, evidence, own, is_own=True, notes=notes, crowd=crowd, more=more)


def _other_detector(settings: CalibrateSettings, path: str) -> Crowd:
    """Return what another detector found of the same recording."""
    own = replace(settings, keypoints=path, format=None, skeleton=None, session=None)
    return Crowd(own_people(own), settings.match, settings.views)


def of_one_person(case: Case, calibration: RigCalibration, seed: int) -> Case:
    """Return the case with a person whom all views follow, where there are several."""
    if case.crowd is None:
        return case
    given = case.evidence
    surest = case.crowd.follow(given.cameras, calibration, seed)[0]
    evidence = replace(given, points=surest.points)
    joints = evidence.as_joints()
    return replace(case, evidence=evidence, sequence=replace(case.sequence, points=joints.points))


def _given_cameras(settings: CalibrateSettings, people: Detections) -> CameraSet:
    """Return the user's cameras, or without a file first guesses by the size of the images."""
    if settings.image_size is None:
        cameras = own_cameras(settings, "intrinsics.toml, or image_size=[1920,1080]")
        return cameras.without_extrinsics() if cameras.unposed else cameras
    estimation: IntrinsicsEstimation = build(settings.intrinsics, "intrinsics")
    return estimation.guess_cameras(people.views, torch.tensor(settings.image_size))


def people_findings(people: Detections) -> tuple[Finding, ...]:
    """Return a warning where one of several people was followed."""
    crowded = people.crowded_frames()
    if not crowded:
        return ()
    frames = ", ".join(f"{count} frames of {view}" for view, count in crowded.items())
    most = max(crowded.values())
    return (SEVERAL_PEOPLE.finding(tuple(crowded), float(most), frames_of_views=frames),)


def spread_recording(recording: Recording, frames: int) -> Recording:
    """Return at most so many frames of a recording, evenly spread."""
    return recording.frames(spread_rows(np.arange(len(recording)), frames))


def spread_rows(rows: Rows, count: int) -> Rows:
    """Return at most so many of some rows, evenly spread."""
    if not len(rows):
        return rows
    at = np.linspace(0, len(rows) - 1, min(max(count, 1), len(rows)))
    return rows[np.unique(at.astype(int))]
