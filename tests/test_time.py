"""When the cameras' frames were taken: what people who move tell of it, and what is done."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from composed import cameras_settings
from ghpt.calibration.time.estimation import TimeEstimation
from ghpt.calibration.time.timeline import timeline_of
from ghpt.calibration.time.uncalibrated import UncalibratedShifts
from ghpt.clock import Clock
from ghpt.commands.cameras import check_cameras
from ghpt.config import build
from ghpt.data.formats.camera_files import read_cameras
from ghpt.data.formats.camera_writers import write_pose2sim
from ghpt.data.formats.key_points import write_key_points
from ghpt.data.people.detections import Detections
from ghpt.data.people.retimed import retime, shift_detections
from ghpt.data.people.sequence import KeyPointArrays, Sequence
from ghpt.data.points import KeyPoints
from ghpt.data.synthetic.body import random_body
from ghpt.data.synthetic.motion import synthesize_motion
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.geometry.cameras import Cameras, CameraSet, project
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.skeleton import JOINTS

STARTS = (0, 150, 615, 330)
"""Ticks of 5 ms, four of which are a frame: 0, 37.5, 153.75 and 82.5 frames."""
FRAMES = 300


@pytest.fixture(scope="module")
def rig() -> CameraSet:
    return human36m_rig("S9").without_distortion()


@pytest.fixture(scope="module")
def walk(rig) -> np.ndarray:
    """Pixels [T V J 2] of a walking person at 200 Hz, with noise."""
    rng = np.random.default_rng(3)
    truth = synthesize_motion(random_body(rng), "Walking", 2400, 200.0, rng, False)
    pixels, _ = project(rig.cameras, torch.from_numpy(truth).double())
    noise = rng.normal(scale=1.5, size=pixels.shape)
    return pixels.transpose(0, 1).numpy().transpose(1, 0, 2, 3) + noise


def estimation() -> TimeEstimation:
    return build(cameras_settings().camera_check["time"], "time")


def taken(walk: np.ndarray, starts: tuple[int, ...], frames: int = FRAMES) -> np.ndarray:
    """Return what cameras of 50 Hz record that start at these ticks."""
    views = [walk[start : start + 4 * frames : 4, v] for v, start in enumerate(starts)]
    return np.stack(views, axis=1)


def estimate(rig: CameraSet, pixels: np.ndarray, valid: np.ndarray | None = None):
    shown = np.ones(pixels.shape[:3], bool) if valid is None else valid
    frame = np.arange(len(pixels))
    return estimation()(timeline_of(rig.K, pixels, shown, frame, 1500), rig.cameras)


def expected(starts: tuple[int, ...]) -> np.ndarray:
    return (starts[0] - np.array(starts)) / 4


def test_starts_seconds_apart_are_found_to_a_part_of_a_frame(rig, walk):
    found = estimate(rig, taken(walk, STARTS))
    assert found.determined == (True,) * 4
    assert np.abs(np.array(found.clock.shift) - expected(STARTS)).max() < 0.2


def test_a_camera_that_is_off_does_not_move_the_shifts(rig, walk):
    R = rig.cameras.R.clone()
    R[2] = vector_to_matrix(torch.tensor([0.03, -0.02, 0.01], dtype=torch.float64)) @ R[2]
    off = rig.with_cameras(Cameras(rig.K, R, rig.cameras.t))
    found = estimate(off, taken(walk, STARTS))
    assert np.abs(np.array(found.clock.shift) - expected(STARTS)).max() < 0.5


def test_synchronised_views_are_not_shifted(rig, walk):
    found = estimate(rig, taken(walk, (0, 0, 0, 0)))
    assert found.determined == (True,) * 4
    assert found.is_synchronised


def test_half_the_frame_rate_is_found(rig, walk):
    pixels = taken(walk, STARTS)
    valid = np.ones(pixels.shape[:3], bool)
    half = FRAMES // 2
    pixels[:half, 3] = pixels[::2, 3]
    valid[half:, 3] = False
    found = estimate(rig, pixels, valid)
    assert found.clock.rate == (1, 1, 1, 0.5)
    shift = expected(STARTS) * np.array(found.clock.rate)
    assert np.abs(np.array(found.clock.shift) - shift).max() < 0.3


def test_of_a_person_who_stands_still_nothing_is_told(rig, walk):
    rng = np.random.default_rng(0)
    still = walk[:1].repeat(FRAMES, 0) + rng.normal(scale=1.5, size=(FRAMES, *walk.shape[1:]))
    found = estimate(rig, still)
    assert found.determined == (False,) * 4
    assert found.is_synchronised


def test_a_few_frames_tell_nothing(rig, walk):
    assert estimate(rig, taken(walk, STARTS, 20)).determined == (False,) * 4


def test_without_extrinsics_a_pair_is_found_to_a_frame(rig, walk):
    search = UncalibratedShifts(40, 80, 5, 0.012, 100, 0.4, 8, 0.06, 30)
    pixels = taken(walk, (0, 150, 0, 0), 200)
    shown = np.ones(pixels.shape[:3], bool)
    found = search.pair(timeline_of(rig.K, pixels, shown, np.arange(200), 1500), 0, 1, 0)
    assert abs(found.shift + 37.5) <= 1
    assert found.gap > 0.06


def sequence(pixels: np.ndarray, rig: CameraSet, valid: np.ndarray | None = None) -> Sequence:
    shown = np.ones(pixels.shape[:3], bool) if valid is None else valid
    points = KeyPoints(pixels, shown.astype(float), shown)
    frame = np.arange(10, 10 + len(pixels))
    return Sequence("walk", "synthetic", rig, frame, 50.0, KeyPointArrays(points, points))


def linear(rig: CameraSet, frames: int = 8) -> np.ndarray:
    """Pixels that are the number of the frame."""
    number = np.arange(10.0, 10 + frames)
    return np.broadcast_to(number[:, None, None, None], (frames, len(rig), 17, 2)).copy()


def test_retimed_views_are_interpolated_at_their_own_frames(rig):
    clock = Clock((1, 1, 1, 0.5), (0, 2.25, -1.5, 6))
    retimed = retime(sequence(linear(rig), rig), clock)
    points = retimed.undistorted()
    moment = retimed.frame[:, None] * np.array(clock.rate) + np.array(clock.shift)
    shown = points.valid.all(-1)
    np.testing.assert_allclose(points.pixels[shown][:, 0, 0], moment[shown], rtol=1e-6)
    assert (shown == ((moment >= 10) & (moment <= 17))).all()
    assert retimed.frame.tolist() == list(range(10, 18))


def test_a_gap_stays_one_on_both_of_its_sides(rig):
    valid = np.ones((8, 4, 17), bool)
    valid[3, 1] = False
    retimed = retime(sequence(linear(rig), rig, valid), Clock((1, 1, 1, 1), (0, 0.5, 0, 0)))
    gaps = np.flatnonzero(~retimed.undistorted().valid[:, 1].all(-1))
    assert gaps.tolist() == [2, 3, 7]


def test_views_that_are_never_there_together_are_refused(rig):
    with pytest.raises(GhptDataError, match="two views"):
        retime(sequence(linear(rig), rig), Clock((1, 1, 1, 1), (0, 100, 200, 300)))
    with pytest.raises(GhptDataError, match="2 views"):
        retime(sequence(linear(rig), rig), Clock((1, 1), (0, 1)))


def test_detections_are_shifted_by_whole_frames():
    points = KeyPoints(np.ones((3, 2, 17, 2)), np.ones((3, 2, 17)), np.ones((3, 2, 17), bool))
    people = Detections.of_person("x", ("a", "b"), JOINTS, np.arange(3), points)
    shifted = shift_detections(people, np.array([0, -2]))
    assert shifted.frame.tolist() == [0, 1, 2, 3, 4]
    assert shifted.frame[shifted.row].tolist() == [0, 1, 2, 2, 3, 4]


def test_a_clock_splits_into_whole_frames_and_the_rest():
    whole, rest = Clock((1, 1, 1), (0, 12.25, -3.5)).split()
    assert whole == (0, 12, -4)
    assert rest.shift == (0, 0.25, 0.5)


@pytest.fixture(scope="module")
def recorded(rig, walk, tmp_path_factory):
    """Files of cameras that were started by hand."""
    folder = tmp_path_factory.mktemp("time")
    pixels = taken(walk, STARTS)
    inside = np.ones(pixels.shape[:3], bool)
    points = KeyPoints(pixels, inside.astype(float), inside)
    write_key_points(folder / "points.npz", rig.names, JOINTS, np.arange(FRAMES), points, 50.0)
    write_pose2sim(folder / "Calib.toml", rig, {})
    return folder


def test_the_camera_check_says_and_mends_the_time_of_several_cameras(recorded, tmp_path):
    words = [f"keypoints={recorded}/points.npz", f"cameras={recorded}/Calib.toml"]
    with pytest.raises(GhptDataError, match="out_of_sync"):
        check_cameras(
            cameras_settings("camera_check.frames=24", "camera_check.shift=2", *words),
            tmp_path / "checked",
        )
    mended = tmp_path / "checked"
    words = [f"keypoints={mended}/keypoints.npz", f"cameras={mended}/cameras.toml"]
    found = check_cameras(
        cameras_settings("camera_check.frames=24", "camera_check.shift=2", *words),
        tmp_path / "again",
    )
    assert found.findings == ()
    assert max(camera.error_px for camera in found.cameras) < 4


def test_a_rig_file_keeps_the_time_of_its_cameras(rig, tmp_path):
    clock = Clock((1, 0.5, 1, 1), (0, 12.5, -3, 0))
    write_pose2sim(tmp_path / "rig.toml", replace(rig, clock=clock), {})
    read = read_cameras(tmp_path / "rig.toml")
    assert read.clock == clock
    assert read.select([2, 1]).clock == Clock((1, 0.5), (-3, 12.5))


@pytest.mark.parametrize("value", ["3", "{rate = 0.0}", "{shift = 'a'}"])
def test_a_time_that_is_none_is_refused(rig, tmp_path, value):
    file = tmp_path / "rig.toml"
    write_pose2sim(file, rig, {})
    file.write_text(file.read_text().replace("fisheye = false", f"time = {value}"))
    with pytest.raises(GhptDataError, match="time"):
        read_cameras(file)


def test_another_word_for_the_time_is_refused(recorded, tmp_path):
    words = [f"keypoints={recorded}/points.npz", f"cameras={recorded}/Calib.toml", "time=guess"]
    with pytest.raises(GhptConfigError, match="guess"):
        check_cameras(cameras_settings(*words), tmp_path)
