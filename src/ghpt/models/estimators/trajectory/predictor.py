"""A recording's reconstruction by trajectories: window by window, with states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from ghpt.models.estimators.classical import Estimator, as_poses, person_scale
from ghpt.models.estimators.predictors import (
    FrameSource,
    prepare,
    reconstruct,
    unobserved_states,
)
from ghpt.models.estimators.rejection import Rejection
from ghpt.models.estimators.trajectory.estimator import Trajectory, TrajectoryPart
from ghpt.models.estimators.trajectory.windows import Clock, Rows, Windows, spread_runs
from ghpt.models.estimators.uncertainty import JointUncertainty
from ghpt.observations import Observations
from ghpt.reconstruction import Reconstruction, State, concatenate
from ghpt.skeleton import Skeleton
