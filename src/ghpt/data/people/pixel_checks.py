"""Whether key points are pixels of the images that the cameras are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import CameraSet

_MOST_OUTSIDE = 0.25
_NORMALISED = 1.5
_NEARLY_ALL = 0.99
"""Nearly all coordinates of a view within this are no pixels: of the image's size, with a joint or
two beyond it.
"""


def scale_to_images(people: Detections, cameras: CameraSet, at: Sequence[int]) -> Detections:
    """Return detections in pixels; those that are shares of the images become so.

    ``cameras`` are those of the views ``at``. Raises GhptDataError where the images' sizes are not
    known.
    """
    if not people.normalised:
        return people
    if cameras.size is None:
        problem = "do not say the size of their images, of which the key points are shares"
        hint = "Give it: in the cameras' file, size = [1920, 1080], say."
        raise GhptDataError(cameras.path, "size", problem, hint)
    size = np.zeros((len(people.views), 2))
    size[list(at)] = cameras.size.numpy()
    pixels = people.points.pixels * size[people.view][:, None]
    points = replace(people.points, pixels=pixels)
    return replace(people, points=points, normalised=False)


def check_pixels(where: str, points: KeyPoints, cameras: CameraSet) -> None:
    """Refuse key points [T V K] that are shares of the image, in [0, 1] or [-1, 1].

    Raises GhptDataError, which says how they become pixels.
    """
    size = _image_size(cameras)
    for view, name in enumerate(cameras.names):
        own = points.pixels[:, view][points.valid[:, view]]
        own = own[np.isfinite(own).all(-1)]
        # a detector that gives (0, 0) for what it does not see says nothing of the unit
        if not len(own) or not own.any() or size[view].min() < 20 * _NORMALISED:
            continue
        if np.quantile(np.abs(own), _NEARLY_ALL) > _NORMALISED:
            continue
        width, height = size[view]
        signed = (own < 0).any(-1).mean() > 1 - _NEARLY_ALL
        bounds = "-1 and 1" if signed else "0 and 1"
        problem = (
            f"key points lie between {bounds} in an image of {width:.0f} x {height:.0f}: "
            "they are normalised"
        )
        scaled = f"multiply x by {width:.0f} and y by {height:.0f}"
        if signed:
            scaled = f"add 1, then multiply x by {width / 2:g} and y by {height / 2:g}"
        hint = f"Give pixels: {scaled}; or detect again (OpenPose: --keypoint_scale 0)."
        raise GhptDataError(where, f"view {name}", problem, hint)


def check_image_sizes(where: str, points: KeyPoints, cameras: CameraSet) -> None:
    """Refuse key points [T V K] of which many lie outside the image, where its size is known.

    Detectors place some joints beyond the image's edge; many there are those of an image of
    another size. Raises GhptDataError.
    """
    if cameras.size is None:
        return
    size = _image_size(cameras)
    share = _share_outside(points, size)
    share_rotated = _share_outside(points, size[:, ::-1])
    for view in np.flatnonzero(share > _MOST_OUTSIDE):
        width, height = size[view]
        right, bottom = points.pixels[:, view][points.valid[:, view]].max(0)
        problem = (
            f"{share[view]:.0%} of the key points lie outside its image of "
            f"{width:.0f} x {height:.0f}; they reach {right:.0f} x {bottom:.0f}"
        )
        hint = "Give the intrinsics of the resolution that the key points were detected in."
        if share_rotated[view] < 1 - _NEARLY_ALL:
            problem += (
                f", as in an image of {height:.0f} x {width:.0f}: "
                "turned by 90 degrees, or x and y exchanged"
            )
            hint = (
                "Detect in images that are turned as the calibration's, or give the cameras of "
                "the turned ones, which the camera check writes."
            )
        raise GhptDataError(where, f"view {cameras.names[view]}", problem, hint)


def _image_size(cameras: CameraSet) -> Float[np.ndarray, "V 2"]:
    if cameras.size is not None:
        return cameras.size.numpy().astype(np.float64)
    return (2 * cameras.K[:, :2, 2] + 1).numpy()


def _share_outside(points: KeyPoints, size: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, " V"]:
    """Return the share of each view's key points that lie beyond images of this size."""
    beyond = (points.pixels < -0.5) | (points.pixels > size[:, None] - 0.5)
    outside = points.valid & beyond.any(-1)
    return outside.sum((0, 2)) / points.valid.sum((0, 2)).clip(1)
