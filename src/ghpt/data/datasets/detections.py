"""What both real sources do to a detector's key points: back into the image, and out of the lens."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float

from ghpt.geometry.lens import undistort

CROP = 384.0
"""Height of the authors' detector's input, pixels."""
_FAR = 1e5
"""Pixels. A point beyond has left every lens model behind."""


def in_image(
    crop: Float[np.ndarray, "T V J 2"], boxes: Float[np.ndarray, "T V 2 2"]
) -> tuple[Float[np.ndarray, "T V J 2"], Bool[np.ndarray, "T V J"]]:
    """Image pixels of points in pixels of the 384-high crop, and which are there: those of a zero
    box are not.

    ``boxes`` holds two corners (x, y); a crop keeps its aspect, so the height, the extent in y,
    gives the scale.
    """
    height = np.abs(boxes[..., 1, 1] - boxes[..., 0, 1])[..., None, None]
    pixels = crop * (height / CROP) + boxes[..., None, 0, :]
    return pixels, np.broadcast_to(height[..., 0] > 0, crop.shape[:-1])


def undistorted(
    pixels: Float[np.ndarray, "T J 2"],
    valid: Bool[np.ndarray, "T J"],
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, " 5"],
) -> tuple[Float[np.ndarray, "T J 2"], Bool[np.ndarray, "T J"]]:
    """One camera's key points as an ideal pinhole would see them (float32), and which are seen.

    Those that are not finite, or where the lens model cannot be inverted, are not seen; they become
    0.
    """
    valid = valid & (np.abs(pixels) < _FAR).all(-1)
    raw = torch.from_numpy(np.where(valid[..., None], pixels, K[:2, 2]).astype(np.float64)).reshape(
        -1, 2
    )
    ideal, exists = undistort(raw, torch.from_numpy(K), torch.from_numpy(distortion))
    valid = valid & exists.numpy().reshape(valid.shape)
    return np.where(valid[..., None], ideal.numpy().reshape(pixels.shape), 0).astype(
        np.float32
    ), valid
