"""D7: missing is missing. No number without a mask that says observed or filled; nothing is filled
unless asked.
"""

import numpy as np
import pytest
import torch

from ghpt.commands.prediction.gaps import Gaps, apply_gaps
from ghpt.commands.prediction.shards import Shards
from ghpt.data.synthetic.rigs import human36m_rig
from ghpt.export import WRITERS, read_reconstruction
from ghpt.geometry.cameras import Cameras, project
from ghpt.models.estimators.classical import Linear
from ghpt.models.estimators.predictors import Classical
from ghpt.models.estimators.uncertainty import UncertaintyModel
from ghpt.observations import Observations
from ghpt.reconstruction import About, State
from ghpt.skeleton import JOINTS
from predicting import walk

pytestmark = pytest.mark.usefixtures("blank_figures")

ezc3d = pytest.importorskip("ezc3d", reason="ezc3d reads C3D; it comes with ghpt[test]")

T, V, J = 40, 4, len(JOINTS)
FILES = 60
"""Of 17 joints with a pattern of gaps each: 1020."""
RIG = human36m_rig("S9")
ABOUT = About("walk", "synthetic", "linear", JOINTS, RIG.names, 50.0, False, {})


def pattern(rng: np.random.Generator) -> np.ndarray:
    """Which views see each joint, [T, V, J]: from nothing to everything missing, in single frames
    and in bursts.
    """
    share = rng.uniform(0, 1, (1, V, J)) ** rng.uniform(0.3, 3)
    length = rng.integers(1, 12)
    draws = rng.uniform(size=(T // length + 2, V, J)).repeat(length, axis=0)
    start = rng.integers(length)
    return draws[start : start + T] >= share


def batch(valid: np.ndarray, rng: np.random.Generator) -> Observations:
    """What is not seen holds numbers that would show: zeros, NaN, or far off."""
    pixels = project(RIG.cameras, walk()[:T])[0]
    spoilt = torch.tensor([0.0, np.nan, 1e6])[rng.integers(0, 3, valid.shape)].double()[..., None]
    there = torch.from_numpy(valid)
    cameras = Cameras(
        *(x.expand(T, *x.shape) for x in (RIG.cameras.K, RIG.cameras.R, RIG.cameras.t))
    )
    return Observations(
        index=torch.arange(T),
        recording=torch.zeros(T, dtype=torch.int64),
        cameras=cameras,
        key_points=torch.where(there[..., None], pixels, spoilt),
        confidence=there.double(),
        valid=there,
    )


def cells(path) -> np.ndarray:
    """Which joints have three numbers in a TRC file, [T, J]; each has all of them or none."""
    lines = path.read_text().splitlines()[6:]
    rows = np.array(
        [[cell != "" for cell in line.split("\t")[2 : 2 + 3 * J]] for line in lines]
    ).reshape(T, J, 3)
    assert (rows.all(-1) == rows.any(-1)).all()
    return rows.all(-1)


def test_d7_no_value_without_its_state(tmp_path, record_row):
    rng, checked, violations, filled = np.random.default_rng(0), 0, 0, 0
    predictor = Classical(
        Linear(), UncertaintyModel(noise=None, prior=10.0, shared=0.0), flips=None, reject=None
    )
    for number in range(FILES):
        valid = pattern(rng)
        folder = tmp_path / str(number)
        shards = Shards(folder, "key", T, 16)
        whole = predictor(batch(valid, rng))
        for shard in shards.missing():
            rows = slice(shards.rows(shard).start, shards.rows(shard).stop)
            shards.write(
                shard, type(whole)(**{name: value[rows] for name, value in vars(whole).items()})
            )
        longest = None if number % 2 else int(rng.integers(1, 12))
        with apply_gaps(Gaps(longest, "pchip", None, 50.0), shards, J, folder) as chunks:
            for name in ("npz", "trc", "c3d"):
                WRITERS[name].write(folder / f"poses.{name}", ABOUT, chunks)
        shards.close()
        found = next(read_reconstruction(folder / "poses.npz")[1])
        state = found.state.numpy()
        two = valid.sum(1) >= 2
        expected = state == State.OBSERVED
        raw = np.load(folder / "poses.npz")
        c3d = ezc3d.c3d(str(folder / "poses.c3d"))
        placed = state <= State.FILLED
        violations += int((expected & ~two).sum())
        # an estimator may set a key point aside, and then says so
        violations += int(
            (two & ~expected & ~np.isin(state, (State.FILLED, State.BAD_INPUT))).sum()
        )
        violations += int((np.isfinite(raw["points"]).all(-1) != placed).sum())
        violations += int((np.isnan(raw["points"]).all(-1) == placed).sum())
        violations += int((np.isfinite(raw["error"]) != expected).sum())
        violations += int((cells(folder / "poses.trc") != placed).sum())
        violations += int((placed != np.isfinite(c3d["data"]["points"][:3]).all(0).T).sum())
        violations += int(((state == State.FILLED) & ~between(expected, longest)).sum())
        violations += int((between(expected, longest) & (state != State.FILLED)).sum())
        filled += int((state == State.FILLED).sum())
        checked += J
    patterns = f"{checked} patterns of gaps, through npz, TRC and C3D, {filled} filled"
    figure = f"{violations} violations over {patterns}"
    record_row("D7", figure, checked if not violations else 0, checked)
    assert violations == 0
    assert checked >= 1000
    assert filled > 400


def between(observed: np.ndarray, longest: int | None) -> np.ndarray:
    """The slow way: which joints lie in a gap of at most ``longest`` frames with something observed
    on both sides.
    """
    inside = np.zeros(observed.shape, bool)
    for joint in range(J if longest else 0):
        last = None
        for frame in np.flatnonzero(observed[:, joint]).tolist():
            if last is not None and 1 < frame - last <= longest + 1:
                inside[last + 1 : frame, joint] = True
            last = frame
    return inside
