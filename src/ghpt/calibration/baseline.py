"""The whole rig as an estimator of each of its pairs."""

from __future__ import annotations

from collections import OrderedDict

import torch

from ghpt.calibration.rig import RigCalibration, RigEstimate
from ghpt.errors import check
from ghpt.geometry.cameras import relative_pose
from ghpt.observations import PairObservations, RelativePoseEstimate


class RigBaseline:
    """``baseline(batch)``: the rig of each draw calibrated once, from all views of its frames,
    gives the relative poses of its pairs, with t of length 1. ``remembered`` draws are kept for the
    batches to come; ``seed`` is that of the calibration.
    """

    def __init__(self, calibration: RigCalibration, remembered: int, seed: int) -> None:
        check(remembered >= 1, "remembered", f"is {remembered}", "It must be >= 1.")
        self.calibration = calibration
        self.remembered = remembered
        self.seed = seed
        self._found: OrderedDict[tuple, RigEstimate] = OrderedDict()

    @torch.no_grad()
    def __call__(self, batch: PairObservations) -> RelativePoseEstimate:
        device = batch.key_points.device
        rigs = [self._rig(batch, item) for item in range(len(batch))]
        a, b = batch.pair.cpu().T
        R, t, ok = (
            torch.stack(x) if x else empty
            for x, empty in (
                ([rig.cameras.R for rig in rigs], torch.zeros(0, 1, 3, 3)),
                ([rig.cameras.t for rig in rigs], torch.zeros(0, 1, 3)),
                ([rig.calibrated for rig in rigs], torch.zeros(0, 1, dtype=torch.bool)),
            )
        )
        item = torch.arange(len(rigs))
        turn, shift = relative_pose(R[item, a], t[item, a], R[item, b], t[item, b])
        length = shift.norm(dim=-1)
        ok = ok[item, a] & ok[item, b] & (length > 0)
        eye = torch.eye(3, dtype=R.dtype)
        turn = torch.where(ok[:, None, None], turn, eye)
        shift = torch.where(ok[:, None], shift / torch.where(ok, length, 1.0)[:, None], 0.0)
        return RelativePoseEstimate(
            turn.double().to(device), shift.double().to(device), ok.to(device)
        )

    def _rig(self, batch: PairObservations, item: int) -> RigEstimate:
        key_points = batch.key_points[item].transpose(0, 1).cpu()
        # the sum tells draws of different data sets apart, whose numbers are the same
        known = int(batch.rig[item]), int(batch.draw[item]), float(key_points.double().sum())
        if known not in self._found:
            confidence, valid = (
                x[item].transpose(0, 1).cpu() for x in (batch.confidence, batch.valid)
            )
            K = batch.K[item].double().cpu()
            names = [str(view) for view in range(len(K))]
            self._found[known] = self.calibration(
                names, K, key_points, confidence, valid, None, self.seed
            )
        self._found.move_to_end(known)
        while len(self._found) > self.remembered:
            self._found.popitem(last=False)
        return self._found[known]
