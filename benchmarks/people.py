"""Frames a second for several people: telling them apart, and triangulating each.

    python benchmarks/people.py people=2,4,8 views=3,5,10,31 joints=17,133 frames=60 threads=1

People walk before HD cameras of Panoptic Studio, as in `test.py data=people`; of more joints than
17 all are triangulated, and the 17 tell people apart. Association is wanted at 200 frames/s for 4
people, 5 views and 17 joints on one core, with triangulation, and at 50 with 133.
"""

import time

import numpy as np
import torch
from measure import configuration, machine, settings, show

from ghpt.config import build
from ghpt.data.people.association import associate
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.people import PeopleRecording, Scene, Stay, record_people
from ghpt.models.estimators.classical import Estimator
from ghpt.observations import Observations

CAMERAS = (3, 8, 12, 18, 23, 0, 5, 10, 15, 20, 26, 1, 2, 4, 6, 7, 9, 11, 13, 14, 16, 17, 19, 21)
CAMERAS += (22, 24, 25, 27, 28, 29, 30)


def recording(people: int, views: int, frames: int) -> PeopleRecording:
    """Walkers around the middle, in the first cameras of the list."""
    angles = 2 * np.pi * np.arange(people) / people
    places = 700 * np.stack([np.cos(angles), np.sin(angles)], -1)
    stays = [Stay("Walking", place.tolist()) for place in places]
    detector = build(configuration("test", "data=people")["data"], "data").detector
    return record_people("benchmark", Scene(CAMERAS[:views], stays, frames, 30.0), detector, 0)


def widen(points: KeyPoints, joints: int) -> KeyPoints:
    """The key points again and again, up to so many joints."""
    at = np.arange(joints) % points.valid.shape[-1]
    return KeyPoints(points.pixels[..., at, :], points.confidence[..., at], points.valid[..., at])


def observe(found: PeopleRecording, points: KeyPoints, chosen: np.ndarray) -> Observations:
    own = points.take(chosen)
    frames = len(found)
    return Observations(
        index=torch.arange(frames),
        recording=torch.zeros(frames, dtype=torch.int64),
        cameras=found.cameras.cameras.expand(frames),
        key_points=torch.from_numpy(own.pixels),
        confidence=torch.from_numpy(own.confidence),
        valid=torch.from_numpy(own.valid),
    )


def measure(found: PeopleRecording, joints: int, estimator: Estimator) -> tuple[float, float, int]:
    """Seconds of association and of triangulation, and the number of persons."""
    detections = found.detections
    start = time.process_time()
    persons = associate(
        found.cameras.cameras, len(found), detections.row, detections.view, detections.points
    )
    between = time.process_time()
    points = widen(detections.points, joints)
    for chosen in persons:
        estimator(observe(found, points, chosen))
    return between - start, time.process_time() - between, len(persons)


def main() -> None:
    wanted = settings(people="2,4,8", views="3,5,10,31", joints="17,133", frames=60, threads=1)
    torch.set_num_threads(wanted["threads"])
    print(machine())
    baselines = configuration("test", "data=people")["baselines"]
    estimator = build(baselines["adaptive_ransac"], "baselines.adaptive_ransac")
    rows = []
    for people in map(int, wanted["people"].split(",")):
        for views in map(int, wanted["views"].split(",")):
            found = recording(people, views, wanted["frames"])
            measure(found, 17, estimator)
            for joints in map(int, wanted["joints"].split(",")):
                apart, placed, persons = measure(found, joints, estimator)
                rates = [len(found) / seconds for seconds in (apart, placed, apart + placed)]
                counts = (people, persons, views, joints)
                rows.append([*map(str, counts), *(f"{rate:.0f}" for rate in rates)])
    columns = ["people", "found", "views", "joints", "association", "triangulation", "both"]
    show("frames/s of processor time", columns, rows)


if __name__ == "__main__":
    main()
