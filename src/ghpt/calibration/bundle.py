"""Bundle adjustment of extrinsics and points with constant intrinsics: pycolmap's (Ceres), checked
afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ghpt.calibration.normal_matrix import Linearised, linearise
from ghpt.calibration.observations import Correspondences
from ghpt.calibration.resection import PlacedRig
from ghpt.colmap import pycolmap
from ghpt.errors import check_positive


@dataclass(frozen=True)
class Adjusted:
    """A rig after bundle adjustment, and what was verified of it."""

    rig: PlacedRig
    start_cost: float
    final: Linearised
    """At the rig's state, by this project's own derivatives."""
    iterations: int
    seconds: float
    converged: bool
    """Finite, in front of every camera, cost not above the start's, and what a Newton step could
    still gain at most ``tolerance`` of the cost.
    """


@dataclass(frozen=True)
class BundleAdjustment:
    """Cauchy loss of scale ``loss_scale`` (units of noise); at most ``iterations`` steps and
    ``seconds``; ``tolerance``: see ``Adjusted.converged``.
    """

    loss_scale: float
    iterations: int
    seconds: float
    tolerance: float

    def __post_init__(self) -> None:
        check_positive(loss_scale=self.loss_scale, iterations=self.iterations, seconds=self.seconds)
        check_positive(tolerance=self.tolerance)

    def __call__(self, observed: Correspondences, rig: PlacedRig) -> Adjusted:
        """Adjust the rig's placed views and its points to their inliers. Never raises on values; a
        rig that could not be improved comes back as it was, with ``converged`` False where it is
        not at a minimum.
        """
        used = rig.inlier
        rig = replace(rig, points=torch.where(used.any(0)[:, None], rig.points, 0.0))
        start = self.state(observed, rig)
        solved, report = self._solve(observed, rig, used) if start.finite else (rig, None)
        final = self.state(observed, solved)
        if not (final.finite and final.cost <= start.cost * (1 + 1e-12)):
            solved = rig
            final = start
        converged = (
            final.finite
            and final.in_front
            and final.gain <= self.tolerance * max(final.cost, 1e-12 * int(used.sum()))
        )
        steps = 0
        seconds = 0.0
        if report is not None:
            tried = report.num_successful_steps + report.num_unsuccessful_steps
            steps = max(tried - 1, 0)  # Ceres counts the start as a successful step
            seconds = report.total_time_in_seconds
        return Adjusted(solved, start.cost, final, steps, seconds, bool(converged))

    def state(self, observed: Correspondences, rig: PlacedRig) -> Linearised:
        """Cost and derivatives of a rig as it is."""
        return linearise(observed, rig, rig.inlier, self.loss_scale)

    def _solve(
        self, observed: Correspondences, rig: PlacedRig, used: Bool[Tensor, "V N"]
    ) -> tuple[PlacedRig, Any]:
        """Return the adjusted rig and Ceres' summary, which pycolmap does not type; None where
        nothing can be adjusted.
        """
        views = torch.nonzero(rig.placed & used.any(1))[:, 0].tolist()
        chosen = np.flatnonzero(used.any(0).numpy())
        if len(views) < 2 or not len(chosen):
            return rig, None
        model = pycolmap.Reconstruction()
        config = pycolmap.BundleAdjustmentConfig()
        mask = used[:, chosen].numpy()
        slot = np.zeros(len(chosen), dtype=np.int64)
        joint = observed.joint.numpy()[chosen]
        for j in np.unique(joint):
            slot[joint == j] = np.arange((joint == j).sum())
        for v in views:
            _add_view(model, config, observed, rig, v, chosen, joint)
        ids = []
        for n, point in enumerate(rig.points.numpy()[chosen]):
            track = [
                pycolmap.TrackElement(_image(v, joint[n]), slot[n])
                for v in np.flatnonzero(mask[:, n])
            ]
            ids.append(model.add_point3D(point, pycolmap.Track(track)))
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        report: Any = pycolmap.create_default_bundle_adjuster(
            self._options(), config, model
        ).solve()
        R = rig.R.clone()
        t = rig.t.clone()
        points = rig.points.clone()
        for v in views:
            pose: Any = model.frame(v + 1).rig_from_world
            R[v] = torch.from_numpy(pose.rotation.matrix().copy())
            t[v] = torch.from_numpy(np.array(pose.translation))
        points[chosen] = torch.from_numpy(np.stack([model.point3D(i).xyz for i in ids]))
        return replace(rig, R=R, t=t, points=points), report.ceres_summary

    def _options(self) -> pycolmap.BundleAdjustmentOptions:
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_principal_point = (
            options.refine_extra_params
        ) = False
        options.refine_sensor_from_rig = False
        options.print_summary = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = self.loss_scale
        solver = options.ceres.solver_options
        solver.max_num_iterations = self.iterations
        solver.max_solver_time_in_seconds = self.seconds
        solver.num_threads = 1  # sums in one order: the same rig on any machine
        solver.function_tolerance = 1e-10
        solver.gradient_tolerance = 1e-12
        solver.parameter_tolerance = 1e-10
        options.ceres.solver_options = solver
        return options


def _image(view: int | np.integer, joint: int | np.integer) -> int:
    return int(view) * JOINTS + int(joint) + 1


JOINTS = 1000
"""More joints than any body has."""


def _add_view(
    model: pycolmap.Reconstruction,
    config: pycolmap.BundleAdjustmentConfig,
    observed: Correspondences,
    rig: PlacedRig,
    view: int,
    chosen: np.ndarray,
    joint: np.ndarray,
) -> None:
    """A view as a pycolmap rig with one pose and a camera for each joint, whose pixel is that
    joint's noise: so Ceres weighs joints, which it has no other way to do.
    """
    body = pycolmap.Rig(rig_id=view + 1)
    frame = pycolmap.Frame(frame_id=view + 1, rig_id=view + 1)
    images: list[pycolmap.Image] = []
    for j in np.unique(joint).tolist():
        own = chosen[joint == j]
        focal = 1 / float(observed.noise[view, own[0]])
        number = _image(view, j)
        camera = pycolmap.Camera(
            camera_id=number, model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0.0, 0.0]
        )
        model.add_camera(camera)
        body.add_sensor(camera.sensor_id, pycolmap.Rigid3d()) if images else body.add_ref_sensor(
            camera.sensor_id
        )
        # what is not used may be anything
        xy = (
            torch.where(rig.inlier[view, own][:, None], observed.xy[view, own], 0.0).numpy() * focal
        )
        image = pycolmap.Image(name=str(number), keypoints=xy, camera_id=number, image_id=number)
        image.frame_id = view + 1
        frame.add_data_id(image.data_id)
        images.append(image)
        config.add_image(number)
        config.set_constant_cam_intrinsics(number)
    frame.rig_from_world = pycolmap.Rigid3d(
        pycolmap.Rotation3d(rig.R[view].numpy()), rig.t[view].numpy()
    )
    model.add_rig(body)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(view + 1)
