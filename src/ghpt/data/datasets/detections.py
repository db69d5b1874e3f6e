"""A detector's key points of the real sources: back into the image, and out of the lens."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float

from ghpt.geometry.lens import undistort

CROP = 384.0
"""Height of the authors' detector's input, pixels."""
_FAR = 1e5
"""Pixels. A point beyond has left every lens model behind."""


def uncrop(
    crop: Float[np.ndarray, "T V J 2"],
    boxes: Float[np.ndarray, "T V 2 2"],
) -> tuple[Float[np.ndarray, "T V J 2"], Bool[np.ndarray, "T V J"]]:
    """Return image pixels of points in pixels of the 384-high crop, and which are valid.

    Those of a box without height are not. ``boxes`` holds two corners (x, y); a crop keeps its
    aspect, so the height, the extent in y, gives the scale.
    """
    first = boxes[..., 0, :]
    second = boxes[..., 1, :]
    height = np.abs(second[..., 1] - first[..., 1])
    scale = height / CROP
    pixels = crop * scale[..., None, None] + first[..., None, :]
    has_box = height[..., None] > 0
    return pixels, np.broadcast_to(has_box, crop.shape[:-1])


def undistort_key_points(
    pixels: Float[np.ndarray, "T J 2"],
    valid: Bool[np.ndarray, "T J"],
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, " C"],
) -> tuple[Float[np.ndarray, "T J 2"], Bool[np.ndarray, "T J"]]:
    """Return one camera's key points as an ideal pinhole has them (float32), and which are valid.

    Those that are not finite, or where the lens model cannot be inverted, are not valid; they
    become 0.
    """
    valid = valid & (np.abs(pixels) < _FAR).all(-1)
    safe = np.where(valid[..., None], pixels, K[:2, 2]).astype(np.float64)
    raw = torch.from_numpy(safe).reshape(-1, 2)
    ideal, exists = undistort(raw, torch.from_numpy(K), torch.from_numpy(distortion))
    valid = valid & exists.numpy().reshape(valid.shape)
    key_points = ideal.numpy().reshape(pixels.shape)
    return np.where(valid[..., None], key_points, 0).astype(np.float32), valid
