"""What is known of a key point beside a first estimate of the pose: numbers of order one.

Lengths are in ``UNIT`` statures at the depth of the body, so that all views and people compare.
Nothing is relative to a recording: a frame's features are its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghpt.geometry.cameras import camera_centre
from ghpt.geometry.normal_equations import minors
from ghpt.models.body import BONE_SHARES, UNIT, log_length, stature, trunk_axes
from ghpt.observations import Observations, PoseEstimate
from ghpt.skeleton import BONES, JOINTS, MIRROR

NAMES = (
    "valid",
    "residual",
    "residual, mean of the other views",
    "residual, largest of the other views",
    "residual, median of the frame",
    "residual, median of the view",
    "residual without what the view's key points share",
    "freedom that the other views leave",
    "ray, distance from the nearest other ray",
    "ray, distance from the second nearest",
    "distance from the joint of the other side, relative to the residual",
    "confidence",
    "confidence, relative to the other views'",
    "confidence, relative to the view's other key points",
    "share of the views that see the joint",
    "one over their number",
    "camera, in front of the body",
    "camera, on the joint's side",
    "camera, above the body",
    "depth in the body",
    "bones of the joint, error of their lengths",
    "the same along the residual",
    "the same of their other ends",
    "angle between the rays",
)
"""Of the features, in their order."""

_PARALLEL = 0.05
"""Sine of the angle between two rays below which they are near each other by chance."""


_SIDES = tuple(float(name.startswith("left")) - float(name.startswith("right")) for name in JOINTS)

PerKeyPoint = Float[Tensor, "B V J"]
Mask = Bool[Tensor, "B V J"]


@dataclass(frozen=True)
class Geometry:
    """Cameras, key points and first joints of B frames about the person's middle; float32."""

    valid: Mask
    """Key points of joints that have a first estimate."""
    points: Float[Tensor, "B J 3"]
    """mm; 0 where not estimated."""
    estimated: Bool[Tensor, "B J"]
    R: Float[Tensor, "B V 3 3"]
    centre: Float[Tensor, "B V 3"]
    """Of each camera, mm."""
    depth: PerKeyPoint
    """Of each joint in each view, mm."""
    residual: Float[Tensor, "B V J 2"]
    """Units."""
    ray: Float[Tensor, "B V J 3"]
    """Direction of each key point's ray in the world; of length 1."""
    unit: Float[Tensor, " B"]
    """Length of a unit, mm."""


@torch.no_grad()
def measure(observations: Observations, start: PoseEstimate) -> Geometry:
    """Return the geometry of the observations beside the first estimate ``start``."""
    estimated = start.estimated
    valid = observations.valid & estimated[:, None]
    count = estimated.sum(-1).clamp(min=1)[:, None]
    world = torch.where(estimated[..., None], start.points.double(), 0.0)
    origin = world.sum(1) / count
    points = torch.where(estimated[..., None], world - origin[:, None], 0.0).float()
    cameras = observations.cameras
    shift = (cameras.R.double() @ origin[:, None, :, None])[..., 0]
    t = (cameras.t + shift).float()
    R = cameras.R.float()
    K = cameras.K.float()
    in_camera = points[:, None] @ R.mT + t[:, :, None]
    depth = in_camera[..., 2].clamp(min=1.0)
    pixels = observations.key_points.float() - K[..., None, :2, 2]
    y = pixels[..., 1] / K[..., 1, 1, None]
    x = (pixels[..., 0] - K[..., 0, 1, None] * y) / K[..., 0, 0, None]
    position = torch.stack((x, y), dim=-1)
    position = torch.where(valid[..., None], position, 0.0)
    unit = UNIT * stature(points, estimated)
    residual = position * depth[..., None] - in_camera[..., :2]
    residual = residual / unit[:, None, None, None]
    direction = torch.cat((position, torch.ones_like(position[..., :1])), dim=-1) @ R
    return Geometry(
        valid=valid,
        points=points,
        estimated=estimated,
        R=R,
        centre=camera_centre(R, t),
        depth=depth,
        residual=torch.where(valid[..., None], residual, 0.0),
        ray=torch.nn.functional.normalize(direction, dim=-1),
        unit=unit,
    )


@torch.no_grad()
def featurize(observations: Observations, start: PoseEstimate) -> Float[Tensor, "B V J D"]:
    """Return the ``NAMES`` of each key point; all 0 where it is not valid."""
    geometry = measure(observations, start)
    valid = geometry.valid
    views = valid.sum(1, keepdim=True)
    residual = log_length(geometry.residual.norm(dim=-1))
    confidence = observations.confidence.float().clamp(min=0.01, max=1.0).log()
    in_frame = _median(residual, valid, (1, 2))
    nearest, second = _ray_distances(geometry)
    freedom, angle = _freedom(geometry)
    features = [
        torch.ones_like(residual),
        residual,
        _mean_of_others(residual, valid),
        _largest_of_others(residual, valid),
        in_frame,
        _median(residual, valid, (2,)),
        log_length(_without_common(geometry.residual, valid).norm(dim=-1)),
        freedom,
        nearest,
        second,
        _beside_mirror(geometry) - residual,
        confidence,
        confidence - _mean(confidence, valid, 1),
        confidence - _mean(confidence, valid, 2),
        views / valid.any(2).sum(1)[:, None, None].clamp(min=1),
        1 / views.clamp(min=1),
        *_camera_direction(geometry),
        _depth_in_body(geometry),
        *_bone_errors(geometry),
        angle,
    ]
    stacked = torch.stack([feature.expand(valid.shape) for feature in features], dim=-1)
    return torch.where(valid[..., None], stacked, 0.0)


def _mean(values: PerKeyPoint, valid: Mask, dim: int) -> PerKeyPoint:
    total = torch.where(valid, values, 0.0).sum(dim, keepdim=True)
    return total / valid.sum(dim, keepdim=True).clamp(min=1)


def _mean_of_others(values: PerKeyPoint, valid: Mask) -> PerKeyPoint:
    values = torch.where(valid, values, 0.0)
    others = valid.sum(1, keepdim=True) - 1
    return (values.sum(1, keepdim=True) - values) / others.clamp(min=1)


def _largest_of_others(values: PerKeyPoint, valid: Mask) -> PerKeyPoint:
    values = torch.where(valid, values, -10.0)
    if values.shape[1] < 2:
        return torch.zeros_like(values)
    two = values.topk(2, dim=1).values
    return torch.where(values >= two[:, :1], two[:, 1:], two[:, :1])


def _median(values: PerKeyPoint, valid: Mask, dims: tuple[int, ...]) -> PerKeyPoint:
    """Return the median over views and joints, or over joints; 0 where nothing is valid."""
    masked = torch.where(valid, values, torch.nan)
    if len(dims) == 2:
        return masked.flatten(1).nanmedian(-1).values.nan_to_num(0.0)[:, None, None]
    return masked.nanmedian(-1, keepdim=True).values.nan_to_num(0.0)


def _without_common(residual: Float[Tensor, "B V J 2"], valid: Mask) -> Float[Tensor, "B V J 2"]:
    """Return the residuals less the median of their view's: what a turned camera gives them all."""
    masked = torch.where(valid[..., None], residual, torch.nan)
    return residual - masked.nanmedian(2, keepdim=True).values.nan_to_num(0.0)


def _ray_distances(geometry: Geometry) -> tuple[PerKeyPoint, PerKeyPoint]:
    """Return the logarithms of the distances from the two nearest rays of other views.

    Whatever the first estimate is: they tell two views that agree from those that a wrong estimate
    parts. Where there are no such views the distance is that of a stranger.
    """
    valid = geometry.valid
    views = valid.shape[1]
    normal = torch.linalg.cross(geometry.ray[:, :, None], geometry.ray[:, None])
    between = geometry.centre[:, :, None] - geometry.centre[:, None]
    length = normal.norm(dim=-1).clamp(min=_PARALLEL)
    distance = (normal * between[..., None, :]).sum(-1).abs() / length
    distance = log_length(distance / geometry.unit[:, None, None, None])
    itself = torch.eye(views, dtype=torch.bool, device=valid.device)[..., None]
    other = valid[:, None] & ~itself
    distance = torch.where(other, distance, _STRANGE).clamp(max=_STRANGE)
    if views < 3:
        nearest = distance.amin(2)
        return nearest, torch.full_like(nearest, _STRANGE)
    two = distance.topk(2, dim=2, largest=False).values
    return two[:, :, 0], two[:, :, 1]


_STRANGE = 5.0
"""Logarithm of the distance, in units, of what has nothing to do with each other."""


def _freedom(geometry: Geometry) -> tuple[PerKeyPoint, PerKeyPoint]:
    """Return what the other views leave of a view's residual, and the angle between the rays.

    The first is the logarithm of 1 - leverage / 2, near 0 where the other views fix the point; the
    second that of the smallest part of the information, the same for all views of a joint.
    """
    weight = geometry.valid.float()
    ray = geometry.ray
    upper = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    count = weight.sum(1)
    outer = [(weight * ray[..., i] * ray[..., j]).sum(1) for i, j in upper]
    xx, xy, xz, yy, yz, zz = outer
    matrix = (count - xx, -xy, -xz, count - yy, -yz, count - zz)
    cofactors = minors(matrix)
    determinant = matrix[0] * cofactors[0] + matrix[1] * cofactors[1] + matrix[2] * cofactors[2]
    determinant = determinant.clamp(min=1e-6)
    x, y, z = ray.unbind(-1)
    a, b, c, d, e, f = (cofactor[:, None] for cofactor in cofactors)
    along = a * x * x + d * y * y + f * z * z + 2 * (b * x * y + c * x * z + e * y * z)
    trace = (cofactors[0] + cofactors[3] + cofactors[5])[:, None]
    leverage = (trace - along) / determinant[:, None]
    freedom = (1 - leverage / 2).clamp(0.01, 1.0).log()
    angle = (determinant / count.clamp(min=1) ** 3).clamp(min=1e-4).log()
    return freedom, 0.5 * angle[:, None]


def _beside_mirror(geometry: Geometry) -> PerKeyPoint:
    """Return the logarithm of the distance from the joint of the other side."""
    mirror = list(MIRROR)
    points = geometry.points[:, mirror] - geometry.points
    across = (points[:, None] @ geometry.R.mT)[..., :2] / geometry.unit[:, None, None, None]
    return log_length((geometry.residual - across).norm(dim=-1))


def _camera_direction(geometry: Geometry) -> list[PerKeyPoint]:
    """Return the direction of the camera in the trunk's frame; 0 where there is no trunk."""
    axes, known = trunk_axes(geometry.points, geometry.estimated)
    direction = torch.nn.functional.normalize(geometry.centre, dim=-1)
    axes = torch.where(known[:, None, None], axes, 0.0)
    ahead, aside, above = (direction @ axes.mT)[:, :, None].unbind(-1)
    side = aside.new_tensor(_SIDES)
    return [ahead, aside * side, above]


def _depth_in_body(geometry: Geometry) -> PerKeyPoint:
    """Return how far the joint is behind the body's middle in the view, in tenths of a stature."""
    middle = _mean(geometry.depth, geometry.valid, 2)
    return (geometry.depth - middle) * (10 * UNIT / geometry.unit[:, None, None])


def _bone_errors(geometry: Geometry) -> list[PerKeyPoint]:
    """Return how wrong the lengths of a joint's bones are, that along the residual, and of the
    joints at the other ends.

    A bone pulls its ends towards the length that it has in a person of this stature.
    """
    points = geometry.points
    start = [a for a, _ in BONES]
    end = [b for _, b in BONES]
    bone = points[:, end] - points[:, start]
    length = bone.norm(dim=-1)
    complete = geometry.estimated[:, start] & geometry.estimated[:, end]
    unit = geometry.unit[:, None]
    share = length.new_tensor(BONE_SHARES)
    excess = torch.where(complete, length / unit - share / UNIT, 0.0)
    pull = excess[..., None] * bone / length.clamp(min=1.0)[..., None]
    total = torch.zeros_like(points)
    total.index_add_(1, torch.tensor(start, device=points.device), pull)
    total.index_add_(1, torch.tensor(end, device=points.device), -pull)
    error = points.new_zeros(points.shape[:2])
    size = excess.abs()
    error.index_add_(1, torch.tensor(start, device=points.device), size)
    error.index_add_(1, torch.tensor(end, device=points.device), size)
    ends = points.new_zeros(points.shape[:2])
    ends.index_add_(1, torch.tensor(start, device=points.device), error[:, end] - size)
    ends.index_add_(1, torch.tensor(end, device=points.device), error[:, start] - size)
    in_view = (total[:, None] @ geometry.R.mT)[..., :2]
    size_of_residual = geometry.residual.norm(dim=-1).clamp(min=0.1)
    along = (in_view * geometry.residual).sum(-1) / size_of_residual
    signed = along.sign() * (along.abs() + 1).log()
    return [log_length(error)[:, None], signed, log_length(ends.clamp(min=0))[:, None]]
