"""Several people: they are told apart, triangulated one by one, and compared with the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import lightning as L
import torch

from ghpt.data.people.persons import Chosen, tell_apart
from ghpt.data.synthetic.people import PeopleRecording
from ghpt.metrics.people import PeopleError, Tracking
from ghpt.models.estimators.classical import Estimator
from ghpt.models.estimators.predictors import remove_outliers
from ghpt.models.estimators.trajectory.estimator import Trajectory
from ghpt.observations import Observations, PoseEstimate, Truth

TRAJECTORY = "trajectory"
"""The estimator of `predict.py`, by its name in the tables."""
Estimate = Callable[[Observations], PoseEstimate]
RECALL_MM = 150.0
"""Mean joint distance within which a person is recalled."""
TRACKING_MM = 500.0
"""Mean joint distance within which an estimated person can be a true one, for MOTA and IDF1."""


@dataclass(frozen=True)
class PeopleScores:
    """One estimator's numbers of one or several recordings."""

    pcp: float
    """Percent, as all shares here."""
    pcp_without_head: float
    mpjpe: float
    """mm, of the recalled."""
    recall: float
    precision: float
    mota: float
    idf1: float
    switches: int

    def plain(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class SceneScores:
    """What was recorded in one scene, and each estimator's numbers."""

    name: str
    views: int
    frames: int
    people: int
    found: int
    """Persons that were told apart."""
    scores: dict[str, PeopleScores]


class _Scores:
    """The metrics of one estimator."""

    def __init__(self) -> None:
        self.error = PeopleError(RECALL_MM)
        self.tracking = Tracking(TRACKING_MM)

    def update(self, estimate: PoseEstimate, truth: Truth) -> None:
        self.error.update(estimate, truth)
        self.tracking.update(estimate, truth)

    def compute(self) -> PeopleScores:
        error = self.error.compute()
        tracking = self.tracking.compute()
        return PeopleScores(
            pcp=100 * float(error.pcp),
            pcp_without_head=100 * float(error.pcp_without_head),
            mpjpe=float(error.mpjpe),
            recall=100 * float(error.recall),
            precision=100 * float(error.precision),
            mota=100 * float(tracking.mota),
            idf1=100 * float(tracking.idf1),
            switches=int(tracking.switches),
        )


class PeopleTriangulation(L.LightningModule):
    """Tests classical estimators, and the trajectory, on whole recordings of several people.

    A person-frame counts where two views or more detected the person.
    """

    def __init__(
        self, estimators: Mapping[str, Estimator], trajectory: Trajectory | None = None
    ) -> None:
        super().__init__()
        self.estimators = dict(estimators)
        self.trajectory = trajectory
        names = [*estimators] if trajectory is None else [TRAJECTORY, *estimators]
        self.total = {name: _Scores() for name in names}
        self.scenes: list[SceneScores] = []

    def test_step(self, recording: PeopleRecording, index: int) -> None:
        views = len(recording.cameras)
        found = recording.detections
        persons = tell_apart(found, recording.cameras, range(views), found.points)
        visible = torch.from_numpy(recording.present & (recording.detected_views() >= 2))
        points = torch.from_numpy(recording.truth)
        truth = Truth(points, visible[..., None].expand(points.shape[:-1]))
        scores = {}
        estimators: dict[str, Estimate] = dict(self.estimators)
        if self.trajectory is not None:
            estimators[TRAJECTORY] = _through_time(self.trajectory, recording)
        for name in self.total:
            estimate = estimate_people(recording, persons, estimators[name])
            own = _Scores()
            for each in (own, self.total[name]):
                each.update(estimate, truth)
            scores[name] = own.compute()
        people = recording.present.shape[1]
        scene = SceneScores(recording.name, views, len(recording), people, len(persons), scores)
        self.scenes.append(scene)

    def scores(self) -> dict[str, PeopleScores]:
        """Return each estimator's numbers of all recordings together."""
        return {name: total.compute() for name, total in self.total.items()}


def _through_time(trajectory: Trajectory, recording: PeopleRecording) -> Estimate:
    """Return what estimates one person's poses in all frames together."""

    def estimate(batch: Observations) -> PoseEstimate:
        clean = remove_outliers(batch)[0]
        timed = trajectory.at_rate(clean, recording.detections.rate_hz)
        return timed.fit_to(clean)(clean)

    return estimate


def estimate_people(
    recording: PeopleRecording, persons: list[Chosen], estimator: Estimate
) -> PoseEstimate:
    """Return the poses [T E J] of the persons that were told apart."""
    frames = len(recording)
    points = []
    estimated = []
    for chosen in persons:
        own = recording.detections.points.take(chosen)
        batch = Observations(
            index=torch.arange(frames),
            recording=torch.zeros(frames, dtype=torch.int64),
            cameras=recording.cameras.cameras.expand(frames),
            key_points=torch.from_numpy(own.pixels),
            confidence=torch.from_numpy(own.confidence),
            valid=torch.from_numpy(own.valid),
        )
        estimate = estimator(batch)
        points.append(estimate.points)
        estimated.append(estimate.estimated)
    joints = recording.truth.shape[2]
    if not persons:
        empty = torch.zeros(frames, 0, joints, 3, dtype=torch.float64)
        return PoseEstimate(empty, torch.zeros(frames, 0, joints, dtype=torch.bool))
    return PoseEstimate(torch.stack(points, dim=1), torch.stack(estimated, dim=1))
