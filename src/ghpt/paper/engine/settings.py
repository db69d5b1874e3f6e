"""The settings of the reproduction, conf/reproduce.yaml, that decide which tasks there are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ghpt.errors import check_positive


@dataclass(frozen=True)
class Overrides:
    """Overrides of every training and of every test, in the words of their command lines."""

    train: tuple[str, ...] = ()
    test: tuple[str, ...] = ()


@dataclass(frozen=True)
class FramesSweep:
    """Sizes of fig:comparison-to-8-point."""

    frames: tuple[int, ...]
    draws: int
    """Draws of each of the two rigs."""
    all_pairs: bool
    """False: the paper's pair (2, 3) alone."""


@dataclass(frozen=True)
class UnknownExtrinsics:
    """Sizes of tab:unknown-extrinsics-evaluation."""

    frames: int
    draws: int
    """Draws of each of the two rigs; they take turns over the poses."""
    stride: int
    """Every so many frames are tested."""


@dataclass(frozen=True)
class Ablation:
    """Sizes of the ablations."""

    stride: Mapping[str, int]
    """Split -> every so many frames are evaluated."""
    also_trained_on: tuple[str, ...]
    """Training sets besides Human3.6M, for Gumbel noise, features and selection."""
    temperature: tuple[float, ...]
    hypotheses: tuple[int, ...]
    hypotheses_trained: tuple[int, ...]
    """Numbers of hypotheses in training, tested with the default."""
    samples: tuple[int, ...]
    samples_hypotheses: int
    """Hypotheses in the pools of the trainings with other numbers of samples."""


@dataclass(frozen=True)
class Sequences:
    """Runs of successive frames, in which time can tell something."""

    stride: int
    """Every so many frames of a recording a run begins."""
    frames: int
    """Of each run."""
    tested: int
    """Every so many frames of a run are compared with the truth."""

    def __post_init__(self) -> None:
        check_positive(stride=self.stride, frames=self.frames, tested=self.tested)


@dataclass(frozen=True)
class Robustness:
    """Sizes of the robustness curves; lengths are in the person's size in the image."""

    trained_on: str
    sequences: Mapping[str, Sequences]
    """h36m, panoptic -> which frames are estimated and tested."""
    lasting: int
    """Frames for which a mistake lasts that is not new in every frame."""
    outliers: tuple[float, ...]
    """Shares of the detections."""
    lasting_outliers: tuple[float, ...]
    outliers_shortest: float
    outliers_longest: float
    noise: tuple[float, ...]
    """Standard deviations."""
    missing_detections: tuple[float, ...]
    missing_views: tuple[int, ...]
    views: tuple[int, ...]
    rotation: tuple[float, ...]
    """Degrees."""
    shift: tuple[float, ...]
    """mm."""
    flips: tuple[float, ...]
    """Shares of the views."""
    other_people: tuple[float, ...]
    """Shares of the views."""
    nearest: float
    """Distance of another person, mm."""
    farthest: float


@dataclass(frozen=True)
class Sizes:
    """How much of each sweep is computed."""

    frames_sweep: FramesSweep
    unknown_extrinsics: UnknownExtrinsics
    ablation: Ablation
    robustness: Robustness


@dataclass(frozen=True)
class DataFolders:
    """Where the real data sets are; None: the synthetic one."""

    root: str | None
    """A folder with human36m/ and panoptic/."""
    human36m: str | None
    panoptic: str | None
