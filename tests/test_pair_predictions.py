import json
import zipfile

import numpy as np
import pytest
import torch

from ghpt.errors import GhptDataError, GhptError
from ghpt.models.pose.schema import POSES
from ghpt.models.predictions import PredictionWriter, open_predictions
from ghpt.models.relative_pose.schema import PAIRS, RigTables
from ghpt.observations import RelativePoseEstimate
from pair_report import META, NAMES, content, rig, write_rows, written
from test_predictions import array, changed, write_all

RIGS = [rig(9), rig(11)]


@pytest.fixture
def path(tmp_path):
    written(tmp_path, RIGS, content(RIGS, draws=2))
    return tmp_path / "predictions.npz"


def test_round_trip(tmp_path):
    values = content(RIGS, draws=3)
    opened = written(tmp_path, RIGS, values)
    assert len(opened) == 2 * 3 * 6
    assert opened.names == NAMES
    assert opened.tables.rig_name.tolist() == ["S9", "S11"]
    assert opened.tables.camera_name.tolist() == [["c0", "c1", "c2", "c3"]] * 2
    assert {**META, "problem": "camera", "unit": "mm"}.items() <= opened.meta.items()
    for field in ("K", "R", "t"):
        assert torch.equal(
            getattr(opened.tables.cameras, field),
            torch.stack([getattr(r.cameras, field) for r in RIGS]),
        )
    assert torch.equal(opened.tables.points, torch.stack([r.points for r in RIGS]))
    chunks = list(opened.chunks(16))
    assert [len(chunk.sample.rig) for chunk in chunks] == [16, 16, 4]
    for field in ("rig", "draw", "pair"):
        assert torch.equal(torch.cat([getattr(c.sample, field) for c in chunks]), values[field])
    assert torch.equal(torch.cat([c.sample.truth_R for c in chunks]), values["truth"][0])
    assert torch.equal(torch.cat([c.sample.truth_t for c in chunks]), values["truth"][1])
    for name, estimate in values["estimates"].items():
        for field in ("R", "t", "estimated"):
            assert torch.equal(
                torch.cat([getattr(c.estimates[name], field) for c in chunks]),
                getattr(estimate, field),
            ), (name, field)
    for field in ("entropy", "max", "effective"):
        stored = torch.cat([getattr(c.weights, field) for c in chunks])
        assert torch.equal(stored, getattr(values["weights"], field))


def test_numpy_alone_reads_it_and_missing_is_nan(path):
    values = content(RIGS, draws=2)
    with np.load(path, allow_pickle=False) as arrays:
        missing = ~values["estimates"]["poselib"].estimated.numpy()
        assert 0 < missing.sum() < len(missing)
        np.testing.assert_array_equal(np.isnan(arrays["R_poselib"]).all((1, 2)), missing)
        np.testing.assert_array_equal(np.isnan(arrays["t_poselib"]).any(1), missing)
        assert arrays["t_weight"].dtype == np.float64
        assert json.loads(str(arrays["meta"]))["source"] == "synthetic"


def test_bytes_depend_on_the_content_alone_not_on_the_order_or_the_processes(tmp_path, path):
    values = content(RIGS, draws=2)
    count = len(values["draw"])
    writers = [
        PredictionWriter(tmp_path / "shared", count, NAMES, PAIRS) for _ in range(2)
    ]  # as two processes have them
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    for turn, rows in enumerate(order.split(5)):
        write_rows(writers[turn % 2], rows, values)
    writers[0].finish(tmp_path / "two.npz", RigTables.from_rigs(RIGS), META)
    assert (tmp_path / "two.npz").read_bytes() == path.read_bytes()
    assert not (tmp_path / "shared").exists()


def test_a_missing_row_is_an_error_that_says_so(tmp_path):
    values = content(RIGS[:1], draws=1)
    writer = PredictionWriter(tmp_path / "rows", 7, NAMES, PAIRS)
    write_rows(writer, torch.arange(6), values)
    with pytest.raises(GhptError, match="1 of 7 samples have no prediction"):
        writer.finish(tmp_path / "p.npz", RigTables.from_rigs(RIGS[:1]), META)
    assert not (tmp_path / "p.npz").exists()


def test_a_pose_that_is_not_finite_or_without_a_length_is_not_estimated(tmp_path):
    values = content(RIGS[:1], draws=1)
    spoilt = values["estimates"]["weight"].t.clone()
    spoilt[2, 1] = torch.inf
    spoilt[4] = 0
    values["estimates"]["weight"] = RelativePoseEstimate(
        values["estimates"]["weight"].R, spoilt, torch.ones(6, dtype=torch.bool)
    )
    estimate = written(tmp_path, RIGS[:1], values).read(0, 6).estimates["weight"]
    assert estimate.estimated.tolist() == [True, True, False, True, False, True]
    assert torch.equal(estimate.R[2], torch.eye(3, dtype=torch.float64))
    assert (estimate.t[2] == 0).all()


@pytest.mark.parametrize(
    ("member", "value", "field"),
    [
        ("R_weight", np.zeros((24, 3, 3), np.float32), "R_weight"),
        ("t_rig", None, "t_rig"),
        ("pair", np.zeros((24, 3), np.int32), "pair"),
        ("rig_K", np.zeros((3, 4, 3, 3)), "rig_K"),
        ("rig_K", np.full((2, 4, 3, 3), np.nan), "rig_K"),
        ("rig_points", np.zeros((2, 0, 3)), "rig_points"),
        ("rig_t", None, "rig_t"),
        ("camera_name", np.array([["a", "b"], ["c", "d"]]), "camera_name"),
        ("meta", np.array('{"format_version": 1, "names": ["weight"]}'), "problem"),
        ("meta", np.array('{"format_version": 2}'), "format_version"),
        ("rig_name", np.array([1, 2]), "not a readable"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(tmp_path, path, member, value, field):
    def change(members):
        if value is None:
            del members[f"{member}.npy"]
        else:
            members[f"{member}.npy"] = array(value)

    spoilt = changed(path, tmp_path, change)
    with pytest.raises(GhptDataError, match=field) as caught:
        open_predictions(spoilt, PAIRS)
    assert str(spoilt) in str(caught.value)


@pytest.mark.parametrize(
    ("member", "value"),
    [
        ("rig", np.full(24, 2, np.int32)),
        ("pair", np.full((24, 2), 1, np.int32)),
        ("pair", np.tile(np.array([0, 4], np.int32), (24, 1))),
        ("truth_R", np.full((24, 3, 3), np.nan)),
    ],
)
def test_rows_that_name_what_is_not_there_are_refused(tmp_path, path, member, value):
    spoilt = changed(
        path, tmp_path, lambda members: members.update({f"{member}.npy": array(value)})
    )
    with pytest.raises(GhptDataError, match=member):
        open_predictions(spoilt, PAIRS).read(0, 1)


def test_one_problem_s_file_is_not_taken_for_the_other_s(tmp_path, path):
    with pytest.raises(GhptDataError, match="'camera', not 'pose'"):
        open_predictions(path, POSES)
    with pytest.raises(GhptDataError, match="'pose', not 'camera'"):
        open_predictions(write_all(tmp_path, name="poses.npz"), PAIRS)


def test_damage_is_refused(tmp_path, path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 997):
        path.write_bytes(whole[:length])
        with pytest.raises(GhptDataError):
            open_predictions(path, PAIRS)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.npy", bytes(5 << 20))
    with pytest.raises(GhptDataError, match="compressed"):
        open_predictions(tmp_path / "bomb.npz", PAIRS)
