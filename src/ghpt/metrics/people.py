"""How well several people are found, followed and placed, by the published definitions.

PCP is that of the Shelf and Campus data sets (Belagiannis et al., CVPR 2014), MOTA and identity
switches are those of CLEAR MOT (Bernardin and Stiefelhagen, 2008), IDF1 is that of Ristani et al.
(ECCV workshops 2016).
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torchmetrics import Metric

from ghpt.observations import PoseEstimate, Truth
from ghpt.skeleton import JOINT

PARTS = {
    "head": (("thorax", "head_top"),),
    "torso": (("pelvis", "thorax"),),
    "upper arms": (("right_shoulder", "right_elbow"), ("left_shoulder", "left_elbow")),
    "lower arms": (("right_elbow", "right_wrist"), ("left_elbow", "left_wrist")),
    "upper legs": (("right_hip", "right_knee"), ("left_hip", "left_knee")),
    "lower legs": (("right_knee", "right_ankle"), ("left_knee", "left_ankle")),
}
"""The ten limbs of PCP in its six parts."""
_LIMBS = tuple(limb for limbs in PARTS.values() for limb in limbs)
_STARTS = [JOINT[start] for start, _ in _LIMBS]
_ENDS = [JOINT[end] for _, end in _LIMBS]
_PCP = 0.5
"""Share of a limb's length that its two ends may be off, on average."""


def person_distances(estimate: PoseEstimate, truth: Truth) -> Float[Tensor, "T P E"]:
    """Return the mean distance (mm) of the joints of each true and each estimated person.

    ``truth`` is [T P J], ``estimate`` [T E J]. It is inf where the two share no joint.
    """
    both = truth.valid[:, :, None] & estimate.estimated[:, None]
    offset = truth.points.double()[:, :, None] - estimate.points.double()[:, None]
    distance = torch.linalg.vector_norm(offset, dim=-1)
    count = both.sum(-1)
    total = torch.where(both, distance, 0.0).sum(-1)
    return torch.where(count > 0, total / count.clamp(min=1), torch.inf)


def correct_limbs(
    estimate: PoseEstimate, truth: Truth
) -> tuple[Bool[Tensor, "*B L"], Bool[Tensor, "*B L"]]:
    """Return which limbs are correct, and which have a truth.

    A limb is correct if its two ends are, on average, at most half of its length off. One whose end
    is not estimated is not.
    """
    offset = estimate.points.double() - truth.points.double()
    error = torch.linalg.vector_norm(offset, dim=-1)
    error = torch.where(estimate.estimated, error, torch.inf)
    points = truth.points.double()
    length = torch.linalg.vector_norm(points[..., _STARTS, :] - points[..., _ENDS, :], dim=-1)
    measured = truth.valid[..., _STARTS] & truth.valid[..., _ENDS]
    mean = (error[..., _STARTS] + error[..., _ENDS]) / 2
    return measured & (mean <= _PCP * length), measured


class PeopleErrors(NamedTuple):
    """What ``PeopleError`` computes, over the person-frames with a truth."""

    pcp: Float[Tensor, ""]
    """Share of correct limbs, the mean over the people."""
    pcp_without_head: Float[Tensor, ""]
    mpjpe: Float[Tensor, ""]
    """Mean joint distance of the recalled, mm."""
    recall: Float[Tensor, ""]
    """Share of person-frames that have an estimate within ``reach``."""
    precision: Float[Tensor, ""]
    """Share of the estimated person-frames that are within ``reach`` of a true one."""


class PeopleError(Metric):
    """PCP, MPJPE and recall of several people in each frame.

    For PCP each true person is compared with the nearest estimate, as Shelf and Campus do; recall,
    precision and MPJPE are of the one-to-one assignment of each frame with the least distances, of
    at most ``reach`` mm. PCP is averaged over people, so each update is of one recording, whose
    people are its own.
    """

    full_state_update = False
    limbs: list[Tensor]
    distance: Tensor
    recalled: Tensor
    with_truth: Tensor
    estimated: Tensor

    def __init__(self, reach: float) -> None:
        super().__init__()
        self.reach = reach
        self.add_state("limbs", [], dist_reduce_fx="cat")
        for name in ("distance", "recalled", "with_truth", "estimated"):
            zero = torch.zeros((), dtype=torch.float64)
            self.add_state(name, zero, dist_reduce_fx="sum")

    def update(self, estimate: PoseEstimate, truth: Truth) -> None:
        """Add a recording: ``truth`` [T P J], ``estimate`` [T E J]."""
        distances = person_distances(estimate, truth)
        present = truth.valid.any(-1)
        self.limbs.append(_limb_shares(estimate, truth, distances))
        for frame, person, found in _assign(distances, self.reach):
            self.distance += distances[frame, person, found]
            self.recalled += 1
        self.with_truth += present.sum()
        self.estimated += estimate.estimated.any(-1).sum()

    def compute(self) -> PeopleErrors:
        shares = torch.cat(list(self.limbs)) if isinstance(self.limbs, list) else self.limbs
        return PeopleErrors(
            pcp=shares.nanmean(),
            pcp_without_head=shares[:, 1:].nanmean(),
            mpjpe=self.distance / self.recalled,
            recall=self.recalled / self.with_truth,
            precision=self.recalled / self.estimated,
        )


def _limb_shares(
    estimate: PoseEstimate, truth: Truth, distances: Float[Tensor, "T P E"]
) -> Float[Tensor, "P L"]:
    """Return the share of frames in which each limb of each person is correct; NaN without any."""
    frames, people, joints = truth.valid.shape
    if not estimate.estimated.shape[1]:
        estimate = PoseEstimate(
            torch.zeros(frames, 1, joints, 3), torch.zeros(frames, 1, joints, dtype=torch.bool)
        )
        distances = torch.full((frames, people, 1), torch.inf)
    nearest = distances.argmin(-1)
    at = torch.arange(frames)[:, None]
    near = PoseEstimate(estimate.points[at, nearest], estimate.estimated[at, nearest])
    correct, measured = correct_limbs(near, truth)
    return correct.sum(0).double() / measured.sum(0)


def _assign(distances: Float[Tensor, "T P E"], reach: float) -> list[tuple[int, int, int]]:
    """Return (frame, person, estimate) of the assignments within reach."""
    found = []
    for frame, table in enumerate(distances.clamp(max=10 * reach).numpy()):
        rows, columns = linear_sum_assignment(table)
        near = table[rows, columns] <= reach
        pairs = zip(rows[near].tolist(), columns[near].tolist(), strict=True)
        found += [(frame, row, column) for row, column in pairs]
    return found


class TrackingScores(NamedTuple):
    """What ``Tracking`` computes."""

    mota: Float[Tensor, ""]
    """1 - (missed + invented + switches) / true person-frames: at most 1, below 0 if bad."""
    idf1: Float[Tensor, ""]
    """F1 of the person-frames that the best one-to-one assignment of whole people gets right."""
    switches: Int[Tensor, ""]
    """Number of times that a true person goes on as another estimated one."""


class Tracking(Metric):
    """MOTA, IDF1 and identity switches of people who are at most ``reach`` mm off.

    Each update is one recording, whose people are its own.
    """

    full_state_update = False
    missed: Tensor
    invented: Tensor
    switches: Tensor
    with_truth: Tensor
    estimated: Tensor
    identified: Tensor

    def __init__(self, reach: float) -> None:
        super().__init__()
        self.reach = reach
        counts = ("missed", "invented", "switches", "with_truth", "estimated", "identified")
        for name in counts:
            zero = torch.zeros((), dtype=torch.int64)
            self.add_state(name, zero, dist_reduce_fx="sum")

    def update(self, estimate: PoseEstimate, truth: Truth) -> None:
        """Add a recording: ``truth`` [T P J], ``estimate`` [T E J]."""
        distances = person_distances(estimate, truth)
        matched, switches = _follow(distances, self.reach)
        with_truth = int(truth.valid.any(-1).sum())
        estimated = int(estimate.estimated.any(-1).sum())
        self.missed += with_truth - matched
        self.invented += estimated - matched
        self.switches += switches
        self.with_truth += with_truth
        self.estimated += estimated
        together = (distances <= self.reach).sum(0).numpy()
        rows, columns = linear_sum_assignment(together, maximize=True)
        self.identified += int(together[rows, columns].sum())

    def compute(self) -> TrackingScores:
        wrong = self.missed + self.invented + self.switches
        return TrackingScores(
            mota=1 - wrong / self.with_truth,
            idf1=2 * self.identified / (self.with_truth + self.estimated),
            switches=self.switches,
        )


def _follow(distances: Float[Tensor, "T P E"], reach: float) -> tuple[int, int]:
    """Return the numbers of matches and of identity switches, as CLEAR MOT counts them.

    A match goes on as long as it is within reach; the others are assigned anew in each frame.
    """
    before: dict[int, int] = {}
    last: dict[int, int] = {}
    matched = 0
    switches = 0
    for table in distances.clamp(max=10 * reach).numpy():
        now = {p: e for p, e in before.items() if table[p, e] <= reach}
        rest = table.copy()
        rest[list(now)] = 10 * reach
        rest[:, list(now.values())] = 10 * reach
        rows, columns = linear_sum_assignment(rest)
        near = rest[rows, columns] <= reach
        new = dict(zip(rows[near].tolist(), columns[near].tolist(), strict=True))
        switches += sum(last.get(person, found) != found for person, found in new.items())
        now |= new
        last |= now
        matched += len(now)
        before = now
    return matched, switches
