"""The pose scorer of the paper's authors, as their code has it, so that their weights can be used.

It differs from the paper's text, and from ours: poses are divided by the deviation of the training
poses' coordinates before lengths are taken, activations are ReLU6, and a hypothesis' score in
(0, 1) is its weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghpt.errors import check
from ghpt.geometry.rotations import vector_to_matrix
from ghpt.models.pose.problem import PoseHypotheses, PoseTriangulation
from ghpt.models.problem import Features
from ghpt.models.scorer import MOST_LAYERS
from ghpt.skeleton import BONES, JOINT, JOINTS, PELVIS

_COORDINATES = len(JOINTS) * 3
_A = JOINT["right_shoulder"]
_B = JOINT["left_shoulder"]
"""The authors call these left and right; they are the joints 12 and 13 in both."""


class WorldPoses(PoseTriangulation):
    """3D poses whose features are their world coordinates, mm: the scorer normalises them itself.

    A joint that a frame does not determine is where the pelvis is.
    """

    def __init__(self) -> None:
        super().__init__(coordinates=True, lengths=False)

    @torch.no_grad()
    def featurize(self, hypotheses: PoseHypotheses) -> Features:
        """Return the coordinates [B H 51]."""
        points = hypotheses.points
        estimated = hypotheses.estimated[:, None, :, None]
        return torch.where(estimated, points, points[:, :, PELVIS, None]).flatten(-2)


class PoseStatistics(nn.Module):
    """Mean and deviation of the training poses' coordinates, by joint and axis, mm."""

    mean: Float[Tensor, "17 3"]
    deviation: Float[Tensor, "17 3"]
    fitted: Bool[Tensor, ""]

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(len(JOINTS), 3))
        self.register_buffer("deviation", torch.ones(len(JOINTS), 3))
        self.register_buffer("fitted", torch.tensor(False))

    def fit(self, features: Float[Tensor, "N 51"]) -> None:
        """Set the statistics to those of poses."""
        points = features.double().unflatten(-1, (len(JOINTS), 3))
        self.mean.copy_(points.mean(0))
        self.deviation.copy_(points.std(0, correction=0).clamp_min(1e-3))
        self.fitted.fill_(True)


class AuthorsScorer(nn.Module):
    """The authors' network on their features.

    ``layers``: the widths. ``coordinates`` and ``lengths``: which features it sees, by their
    ``body_lengths_mode``: 0 the coordinates, 1 both, 2 the lengths.
    """

    def __init__(self, size: int, layers: Sequence[int], coordinates: bool, lengths: bool) -> None:
        super().__init__()
        hint = "Use it with the problem ghpt.models.pose.authors.WorldPoses."
        check(size == _COORDINATES, "model.scorer", f"is given {size} features", hint)
        possible = 0 < len(layers) <= MOST_LAYERS and all(width > 0 for width in layers)
        hint = f"Give the width of each hidden layer, all > 0, of at most {MOST_LAYERS}."
        check(possible, "model.scorer.layers", f"is {list(layers)}", hint)
        hint = "Switch on at least one kind of features."
        check(coordinates or lengths, "model.scorer", "sees nothing", hint)
        self.coordinates = coordinates
        self.lengths = lengths
        self.standardise = PoseStatistics()
        widths = [_COORDINATES * coordinates + len(BONES) * lengths, *layers]
        modules: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            modules += [nn.Linear(inputs, outputs), nn.ReLU6()]
        self.network = nn.Sequential(*modules, nn.Linear(layers[-1], 1))

    def forward(self, features: Float[Tensor, "*B 51"]) -> Float[Tensor, "*B"]:
        """Return the logarithm of each score, whose softmax is the authors' weights."""
        points = features.unflatten(-1, (len(JOINTS), 3))
        standard = (points - self.standardise.mean) / self.standardise.deviation
        centred = standard - standard[..., PELVIS, None, :]
        parts = []
        if self.coordinates:
            parts.append((centred @ _torso_rotation(centred)).flatten(-2))
        if self.lengths:
            starts = [start for start, _ in BONES]
            ends = [end for _, end in BONES]
            parts.append((centred[..., starts, :] - centred[..., ends, :]).norm(dim=-1))
        score = self.network(torch.cat(parts, dim=-1))[..., 0]
        return nn.functional.logsigmoid(score)


def _torso_rotation(pose: Float[Tensor, "*B 17 3"]) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation by which the authors turn a pose.

    Their normal of the torso is not of length 1, and their angle is the arc cosine of its z, which
    is not a number beyond 1; it is taken at 1 here.
    """
    a = pose[..., _A, :]
    normal = torch.linalg.cross(pose[..., PELVIS, :] - a, pose[..., _B, :] - a)
    z = torch.zeros_like(normal)
    z[..., 2] = 1.0
    axis = torch.linalg.cross(z, normal)
    length = axis.norm(dim=-1, keepdim=True)
    axis = axis / length.clamp_min(1e-12)
    angle = torch.acos(normal[..., 2:].clamp(-1, 1))
    return vector_to_matrix(axis * angle)
