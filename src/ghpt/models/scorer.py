"""The scoring network: from a hypothesis' features to one logit."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghpt.errors import check

ROWS = 400
"""Feature vectors that the network takes at a time on a CPU where no gradient is wanted: what lies
between two layers stays in the cache, which is a fifth faster.
"""

MOST_LAYERS = 100


class Standardise(nn.Module):
    """Subtract the training mean and divide by the training deviation, feature by feature; clip
    what is left.

    The statistics are buffers: they travel in the checkpoint with the weights.
    """

    mean: Float[Tensor, " D"]
    deviation: Float[Tensor, " D"]
    fitted: Bool[Tensor, ""]

    def __init__(self, size: int, clip: float) -> None:
        super().__init__()
        check(clip > 0, "model.scorer.clip", f"is {clip}", "It must be > 0 (standard deviations).")
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("deviation", torch.ones(size))
        self.register_buffer("fitted", torch.tensor(False))

    def fit(self, features: Float[Tensor, "N D"]) -> None:
        """Set the statistics. A feature that hardly varies keeps its scale, rather than being blown
        up.
        """
        features = features.double()
        deviation = features.std(dim=0, correction=0)
        self.mean.copy_(features.mean(dim=0))
        self.deviation.copy_(torch.where(deviation > 1e-3, deviation, torch.ones_like(deviation)))
        self.fitted.fill_(True)

    def forward(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        return ((features - self.mean) / self.deviation).clamp(-self.clip, self.clip)


class Scorer(nn.Module):
    """Multi-layer perceptron with ReLUs on standardised features (tab:hyperparameters:
    1000-900-900-900-700).

    ``bfloat16``: training multiplies matrices in bfloat16, about twice as fast where the processor
    can (weights and optimiser stay float32; gradients are rounded, so several processes agree to
    1e-2 only). Testing never does.
    """

    def __init__(self, size: int, layers: Sequence[int], clip: float, bfloat16: bool) -> None:
        super().__init__()
        self.bfloat16 = bfloat16
        check(
            0 < len(layers) <= MOST_LAYERS and all(n > 0 for n in layers),
            "model.scorer.layers",
            f"is {list(layers)}",
            f"Give the width of each hidden layer, all > 0, of at most {MOST_LAYERS}.",
        )
        self.standardise = Standardise(size, clip)
        widths = [size, *layers]
        hidden = [m for a, b in pairwise(widths) for m in (nn.Linear(a, b), nn.ReLU())]
        self.network = nn.Sequential(*hidden, nn.Linear(widths[-1], 1))

    def forward(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B"]:
        """One logit for each feature vector: higher is more plausible. Not a weight; weights sum to
        1.
        """
        standard = self.standardise(features)
        with torch.autocast(
            features.device.type, torch.bfloat16, enabled=self.bfloat16 and self.training
        ):
            if torch.is_grad_enabled() or features.device.type != "cpu":
                return self.network(standard)[..., 0].to(features.dtype)
            parts = standard.reshape(-1, features.shape[-1]).split(ROWS)
            return torch.cat([self.network(part)[:, 0] for part in parts]).reshape(
                features.shape[:-1]
            )
