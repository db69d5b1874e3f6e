"""What writers do with gaps, units, axes, unknown rates, bad frames and damaged files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.export import WRITERS, read_reconstruction
from ghpt.export.stream import PIECE, Extent, equidistant_pieces, extent, part, pieces
from ghpt.reconstruction import State
from reconstructions import about, in_parts, random_reconstruction

PLAIN = ["npz", "csv", "trc", "c3d", "html"]
"""Formats that need no further package."""


def take(made, index):
    """The frames at these positions."""
    return type(made)(**{name: value[index] for name, value in vars(made).items()})


def trc_points(path):
    rows = [line.split("\t") for line in path.read_text(encoding="utf-8").split("\n")[6:-1]]
    numbers = np.array([[float(cell) if cell else np.nan for cell in row[:-1]] for row in rows])
    return numbers[:, 0], numbers[:, 2:].reshape(len(rows), -1, 3)


def test_pieces_are_bounded_and_lose_nothing(tmp_path):
    made = random_reconstruction(PIECE + 10, joints=1)
    found = list(
        pieces(tmp_path, about(("a",)), in_parts(part(made, 0, 3), part(made, 3, len(made))))
    )
    assert [len(piece) for piece in found] == [3, PIECE, 7]
    assert torch.equal(torch.cat([piece.points for piece in found]), made.points)


def test_absent_frames_are_rows_without_joints_where_rows_are_equally_spaced(tmp_path):
    made, who = random_reconstruction(30, first=5), about()
    keep = torch.tensor([0, 1, 5, 6, 20, 29])
    gappy = take(made, keep)
    chunks = in_parts(part(gappy, 0, 3), part(gappy, 3, 6))
    full = list(equidistant_pieces(tmp_path, who, chunks, extent(tmp_path, who, chunks)))
    frames = torch.cat([piece.frame for piece in full])
    assert frames.tolist() == list(range(5, 35))
    points, state = (
        torch.cat([piece.points for piece in full]),
        torch.cat([piece.state for piece in full]),
    )
    assert torch.equal(points[keep], gappy.points)
    absent = torch.ones(30, dtype=torch.bool)
    absent[keep] = False
    assert (state[absent] == State.FEW_VIEWS).all()
    WRITERS["trc"].write(tmp_path / "poses.trc", who, chunks)
    numbers, written = trc_points(tmp_path / "poses.trc")
    assert numbers.tolist() == list(range(5, 35))
    assert np.isnan(written[absent.numpy()]).all()


def test_frame_numbers_that_are_times_are_refused_where_gaps_become_rows(tmp_path):
    made = take(random_reconstruction(2), torch.tensor([0, 1]))
    made = replace(made, frame=torch.tensor([0, 10**12]))
    for format in ("trc", "c3d"):
        with pytest.raises(GhptDataError, match="Number the frames one after another"):
            WRITERS[format].write(tmp_path / WRITERS[format].file, about(), in_parts(made))
    assert list(tmp_path.iterdir()) == []
    WRITERS["npz"].write(tmp_path / "poses.npz", about(), in_parts(made))
    assert next(read_reconstruction(tmp_path / "poses.npz")[1]).frame.tolist() == [0, 10**12]


@pytest.mark.parametrize("format", PLAIN)
def test_frames_that_do_not_rise_are_refused_and_nothing_is_left(tmp_path, format):
    made = random_reconstruction(4)
    with pytest.raises(GhptDataError, match="frame: 0 comes after 3"):
        WRITERS[format].write(tmp_path / "file", about(), in_parts(made, made))
    with pytest.raises(GhptDataError, match="3 and 17 in name, 2 and 17 in number"):
        WRITERS[format].write(
            tmp_path / "file", about(), in_parts(random_reconstruction(4, views=2))
        )
    assert list(tmp_path.iterdir()) == []


def test_a_format_that_needs_a_rate_says_so(tmp_path):
    made = in_parts(random_reconstruction(4))
    for format in ("trc", "c3d"):
        with pytest.raises(GhptConfigError, match=r"rate_hz: is unknown.*Give rate_hz="):
            WRITERS[format].write(tmp_path / "file", about(rate_hz=None), made)
        with pytest.raises(GhptConfigError, match="rate_hz"):
            WRITERS[format].write(tmp_path / "file", about(rate_hz=0.0), made)
    for format in ("npz", "csv", "html"):
        WRITERS[format].write(tmp_path / WRITERS[format].file, about(rate_hz=None), made)
    assert read_reconstruction(tmp_path / "poses.npz")[0].rate_hz is None
    assert (tmp_path / "poses.csv").read_text(encoding="utf-8").splitlines()[1].startswith("0,,")


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_world_s_up_becomes_y_by_a_rotation(tmp_path, up):
    made = random_reconstruction(20, missing=0.0)
    WRITERS["trc"].write(tmp_path / "poses.trc", about(), in_parts(made), world_up=up)
    _, found = trc_points(tmp_path / "poses.trc")
    own = made.points.numpy().astype(float)
    np.testing.assert_allclose(
        found[..., 1], own[..., "xyz".index(up[-1])] * (-1 if "-" in up else 1), atol=1e-4
    )
    turn = np.linalg.lstsq(own.reshape(-1, 3), found.reshape(-1, 3), rcond=None)[0]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_settings_of_trc_are_checked(tmp_path):
    made = in_parts(random_reconstruction(2))
    with pytest.raises(GhptConfigError, match=r"trc\.unit"):
        WRITERS["trc"].write(tmp_path / "poses.trc", about(), made, unit="cm")
    with pytest.raises(GhptConfigError, match=r"trc\.world_up"):
        WRITERS["trc"].write(tmp_path / "poses.trc", about(), made, world_up="up")


def test_nothing_missing_is_placed_after_any_round_trip(tmp_path):
    """D7: over random gap patterns, in npz and in TRC; C3D's are checked with its readers."""
    for seed in range(40):
        made = random_reconstruction(25, seed=seed, missing=(seed % 10) / 9)
        WRITERS["npz"].write(tmp_path / "poses.npz", about(), in_parts(made))
        WRITERS["trc"].write(tmp_path / "poses.trc", about(), in_parts(made))
        read = next(read_reconstruction(tmp_path / "poses.npz")[1])
        np.testing.assert_array_equal(read.state, made.state)
        with np.load(tmp_path / "poses.npz") as stored:
            np.testing.assert_array_equal(
                np.isnan(stored["points"]).any(-1), ~made.has_position.numpy()
            )
        _, written = trc_points(tmp_path / "poses.trc")
        np.testing.assert_array_equal(np.isnan(written).any(-1), ~made.has_position.numpy())


def found_out(path):
    """Whether reading raises the named error; what it raises else is passed on, and what it reads
    must be right.
    """
    try:
        who, parts = read_reconstruction(path)
        assert len(list(parts)) == 1
    except GhptDataError as error:
        return str(path) in str(error)
    assert who == about()
    return False


def test_a_damaged_or_foreign_reconstruction_is_named(tmp_path):
    path = tmp_path / "poses.npz"
    WRITERS["npz"].write(path, about(), in_parts(random_reconstruction(30)))
    whole = path.read_bytes()
    rng, named = np.random.default_rng(0), 0
    for damage in range(60):
        data = bytearray(whole)
        if damage % 3 == 0:
            data = data[: rng.integers(len(data))]
        else:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        named += found_out(path)
    assert named > 50  # the other bits mean nothing: a date, an attribute
    path.write_bytes(whole)
    np.savez(tmp_path / "other.npz", points=np.zeros((3, 17, 3)))
    with pytest.raises(GhptDataError, match="not a readable reconstruction"):
        read_reconstruction(tmp_path / "other.npz")
    with pytest.raises(GhptDataError, match="no such file"):
        read_reconstruction(tmp_path / "none.npz")


def test_a_name_that_a_format_cannot_hold_is_refused(tmp_path):
    made = in_parts(random_reconstruction(2, joints=2))
    with pytest.raises(GhptDataError, match="255 bytes"):
        WRITERS["c3d"].write(tmp_path / "poses.c3d", about(("x" * 256, "y")), made)
    with pytest.raises(GhptDataError, match="name of two"):
        WRITERS["trc"].write(tmp_path / "poses.trc", about(("a\tb", "a\nb")), made)
    assert list(tmp_path.iterdir()) == []


def test_no_frames_at_all(tmp_path):
    made = in_parts(random_reconstruction(0))
    with pytest.raises(GhptDataError, match="no frame"):
        WRITERS["c3d"].write(tmp_path / "poses.c3d", about(), made)
    WRITERS["npz"].write(tmp_path / "poses.npz", about(), made)
    who, parts = read_reconstruction(tmp_path / "poses.npz")
    assert (who, list(parts)) == (about(), [])


def test_extent(tmp_path):
    made = random_reconstruction(7, first=-2)
    assert extent(tmp_path, about(), in_parts(made)) == Extent(-2, 4, 7)
