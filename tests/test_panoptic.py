"""Panoptic in its own layout: what was projected through the real lenses comes back, by name and by
number.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import real_layout as layout
from ghpt.data.datasets.panoptic import panoptic_files, panoptic_recordings
from ghpt.data.datasets.panoptic_joints import COCO19, joints17
from ghpt.data.datasets.store import write_store
from ghpt.data.formats.skeletons import joints_of
from ghpt.data.synthetic.rigs import panoptic_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINT, JOINTS

ALL = tuple(range(31))
NAME = "010101_pose7"
BODY_25 = joints_of("", "body_25")
FRAMES = list(range(100, 120))


@pytest.fixture
def poses() -> np.ndarray:
    return (
        layout.person(np.random.default_rng(0), len(FRAMES), (0, -1000, 0), joints=19).round(2) / 10
    )


@pytest.fixture
def root(tmp_path: Path, poses: np.ndarray) -> Path:
    """Detections of cameras 3, 6, 10 and 12; the calibration holds all 31 in another order."""
    calibration = layout.panoptic_calibration(panoptic_rig(ALL))
    calibration["cameras"] = [*calibration["cameras"][::-1], {"name": "01_01", "type": "vga"}]
    layout.write_panoptic_layout(
        tmp_path, NAME, calibration, panoptic_rig((3, 6, 10, 12)), FRAMES, poses, layout.perfect
    )
    return tmp_path


def read(root: Path, split: str, numbers: tuple[int, ...] = (10, 3)) -> LabelledRecording:
    (recording,) = panoptic_recordings(root, numbers, split)
    return recording


def expected(poses: np.ndarray) -> np.ndarray:
    return joints17(poses * 10, np.ones(poses.shape[:2], bool))[0]


@pytest.mark.parametrize(
    ("split", "part"),
    [("train", slice(0, 12)), ("validation", slice(12, 16)), ("test", slice(16, 20))],
)
def test_round_trip(root: Path, poses: np.ndarray, split: str, part: slice) -> None:
    recording, rig = read(root, split), panoptic_rig((10, 3))
    assert (recording.name, recording.action, recording.rate_hz) == (NAME, "pose", 29.97)
    assert recording.camera_names == ("00_10", "00_03")
    assert np.abs(recording.cameras.t.numpy() - rig.cameras.t.numpy()).max() < 1e-9
    assert recording.frame.tolist() == FRAMES[part]
    assert recording.valid.all()
    assert recording.truth_valid.all()
    assert (recording.confidence == 1).all()
    truth = expected(poses)[part]
    assert np.abs(recording.truth - truth).max() < 1e-3
    assert np.abs(recording.key_points - layout.ideal(rig, truth.astype(float))).max() < 0.02


def test_left_and_right_by_name() -> None:
    person, valid = joints17(layout.upright19()[None], np.ones((1, 19), bool))
    assert valid.all()
    for name, point in zip(JOINTS, person[0], strict=True):
        assert point[0] == {"l": 20, "r": -20}.get(
            name[0] if "_" in name and name != "head_top" else "", 0
        ), name
    height = dict(zip(JOINTS, -person[0, :, 1], strict=True))
    assert height["left_ankle"] == height["right_ankle"] == 10
    assert height["left_knee"] == 50
    assert height["right_wrist"] == height["pelvis"] == height["left_hip"] == 95
    assert height["right_elbow"] == 115
    assert height["left_shoulder"] == 138
    assert height["thorax"] == 140
    assert height["spine"] == (140 + 95) / 2
    assert height["nose"] == 155
    assert height["head_top"] == 159


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_left_and_right_in_real_images(shared_data: Path) -> None:
    """A person who faces a camera has the right shoulder on the image's left."""
    data = np.load(shared_data / "panoptic" / "171026_pose3_joints19.npz")
    points = expected(data["poses"][:50])
    rig = panoptic_rig(ALL)
    nose, ears = points[:, JOINT["nose"]], data["poses"][:50][:, [16, 18]].mean(1) * 10
    to_camera = unit(rig.cameras.centre.numpy() - nose[:, None])
    facing = np.einsum("tvc,tc->tv", to_camera, unit(nose - ears))
    pixels = layout.ideal(rig, points.astype(float))
    right_of_left = (
        pixels[:, :, JOINT["left_shoulder"], 0] - pixels[:, :, JOINT["right_shoulder"], 0]
    )
    assert (facing > 0.9).sum() > 20
    assert (right_of_left[facing > 0.9] > 0).all()


def test_reads_the_real_calibration_and_bodies(shared_data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "160906_band1"
    folder.mkdir()
    for item in (shared_data / "panoptic" / "160906_band1").iterdir():
        (folder / item.name).symlink_to(item)
    frames = sorted(int(f.stem[-8:]) for f in (folder / "hdPose3d_stage1_coco19").iterdir())
    (folder / "keypoints").mkdir()
    for view in ALL:
        count = (len(frames), 17)
        np.savez(
            folder / f"keypoints/00_{view:02d}.npz",
            frame=frames,
            key_points=np.full((*count, 2), 500.0),
            confidence=np.ones(count),
            seen=np.ones(count, bool),
        )
    recording, rig = read(tmp_path, "train", ALL), panoptic_rig(ALL)
    for name in ("K", "R", "t"):
        assert np.allclose(
            getattr(recording.cameras, name), getattr(rig.cameras, name), rtol=1e-9, atol=1e-9
        )
    assert recording.truth_valid.any(1).all()
    assert 0 < recording.truth_valid.mean() < 1
    neck_to_pelvis = np.linalg.norm(
        recording.truth[:, JOINT["thorax"]] - recording.truth[:, JOINT["pelvis"]], axis=-1
    )
    assert ((neck_to_pelvis > 350) & (neck_to_pelvis < 650)).all()  # mm of a real trunk


def test_missing_joints_and_what_is_made_of_them(tmp_path: Path, poses: np.ndarray) -> None:
    poses = poses[:5].copy()
    poses[1, COCO19.index("left_ear")] = np.nan
    poses[2, COCO19.index("neck")] = np.nan
    rig = panoptic_rig((3, 6))
    layout.write_panoptic_layout(
        tmp_path, NAME, layout.panoptic_calibration(rig), rig, range(5), poses, layout.perfect
    )
    truth_valid = read(tmp_path, "train", (3, 6)).truth_valid
    missing = [{JOINTS[j] for j in np.flatnonzero(~frame)} for frame in truth_valid]
    assert missing == [set(), {"head_top"}, {"thorax", "spine"}]


def rewrite(root: Path, camera: str, **changes: object) -> None:
    path = root / NAME / "keypoints" / f"{camera}.npz"
    np.savez(path, **{**np.load(path), **changes})


def test_detections_are_matched_by_frame_number(root: Path, poses: np.ndarray) -> None:
    """Another order, frames that the truth lacks, and gaps: no index shifts."""
    path = root / NAME / "keypoints" / "00_03.npz"
    order = np.array([15, 3, 0, 9])
    arrays = {name: array[order] for name, array in np.load(path).items()}
    arrays["frame"] = np.append(arrays["frame"], 7)
    for name in ("key_points", "confidence", "seen"):
        arrays[name] = np.concatenate([arrays[name], arrays[name][:1]])
    np.savez(path, **arrays)
    recording = read(root, "train", (3, 6))
    assert np.flatnonzero(recording.valid[:, 0].all(1)).tolist() == [0, 3, 9]
    assert not recording.valid[[1, 2, 4, 5, 6, 7, 8, 10, 11], 0].any()
    assert recording.valid[:, 1].all()
    ideal = layout.ideal(panoptic_rig((3, 6)), expected(poses).astype(float))
    assert np.abs(recording.key_points[[0, 3, 9], 0] - ideal[[0, 3, 9], 0]).max() < 0.02


def test_unseen_has_no_confidence_and_no_number(root: Path) -> None:
    valid = np.ones((20, 17), bool)
    valid[4, 5] = False
    points = np.load(root / NAME / "keypoints" / "00_03.npz")["key_points"]
    points[4, 5], points[6, 7] = np.nan, np.inf
    rewrite(root, "00_03", seen=valid, key_points=points)
    recording = read(root, "train", (3, 6))
    assert np.argwhere(~recording.valid).tolist() == [[4, 0, 5], [6, 0, 7]]
    assert not recording.confidence[~recording.valid].any()
    assert np.isfinite(recording.key_points).all()


def test_the_body_that_persists(root: Path) -> None:
    """An id that comes first but not often is not the person."""
    scenes = sorted((root / NAME / "hdPose3d_stage1_coco19").iterdir())
    for count, path in enumerate(scenes):
        scene = json.loads(path.read_text())
        scene["bodies"][0]["id"] = 4
        passer_by = {"id": 1, "joints19": [1.0] * 76}
        scene["bodies"] = (
            [passer_by, *scene["bodies"]] if count < 3 else scene["bodies"] if count != 7 else []
        )
        path.write_text(json.dumps(scene))
    recording = read(root, "train")
    assert not (recording.truth == 10).all(-1).any()
    assert np.flatnonzero(~recording.truth_valid.any(1)).tolist() == [7]


def test_the_authors_array_gives_the_same(root: Path, poses: np.ndarray) -> None:
    from_files = read(root, "test", (12, 6))
    folder = root / NAME
    (folder / "keypoints").rename(root / "unused")
    rig = panoptic_rig((6, 12, 3))
    truth = expected(poses).astype(float)
    shown = layout.through_lens(rig, layout.ideal(rig, truth))
    corner = np.floor(shown.min(2))
    size = np.ceil((shown.max(2) - corner).max(-1, keepdims=True))
    np.save(
        folder / "all_2d_preds.npy",
        ((shown - corner[:, :, None]) * (384 / size[:, :, None])).astype("f4"),
    )
    np.save(folder / "all_bboxes.npy", np.stack([corner, corner + size], axis=2))
    (folder / "all_cameras.json").write_text('["00_06", "00_12", "00_03"]')
    recording = read(root, "test", (12, 6))
    assert recording.camera_names == ("00_12", "00_06")
    assert np.abs(recording.key_points - from_files.key_points).max() < 0.01
    np.save(folder / "all_frames.npy", np.array(FRAMES)[::-1])
    backwards = read(root, "train", (12, 6))
    assert np.abs(backwards.key_points[:4] - from_files.key_points[::-1]).max() < 0.01
    np.save(folder / "all_2d_preds.npy", np.load(folder / "all_2d_preds.npy")[:9])
    (folder / "all_frames.npy").unlink()
    with pytest.raises(GhptDataError, match="has 9 frames, and there are 20 body3DScene files"):
        read(root, "test", (12, 6))


DIRECT = [name for name in JOINTS if name in BODY_25]
"""The joints that BODY_25 has too."""


def as_openpose(root: Path, views: dict[str, str]) -> None:
    """Write the npz files' key points as OpenPose does, with a passer-by, and remove the npz."""
    folder = root / NAME / "keypoints"
    for camera, view in views.items():
        arrays = np.load(folder / f"{camera}.npz")
        (folder / view).mkdir()
        for frame, points in zip(arrays["frame"], arrays["key_points"], strict=True):
            values = np.zeros((len(BODY_25), 3))
            for name in DIRECT:
                values[BODY_25.index(name)] = (*points[JOINT[name]], 0.5)
            other = values + (values[:, 2:] > 0) * (1500, 0, 0)
            people = [{"pose_keypoints_2d": each.ravel().tolist()} for each in (other, values)]
            path = folder / view / f"{view}_{frame:08d}_keypoints.json"
            path.write_text(json.dumps({"version": 1.3, "people": people}), encoding="utf-8")
    for file in folder.glob("*.npz"):
        file.unlink()


def test_a_detector_s_own_files_give_the_same(tmp_path: Path) -> None:
    root, rig = tmp_path, panoptic_rig((3, 6, 10))
    calibration = layout.panoptic_calibration(panoptic_rig(ALL))
    person = layout.upright19() + np.random.default_rng(0).normal(0, 1, (len(FRAMES), 19, 3))
    layout.write_panoptic_layout(root, NAME, calibration, rig, FRAMES, person, layout.perfect)
    from_npz = read(root, "train")
    as_openpose(root, {"00_03": "hd_00_03", "00_06": "hd_00_06", "00_10": "hd_00_10"})
    recording = read(root, "train")
    joints = [JOINT[name] for name in DIRECT]
    assert recording.camera_names == ("00_10", "00_03")
    assert recording.valid[..., joints].all()
    assert np.abs(recording.key_points - from_npz.key_points)[..., joints, :].max() < 0.01
    assert (recording.confidence[..., joints] == 0.5).all()
    assert len(panoptic_files(root, (10, 3))) == 1 + 20 + 3 * 20
    with pytest.raises(GhptDataError, match="there is no view 00_12 with a camera"):
        read(root, "train", (10, 12))


def test_files_are_those_read(root: Path) -> None:
    files = panoptic_files(root, (3, 12))
    assert len(files) == len(set(files)) == 1 + 20 + 2
    assert all(file.is_file() for file in files)


def calibration(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / NAME / f"calibration_{NAME}.json"
        content = json.loads(path.read_text())
        change(next(camera for camera in content["cameras"] if camera["name"] == "00_03"))
        path.write_text(json.dumps(content))

    return spoil


def scene(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / NAME / "hdPose3d_stage1_coco19" / "body3DScene_00000104.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return spoil


def detections(**changes: object) -> Callable[[Path], None]:
    return lambda root: rewrite(root, "00_03", **changes)


def cut(pattern: str, share: float) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = next((root / NAME).glob(pattern))
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])

    return spoil


BAD = {
    "no sequence": (
        lambda root: (root / NAME).rename(root / "other"),
        "calibration_<seq>.json below",
    ),
    "no scenes": (
        lambda root: (root / NAME / "hdPose3d_stage1_coco19").rename(root / "gone"),
        "no body3DScene",
    ),
    "no detections": (
        lambda root: (root / NAME / "keypoints").rename(root / "gone"),
        "neither keypoints/ nor",
    ),
    "no camera file": (
        lambda root: (root / NAME / "keypoints/00_03.npz").unlink(),
        "00_03.npz: there is no such file",
    ),
    "camera not calibrated": (
        calibration(lambda c: c.update(type="vga")),
        "there is no camera 00_03",
    ),
    "camera twice": (calibration(lambda c: c.update(name="00_04")), "camera 00_04 is listed twice"),
    "K missing": (calibration(lambda c: c.pop("K")), "00_03, K: is missing"),
    "NaN in K": (
        calibration(lambda c: c.update(K=[[float("nan")] * 3] * 3)),
        "NaN is no JSON number",
    ),
    "infinite t": (calibration(lambda c: c.update(t=[[1e999]] * 3)), "not valid JSON|not finite"),
    "R not a rotation": (
        calibration(lambda c: c.update(R=[[1, 0, 0], [0, 2, 0], [0, 0, 1]])),
        "camera 00_03, R: R is not",
    ),
    "R as vector": (
        calibration(lambda c: c.update(R=[0.1, 0.2, 0.3])),
        "00_03, R: has shape 3 instead of 3 x 3",
    ),
    "R ragged": (
        calibration(lambda c: c.update(R=[[1, 2], [3]])),
        "00_03, R: is not an array of numbers",
    ),
    "R as text": (calibration(lambda c: c.update(R=[["1"] * 3] * 3)), "00_03, R: holds <U1"),
    "t flat": (
        calibration(lambda c: c.update(t=[1, 2, 3])),
        "00_03, t: has shape 3 instead of 3 x 1",
    ),
    "huge integer": (calibration(lambda c: c.update(t=[[10**400]] * 3)), "00_03, t"),
    "calibration cut": (cut("calibration_*", 0.7), "is not valid JSON"),
    "scene cut": (cut("*/*104.json", 0.7), "body3DScene_00000104.json: is not valid JSON"),
    "npz cut": (cut("keypoints/00_03.npz", 0.7), "00_03.npz: is not a whole npz"),
    "no bodies": (scene(lambda s: s.pop("bodies")), "00000104.json: bodies"),
    "18 joints": (
        scene(lambda s: s["bodies"][0].update(joints19=[0.0] * 72)),
        "joints19: has shape 72 instead of 76",
    ),
    "body twice": (scene(lambda s: s["bodies"].append(s["bodies"][0])), "id: is 0.*twice"),
    "id as text": (scene(lambda s: s["bodies"][0].update(id="0")), "id: is '0'"),
    "1e30 cm": (scene(lambda s: s["bodies"][0].update(joints19=[1e30] * 76)), "beyond 10 km"),
    "19 joints in 2D": (
        detections(key_points=np.ones((20, 19, 2))),
        "key_points: has shape 20 x 19 x 2",
    ),
    "fewer frames": (
        detections(frame=np.arange(19)),
        "key_points: has shape 20 x 17 x 2 instead of 19",
    ),
    "frame twice": (
        detections(frame=np.array([*FRAMES[:-1], 100])),
        "frame: holds a frame number twice",
    ),
    "other frames": (detections(frame=np.arange(20)), "holds none of the frames 100 to 119"),
    "frame as float": (detections(frame=np.arange(20.0)), "frame: holds float64, not integers"),
    "confidence 90": (
        detections(confidence=np.full((20, 17), 90.0)),
        "confidence: is not between 0 and 1",
    ),
    "confidence NaN": (
        detections(confidence=np.full((20, 17), np.nan)),
        "confidence: is not between 0 and 1",
    ),
    "seen as number": (detections(seen=np.ones((20, 17))), "seen: holds float64, not booleans"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_named(root: Path, case: str) -> None:
    spoil, message = BAD[case]
    spoil(root)
    with pytest.raises(GhptDataError, match=message):
        read(root, "train", (3, 6))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((3, 31), "no camera (00_)?31"),
        ((3, 3), "listed twice"),
        ((3,), "at least two"),
        ((), "at least two"),
    ],
)
def test_bad_cameras_are_named(root: Path, numbers: tuple[int, ...], message: str) -> None:
    with pytest.raises(GhptDataError, match=message):
        read(root, "train", numbers)
    with pytest.raises(GhptDataError, match=message):
        panoptic_files(root, numbers)


def test_empty_split_is_named(tmp_path: Path, poses: np.ndarray) -> None:
    rig = panoptic_rig((3, 6))
    layout.write_panoptic_layout(
        tmp_path, NAME, layout.panoptic_calibration(rig), rig, [0], poses[:1], layout.perfect
    )
    with pytest.raises(GhptDataError, match="here: train: there are no frames"):
        recordings = panoptic_recordings(tmp_path, (3, 6), "train")
        write_store(tmp_path / "store", recordings, {"source": "here", "split": "train"})
    assert len(read(tmp_path, "test", (3, 6))) == 1


def test_bad_split(root: Path) -> None:
    with pytest.raises(GhptConfigError, match="Existing: train, validation, test"):
        read(root, "val")
