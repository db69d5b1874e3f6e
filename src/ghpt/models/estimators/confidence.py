"""How much a detector's confidence says about its errors, measured on the recording itself."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LEAST_CONFIDENCE = 0.01
"""A smaller confidence counts as this one, so that a view which is used keeps a weight."""
LEAST_EXPONENT = 0.5
"""A smaller exponent is not used: it would gain less than 0.1 % in any data tried."""
LARGEST_EXPONENT = 2.0
_SOFT = 0.1
"""Of the median residual: what is added to each, so that tiny ones do not rule the logarithms."""
_VIEWS = 3
"""Views of a joint: of two the residuals are equal, whatever their confidences."""


@torch.no_grad()
def confidence_exponent(
    residuals: Float[Tensor, "B V J"],
    confidence: Float[Tensor, "B V J"],
    valid: Bool[Tensor, "B V J"],
    least: float = LEAST_EXPONENT,
) -> float:
    """Return the p by which ``confidence ** p`` weights squared residuals.

    The variance of a key point is taken to be proportional to ``confidence ** -p``, whose maximum
    likelihood weights these are. p is the slope of the logarithm of the squared residual over that
    of the confidence, among the views of one joint in one frame, so that hard joints, hard frames
    and the definition of a joint say nothing; divided by the share of the residuals that V views
    leave a point free, 1 - 3 / 2V. It is 0 where the confidences are constant, where they say the
    opposite, and where p, less two standard errors, is below ``least``.

    ``residuals``: reprojection errors in any unit in which views compare, such as fractions of the
    person's scale, of points that outliers do not spoil; ``valid``: which of them are measured.
    """
    measured = valid & residuals.isfinite()
    views = measured.sum(1, keepdim=True)
    measured = measured & (views >= _VIEWS)
    count = int(measured.sum())
    if not count:
        return 0.0
    residuals = residuals.double()
    soft = _SOFT * residuals[measured].median()
    log_error = _deviations((residuals.square() + soft**2).log(), measured)
    log_confidence = _deviations(_floor(confidence).log(), measured)
    spread = log_confidence.square().sum()
    if not spread > 1e-6 * count:
        return 0.0
    slope = -(log_confidence * log_error).sum() / spread
    unexplained = (log_error + slope * log_confidence).square().sum() / count
    surely = slope - 2 * (unexplained / spread).sqrt()
    mean_views = views.expand_as(measured)[measured].double().mean()
    freedom = 1 - 1.5 / mean_views
    if not surely / freedom >= least:
        return 0.0
    return min(float(slope / freedom), LARGEST_EXPONENT)


def confidence_weights(confidence: Float[Tensor, "*B"], exponent: float) -> Float[Tensor, "*B"]:
    """Return ``confidence ** exponent``, float64; 1 for the exponent 0."""
    return _floor(confidence) ** exponent


def _floor(confidence: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    known = confidence.double().nan_to_num(LEAST_CONFIDENCE)
    return known.clamp(min=LEAST_CONFIDENCE)


def _deviations(
    values: Float[Tensor, "B V J"], measured: Bool[Tensor, "B V J"]
) -> Float[Tensor, "B V J"]:
    """Return the differences from the mean over the measured views of each joint; 0 elsewhere."""
    values = torch.where(measured, values, 0.0)
    count = measured.sum(1, keepdim=True).clamp(min=1)
    mean = values.sum(1, keepdim=True) / count
    return torch.where(measured, values - mean, 0.0)
