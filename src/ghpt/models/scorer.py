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
    """Subtracts the training mean of each feature, divides by the deviation, and clips the rest.

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
        """Set the statistics.

        A feature that hardly varies keeps its scale, rather than being blown up.
        """
        features = features.double()
        deviation = features.std(dim=0, correction=0)
        varies = deviation > 1e-3
        self.mean.copy_(features.mean(dim=0))
        self.deviation.copy_(torch.where(varies, deviation, torch.ones_like(deviation)))
        self.fitted.fill_(True)

    def forward(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        """Return the features in deviations from the mean."""
        standard = (features - self.mean) / self.deviation
        return standard.clamp(-self.clip, self.clip)


class Scorer(nn.Module):
    """Multi-layer perceptron with ReLUs on standardised features.

    ``layers``: the widths (tab:hyperparameters: 1000-900-900-900-700). ``bfloat16``: training
    multiplies matrices in bfloat16, about twice as fast where the processor can (weights and
    optimiser stay float32; gradients are rounded, so several processes agree to 1e-2 only). Testing
    never does.
    """

    def __init__(self, size: int, layers: Sequence[int], clip: float, bfloat16: bool) -> None:
        super().__init__()
        self.trains_in_bfloat16 = bfloat16
        possible = 0 < len(layers) <= MOST_LAYERS and all(width > 0 for width in layers)
        hint = f"Give the width of each hidden layer, all > 0, of at most {MOST_LAYERS}."
        check(possible, "model.scorer.layers", f"is {list(layers)}", hint)
        self.standardise = Standardise(size, clip)
        modules: list[nn.Module] = []
        for inputs, outputs in pairwise([size, *layers]):
            modules += [nn.Linear(inputs, outputs), nn.ReLU()]
        self.network = nn.Sequential(*modules, nn.Linear(layers[-1], 1))

    def forward(self, features: Float[Tensor, "*B D"]) -> Float[Tensor, "*B"]:
        """Return a logit for each feature vector; a higher one is more plausible.

        It is not a weight: weights sum to 1.
        """
        standard = self.standardise(features)
        device = features.device.type
        rounded = self.trains_in_bfloat16 and self.training
        with torch.autocast(device, torch.bfloat16, enabled=rounded):
            if torch.is_grad_enabled() or device != "cpu":
                return self.network(standard)[..., 0].to(features.dtype)
            parts = standard.reshape(-1, features.shape[-1]).split(ROWS)
            logits = torch.cat([self.network(part)[:, 0] for part in parts])
            return logits.reshape(features.shape[:-1])
