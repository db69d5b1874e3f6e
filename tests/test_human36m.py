"""Human3.6M in the authors' layout: what was projected through the real lenses comes back."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import real_layout as layout
from ghpt.data.datasets.detections import uncrop, undistort_key_points
from ghpt.data.datasets.human36m import DAMAGED, human36m_files, human36m_recordings
from ghpt.data.datasets.labels import LABELS_FILE
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.observations import LabelledRecording
from ghpt.skeleton import JOINTS

LENGTHS = {
    "S1": {"Greeting-1": 11, "Walking-2": 6},
    "S5": {"Posing-1": 4},
    "S6": {"Posing-1": 4},
    "S7": {"Posing-1": 4},
    "S8": {"Eating-2": 5},
    "S9": {"Greeting-1": 3, "Greeting-2": 4, "SittingDown-2": 3, "Waiting-1": 2, "Waiting-2": 9},
    "S11": {"Greeting-2": 4},
}


@pytest.fixture
def takes() -> list[tuple[str, str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return [
        (subject, action, layout.person(rng, frames, (0, 0, 1000)).astype(np.float32).astype(float))
        for subject, actions in LENGTHS.items()
        for action, frames in actions.items()
    ]


@pytest.fixture
def root(tmp_path: Path, takes: list) -> Path:
    layout.write_human36m_layout(tmp_path / "h36m", takes, chunk=5)
    return tmp_path / "h36m"


def read(
    root: Path, split: str, numbers: tuple[int, ...] = (0, 1, 2, 3), damaged: bool = True
) -> list[LabelledRecording]:
    return list(human36m_recordings(root, split, numbers, damaged))


@pytest.mark.parametrize(
    ("split", "subjects"),
    [("train", ["S1", "S5", "S6", "S7"]), ("validation", ["S8"]), ("test", ["S9", "S11"])],
)
def test_round_trip_through_crop_chunks_and_lens(
    root: Path, takes: list, split: str, subjects: list[str]
) -> None:
    expected = {f"{s}/{a}": (s, a, poses) for s, a, poses in takes if s in subjects}
    recordings = read(root, split)
    assert {r.name for r in recordings} == set(expected)
    for recording in recordings:
        subject, action, poses = expected[recording.name]
        rig = human36m_rig(subject)
        assert (recording.subject, recording.action, recording.rate_hz) == (
            subject,
            action[:-2],
            50,
        )
        assert recording.camera_names == rig.names
        assert np.abs(recording.cameras.centre.numpy() - rig.cameras.centre.numpy()).max() < 0.01
        assert recording.valid.all()
        assert recording.truth_valid.all()
        assert (recording.confidence == 1).all()
        assert np.array_equal(recording.truth, poses.astype(np.float32))
        assert recording.frame.tolist() == list(range(0, 5 * len(poses), 5))
        assert np.abs(recording.key_points - layout.ideal(rig, poses)).max() < 0.01


def test_views_are_the_chosen_ones_in_their_order(root: Path) -> None:
    (whole,), (part,) = read(root, "validation"), read(root, "validation", (3, 1))
    assert part.camera_names == (whole.camera_names[3], whole.camera_names[1])
    assert np.array_equal(part.key_points, whole.key_points[:, [3, 1]])
    assert np.array_equal(part.cameras.t, whole.cameras.t[[3, 1]])


def test_damaged_takes_are_kept_or_left_out(root: Path) -> None:
    kept, left = (
        {r.name for r in read(root, "test", damaged=damaged)} for damaged in (True, False)
    )
    assert kept - left == DAMAGED
    assert "S11/Greeting-2" in left


def test_a_zero_box_a_zero_height_and_nan_are_not_seen(root: Path) -> None:
    boxes = np.load(root / "S8" / "all_bboxes0.npy")
    boxes[1, 2] = 0
    boxes[3, 0, 1] = boxes[3, 0, 0]
    np.save(root / "S8" / "all_bboxes0.npy", boxes)
    crop = np.load(root / "S8" / "all_2d_preds0.npy")
    crop[0, 1, 4, 0], crop[0, 1, 5, 1] = np.nan, np.inf
    np.save(root / "S8" / "all_2d_preds0.npy", crop)
    (recording,) = read(root, "validation")
    expected = np.ones_like(recording.valid)
    expected[1, 2] = expected[3, 0] = expected[0, 1, 4] = expected[0, 1, 5] = False
    assert np.array_equal(recording.valid, expected)
    assert np.isfinite(recording.key_points).all()


def test_missing_truth_is_masked(root: Path) -> None:
    truth = np.load(root / "S8" / "all_3d_gt0.npy")
    truth[2, 7] = np.nan
    np.save(root / "S8" / "all_3d_gt0.npy", truth)
    (recording,) = read(root, "validation")
    assert np.argwhere(~recording.truth_valid).tolist() == [[2, 7]]
    assert np.isfinite(recording.truth).all()


def test_chunks_that_are_not_the_labels_frames(root: Path, takes: list) -> None:
    np.save(root / "S9" / "all_3d_gt1.npy", np.load(root / "S9" / "all_3d_gt1.npy")[::-1] + 5)
    with pytest.raises(GhptDataError, match=r"S9.*damaged takes cannot be left out"):
        read(root, "test", damaged=False)
    with pytest.warns(UserWarning, match="S9.*unknown action"):
        recordings = read(root, "test")
    assert [(r.name, r.action, len(r)) for r in recordings] == [
        ("S9/unknown", "unknown", 21),
        ("S11/Greeting-2", "Greeting", 4),
    ]
    poses = np.concatenate([p for s, _, p in takes if s == "S9"])
    assert np.abs(recordings[0].key_points - layout.ideal(human36m_rig("S9"), poses)).max() < 0.01


def test_labels_may_lie_in_extra_and_files_are_those_read(root: Path) -> None:
    (root / "extra").mkdir()
    (root / LABELS_FILE).rename(root / "extra" / LABELS_FILE)
    assert len(read(root, "validation")) == 1
    files = human36m_files(root, "train")
    assert len(files) == len(set(files)) == 1 + 3 * (4 + 1 + 1 + 1)
    assert files[0] == root / "extra" / LABELS_FILE


def test_sides_come_from_the_order_of_joints(root: Path, takes: list) -> None:
    """Index 0 is the right ankle: nothing is renamed or mirrored on the way in."""
    (recording,) = read(root, "validation")
    poses = next(p for s, _, p in takes if s == "S8")
    assert JOINTS[0] == "right_ankle"
    assert np.array_equal(recording.truth[:, 0], poses[:, 0].astype(np.float32))


def test_scale_is_the_boxes_height_and_the_corner_is_x_y() -> None:
    box = np.array([[[[100.0, 200.0], [999.0, 392.0]]]])  # 192 high: half of the crop's 384
    pixels, there = uncrop(np.array([[[[10.0, 20.0]]]]), box)
    assert pixels.tolist() == [[[[105.0, 210.0]]]]
    assert there.all()


def test_a_point_beyond_the_lens_is_not_seen() -> None:
    rig = human36m_rig("S1")
    K, distortion = rig.cameras.K[0].numpy(), rig.distortion[0].numpy()
    pixels, valid = undistort_key_points(
        np.full((1, 2, 2), [[600.0, 600.0], [1e7, 0]]), np.ones((1, 2), bool), K, distortion
    )
    assert valid.tolist() == [[True, False]]
    assert pixels[0, 1].tolist() == [0, 0]


def test_no_frame_is_joined_to_the_wrong_row(root: Path) -> None:
    """A chunk's file in another order of n (10 before 2) would shift all that follows."""
    for name in ("2d_preds", "bboxes", "3d_gt"):
        whole = np.concatenate([np.load(root / "S8" / f"all_{name}0.npy")] * 3)[:12]
        for n in range(12):
            np.save(root / "S8" / f"all_{name}{n}.npy", whole[n : n + 1])
    with pytest.warns(UserWarning, match="unknown"):
        (recording,) = read(root, "validation")
    assert np.array_equal(recording.truth[:5], recording.truth[5:10])
    assert np.array_equal(recording.key_points[:5], recording.key_points[5:10])


def save(name: str, array: np.ndarray) -> Callable[[Path], object]:
    return lambda root: np.save(root / "S8" / name, array)


def cut(root: Path) -> None:
    file = root / "S8" / "all_2d_preds0.npy"
    file.write_bytes(file.read_bytes()[:-9])


def renumber(root: Path) -> None:
    for file in list((root / "S8").iterdir()):
        file.rename(file.with_name(file.name.replace("0.npy", "1.npy")))


BAD = {
    "no labels": (lambda root: (root / LABELS_FILE).unlink(), LABELS_FILE),
    "no subject": (
        lambda root: (root / "S8").rename(root / "S2"),
        "S8/all_2d_preds0.npy: there is no such file",
    ),
    "gap in the chunks": (renumber, "all_2d_preds0.npy: there is no such file"),
    "no boxes": (
        lambda root: (root / "S8/all_bboxes0.npy").unlink(),
        "all_bboxes0.npy: there is no such file",
    ),
    "truncated": (cut, "all_2d_preds0.npy: claims"),
    "3 views": (
        save("all_2d_preds0.npy", np.ones((5, 3, 17, 2), "f4")),
        "all_2d_preds0.npy: has shape 5 x 3 x 17 x 2",
    ),
    "fewer boxes": (
        save("all_bboxes0.npy", np.ones((4, 4, 2, 2))),
        "all_bboxes0.npy: has shape 4 x 4 x 2 x 2 instead of 5",
    ),
    "32 joints": (
        save("all_3d_gt0.npy", np.ones((5, 32, 3))),
        "all_3d_gt0.npy: has shape 5 x 32 x 3",
    ),
    "text": (
        save("all_3d_gt0.npy", np.full((5, 17, 3), "a")),
        "all_3d_gt0.npy: holds <U1, not floating-point",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_named(root: Path, case: str) -> None:
    spoil, message = BAD[case]
    spoil(root)
    with pytest.raises(GhptDataError, match=message):
        read(root, "validation")


def test_bad_cameras_and_arguments(root: Path, takes: list) -> None:
    for numbers, message in (
        ((0, 4), "there is no camera 4"),
        ((1, 1), "listed twice"),
        ((2,), "at least two"),
    ):
        with pytest.raises(GhptDataError, match=message):
            read(root, "validation", numbers)
    with pytest.raises(GhptConfigError, match="Existing: train, validation, test"):
        read(root, "tset")
    labels = layout.human36m_labels(takes)
    labels["cameras"]["R"][4, 2] *= 2
    layout.write_pickle(root / LABELS_FILE, labels)
    with pytest.raises(GhptDataError, match=r"\(S8\): camera 58860488, R: R is not a rotation"):
        read(root, "validation")
    labels["subject_names"][4] = "S3"
    layout.write_pickle(root / LABELS_FILE, labels)
    with pytest.raises(GhptDataError, match="there is no S8"), warnings.catch_warnings():
        read(root, "validation")
