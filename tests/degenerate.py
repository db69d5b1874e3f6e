"""Degenerate and broken geometry, case by case, with the state that triangulation must give it."""

from dataclasses import replace

import numpy as np
import torch

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.triangulation import State
from scenes import Scene, random_scene


def ones(scene):
    return torch.ones(scene.key_points.shape[:-1], dtype=torch.float64)


def cut(scene, joints):
    return replace(
        scene, points=scene.points[:, :joints], key_points=scene.key_points[:, :, :joints].clone()
    )


def turned_about(axis):
    return torch.diag(2 * torch.eye(3, dtype=torch.float64)[axis] - 1)


def use(*views):
    def case(scene, weights):
        weights[:] = 0
        weights[list(views)] = 1

    return case


def at(*path):
    """Set one number: ``at("K", 1, 0, 0, value)``."""
    name, *index, value = path

    def case(scene, weights):
        getattr(scene.cameras, name, scene.key_points)[tuple(index)] = value

    return case


def same_camera_twice(scene, weights, noise=0.0):
    use(0, 1)(scene, weights)
    for x in (scene.cameras.K, scene.cameras.R, scene.cameras.t, scene.key_points):
        x[1] = x[0]
    scene.key_points[1] += noise


def pure_rotation(scene, weights):
    use(0, 1)(scene, weights)
    angle = torch.tensor(0.1, dtype=torch.float64)
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = (
        angle.cos(),
        -angle.sin(),
        angle.sin(),
        angle.cos(),
    )
    scene.cameras.K[1] = scene.cameras.K[0]
    scene.cameras.R[1], scene.cameras.t[1] = turn @ scene.cameras.R[0], turn @ scene.cameras.t[0]
    see(scene)


def see(scene):
    scene.key_points[:] = project(scene.cameras, scene.points)[0]


def place(scene, view, centre, R=None):
    """Move a camera, by default without turning it, and let all see the points again."""
    if R is not None:
        scene.cameras.R[view] = R
    scene.cameras.t[view] = -(scene.cameras.R[view] @ centre)


def side_by_side(distance):
    """Two equal cameras, and all points so far away."""

    def case(scene, weights):
        use(0, 1)(scene, weights)
        scene.cameras.K[1] = scene.cameras.K[0]
        centre, R = scene.cameras.centre[0], scene.cameras.R[0]
        place(scene, 1, centre + 500 * R[0], R)
        if np.isinf(distance):
            scene.key_points[1] = scene.key_points[0]
        else:
            ray = scene.points - centre
            scene.points[:] = centre + ray / ray.norm(dim=-1, keepdim=True) * distance
            see(scene)

    return case


def on_the_baseline(scene, weights):
    use(0, 1, 2)(scene, weights)
    line = torch.tensor([1.0, 0.2, -0.3], dtype=torch.float64)
    scene.points[:] = scene.points[0]
    for view, position in enumerate((-4000, 3000, 5500)):
        z = -np.sign(position) * line / line.norm()
        x = torch.linalg.cross(torch.tensor([0.0, 0, 1], dtype=torch.float64), z)
        x = x / x.norm()
        R = torch.stack([x, torch.linalg.cross(z, x), z])
        place(scene, view, scene.points[0] + position * line, R)
    see(scene)


def at_a_centre(scene, weights):
    scene.points[:] = scene.cameras.centre[0]
    pixels = scene.key_points[0].clone()
    see(scene)
    scene.key_points[0] = pixels


def behind(*views):
    def case(scene, weights):
        for (
            view
        ) in views:  # turned round about its own y axis; the projection's formula does not mind
            place(scene, view, scene.cameras.centre[view], turned_about(1) @ scene.cameras.R[view])
        see(scene)

    return case


def diverging(scene, weights):
    use(0, 1)(scene, weights)
    side_by_side(4000)(scene, weights)
    scene.key_points[[0, 1]] = scene.key_points[[1, 0]]


def in_line(scene, weights):
    for view in range(4):
        centre = torch.tensor([3000.0, -2000, 500], dtype=torch.float64)
        place(scene, view, centre + view * torch.tensor([0.0, 1300, 0], dtype=torch.float64))
    aim(scene)


def in_one_plane_with_the_points(scene, weights):
    scene.points[:, 2] = 0
    for view in range(4):
        place(
            scene, view, scene.cameras.centre[view] * torch.tensor([1.0, 1, 0], dtype=torch.float64)
        )
    aim(scene)


def aim(scene):
    for view in range(4):
        centre = scene.cameras.centre[view]
        z = -centre / centre.norm()
        x = torch.linalg.cross(torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64), z)
        x = x / x.norm()
        place(scene, view, centre, torch.stack([x, torch.linalg.cross(z, x), z]))
    see(scene)


def all_at_one_point(scene, weights):
    scene.points[:] = scene.points[:1]
    see(scene)


def denormal(scene, weights):
    scene.cameras.t[1, 0] = 1e-310
    see(scene)


def nothing_at_all(scene, weights):
    for x in (scene.cameras.K, scene.cameras.R, scene.cameras.t, scene.key_points):
        x[:] = 0


def weigh(value, view=slice(None)):
    def case(scene, weights):
        weights[view] = value

    return case


S = State
DEGENERATE = {
    "no view": (use(), S.FEW_VIEWS),
    "one view": (use(2), S.FEW_VIEWS),
    "negative weights": (weigh(-1.0), S.FEW_VIEWS),
    "same camera twice": (same_camera_twice, S.PARALLEL),
    "same camera twice, other noise": (lambda s, w: same_camera_twice(s, w, 3.0), S.PARALLEL),
    "pure rotation": (pure_rotation, S.PARALLEL),
    "parallel rays": (side_by_side(np.inf), S.PARALLEL),
    "at infinity": (side_by_side(1e11), S.PARALLEL),
    "far": (side_by_side(1e7), S.OBSERVED),
    "on the baseline": (on_the_baseline, S.PARALLEL),
    "at a camera's centre": (at_a_centre, S.BEHIND),
    "behind one": (behind(0), S.BEHIND),
    "behind all": (behind(0, 1, 2, 3), S.BEHIND),
    "diverging rays": (diverging, S.BEHIND),
    "cameras in line": (in_line, S.OBSERVED),
    "all in one plane": (in_one_plane_with_the_points, S.OBSERVED),
    "all joints at one point": (all_at_one_point, S.OBSERVED),
    "denormal weights": (weigh(1e-310), S.OBSERVED),
    "huge weights": (weigh(1e300), S.OBSERVED),
    "a NaN weight": (weigh(torch.nan, 1), S.BAD_INPUT),
    "an infinite weight": (weigh(torch.inf, 1), S.BAD_INPUT),
    "a huge pixel": (at("key_points", 1, slice(None), 0, 1e200), S.BAD_INPUT),
    "a NaN pixel": (at("key_points", 1, slice(None), 1, torch.nan), S.BAD_INPUT),
    "a denormal t": (denormal, S.OBSERVED),
    "a NaN in K": (at("K", 1, 1, 1, torch.nan), S.BAD_INPUT),
    "an inf in R": (at("R", 1, 2, 0, torch.inf), S.BAD_INPUT),
    "an inf in t": (at("t", 1, 2, -torch.inf), S.BAD_INPUT),
    "a huge t": (at("t", 1, 2, 1e200), S.BAD_INPUT),
    "a mirrored camera": (lambda s, w: s.cameras.R[1, 0].neg_(), S.BAD_INPUT),
    "a scaled R": (lambda s, w: s.cameras.R[1].mul_(2), S.BAD_INPUT),
    "focal length 0": (at("K", 1, 0, 0, 0.0), S.BAD_INPUT),
    "negative focal length": (at("K", 1, 1, 1, -1000.0), S.BAD_INPUT),
    "transposed K": (
        lambda s, w: s.cameras.K[1].copy_(s.cameras.K[1].mT.clone()),
        S.BAD_INPUT,
    ),
    "all zero": (nothing_at_all, S.BAD_INPUT),
}
ONE_BAD_VIEW = {name for name, (_, status) in DEGENERATE.items() if status == S.BAD_INPUT} - {
    "all zero"
}


def degenerate(name, seed=0):
    """One frame of 4 views and 3 joints with the case in it: cameras, key points and weights."""
    scene = cut(random_scene(seed, 1, 4), 3)
    scene = Scene(scene.cameras.index(0), scene.points[0].clone(), scene.key_points[0])
    weights = torch.ones(4, 3, dtype=torch.float64)
    DEGENERATE[name][0](scene, weights)
    return scene, weights


def put(large, weights, at, scene, own):
    """A copy of the batch with the frame in it."""

    def into(x, y):
        return torch.cat((x[:at], y[None], x[at + 1 :]))

    cameras = Cameras(
        *(into(getattr(large.cameras, f), getattr(scene.cameras, f)) for f in ("K", "R", "t"))
    )
    mixed = Scene(
        cameras, into(large.points, scene.points), into(large.key_points, scene.key_points)
    )
    return mixed, into(weights, own)
