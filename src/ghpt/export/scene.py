"""What pictures of a reconstruction show besides it: cameras, key points, and which way is up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.geometry.cameras import Cameras, CameraSet
from ghpt.geometry.epipolar import homogeneous
from ghpt.geometry.lens import pad_lens
from ghpt.reconstruction import About, Reconstruction


@dataclass(frozen=True)
class Evidence:
    """What a part of a reconstruction was made of, frame by frame."""

    key_points: Float[Tensor, "T V J 2"]
    """Undistorted pixels."""
    valid: Bool[Tensor, "T V J"]
    hypotheses: Float[Tensor, "T H J 3"] | None
    """World, mm; those of the pool that are worth a look."""

    def part(self, start: int, stop: int) -> Evidence:
        """Return the frames from position ``start`` up to ``stop``."""
        rows = slice(start, stop)
        hypotheses = None if self.hypotheses is None else self.hypotheses[rows]
        return Evidence(self.key_points[rows], self.valid[rows], hypotheses)


@dataclass(frozen=True)
class Images:
    """The images of V views."""

    lens: Float[Tensor, "V 9"]
    """Coefficients of ``ghpt.geometry.lens``."""
    size: Float[Tensor, "V 2"]
    """Width and height, pixels."""
    videos: tuple[str | None, ...] = ()
    """Where the page finds the video of each view; empty, or None, where there is none."""


@dataclass(frozen=True)
class OtherPoses:
    """Poses beside the reconstruction's."""

    name: str
    bones: tuple[tuple[int, int], ...]
    points: Callable[[Int[Tensor, " T"]], Float[Tensor, "T J 3"]]
    """Returns the poses at frame numbers, mm in the world; NaN where there are none."""


@dataclass(frozen=True)
class Scene:
    """What a picture shows besides the skeleton."""

    cameras: Cameras
    """The views, in the order of ``About.camera_names``; leading dimension V."""
    evidence: Callable[[], Iterator[Evidence]] | None = None
    """In parts as long as those of the reconstruction."""
    images: Images | None = None
    """What the views' images are like; None: ideal pinholes, as large as twice the principal point.
    """
    key_point_joints: tuple[tuple[int, int], ...] = ()
    """Key points of the evidence, and the joints of the reconstruction that they are."""
    others: tuple[OtherPoses, ...] = ()
    """What other estimators make of the same frames."""


def images_of(cameras: CameraSet, videos: tuple[str | None, ...] = ()) -> Images:
    """Return what the images of cameras are like, as far as their file says it."""
    size = 2 * cameras.K[:, :2, 2] if cameras.size is None else cameras.size.double()
    return Images(pad_lens(cameras.distortion), size, videos)


def title(about: About) -> str:
    """Return the title of a picture; it says where the data are not real."""
    synthetic = about.source == "synthetic" and "synthetic" not in about.name
    return f"{about.name} (synthetic data)" if synthetic else about.name


def origin_note(about: About) -> str:
    """Return where a picture's zero is, in words; nothing where it is the world's own."""
    if not any(about.origin):
        return ""
    position = ", ".join(f"{x:.15g}" for x in about.origin)
    return f"zero is at ({position}) mm of the cameras' world"


def bones_of(about: About) -> list[tuple[int, int]]:
    """Return the bones whose ends are among the joints, as index pairs."""
    index = {joint: place for place, joint in enumerate(about.joints)}
    present = [bone for bone in about.bones if index.keys() >= set(bone)]
    return [(index[start], index[end]) for start, end in present]


def side_of(joint: str) -> str:
    """Return left, right or middle."""
    for side in ("left", "right"):
        if side in joint.lower():
            return side
    return "middle"


def upward(joints: tuple[str, ...], piece: Reconstruction) -> Float[Tensor, " 3"]:
    """Return the sum over the frames of the vector from pelvis to thorax, mm; 0 without any."""
    if not {"pelvis", "thorax"} <= set(joints):
        return torch.zeros(3, dtype=torch.float64)
    ends = [joints.index("pelvis"), joints.index("thorax")]
    both = piece.has_position[:, ends].all(1)
    points = piece.points[both][:, ends].double()
    trunk = points[:, 1] - points[:, 0]
    return trunk.sum(0)


def to_z_up(up: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation that brings the world's axis nearest to ``up``, with its sign, to z.

    It is the identity for 0.
    """
    axis = int(up.abs().argmax()) if up.any() else 2
    z = torch.zeros(3, dtype=torch.float64)
    z[axis] = -1.0 if up[axis] < 0 else 1.0
    x = torch.zeros(3, dtype=torch.float64)
    x[1 if axis == 0 else 0] = 1.0
    y = torch.linalg.cross(z, x)
    return torch.stack([x, y, z])


def frustum(cameras: Cameras, depth: float) -> Float[Tensor, "V 4 3"]:
    """Return the world corners, ``depth`` mm before each camera, of an image.

    Its middle is the principal point.
    """
    centre = cameras.K[:, :2, 2]
    factors = centre.new_tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    corners = centre[:, None] * factors
    rays = homogeneous(corners) @ torch.linalg.inv(cameras.K).mT
    return (depth * rays - cameras.t[:, None]) @ cameras.R
