"""poses.rrd: a recording for the Rerun viewer: cameras, rays, key points, joints, hypotheses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ghpt.errors import GhptConfigError
from ghpt.export.scene import (
    Evidence,
    Scene,
    bones_of,
    origin_note,
    side_of,
    title,
    to_z_up,
    upward,
)
from ghpt.export.stream import Chunks, extent, local_points, part
from ghpt.files import atomic_write
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.masking import finite_vectors
from ghpt.reconstruction import About, Reconstruction, State

_PIECE = 500
"""Frames that are handed over at once: each has a ray for every view of every joint."""
_COLOUR = {"left": 0x0072B2FF, "right": 0xD55E00FF, "middle": 0x333333FF}
_PALE = 0x00000080
"""Taken off a colour where a joint is filled: half transparent."""
_GREY = 0x99999966
_WORLD = "world"
_RAYS = "world/rays"
_HYPOTHESES = "world/hypotheses"
_ERROR = "error_px"
_SHARES = (3, 2)
"""Of the window's width: the 3D view, and the images beside it."""
_VIEW_COLUMNS = 2


def write_rerun(path: Path, about: About, chunks: Chunks, scene: Scene | None = None) -> None:
    """Write timelines ``frame`` and, with a known rate, ``time``; mm.

    Missing joints are absent, filled ones pale. ``scene`` adds cameras and rays, and with evidence
    key points, reprojections and hypotheses. The viewer has float32, so all is relative to
    ``about.origin``, which the recording's name tells. The viewer opens with the 3D view beside the
    cameras' images, and the error below; rays and hypotheses are hidden until they are asked for.

    Raises GhptConfigError without the package.
    """
    try:
        import rerun as rr
        import rerun.blueprint as rrb
    except ImportError as error:
        hint = "Install it (pip install rerun-sdk), or leave rerun out."
        raise GhptConfigError("rerun", "needs rerun-sdk", hint) from error
    extent(path, about, chunks)
    if scene is not None:
        origin = torch.tensor(about.origin, dtype=torch.float64)
        scene = replace(scene, cameras=scene.cameras.relative_to(origin))
    names = [title(about), f"mm, axes: {about.world}", origin_note(about)]
    with atomic_write(path) as handle:
        recording = rr.RecordingStream("ghpt")
        recording.save(handle.name)
        recording.send_recording_name(" · ".join(filter(None, names)))
        if scene is not None:
            _log_cameras(rr, recording, about, scene.cameras)
        recording.send_blueprint(_layout(rr, rrb, about, scene))
        up = torch.zeros(3, dtype=torch.float64)
        for chunk, evidence in zip(chunks(), _evidence(scene), strict=False):
            for start in range(0, len(chunk), _PIECE):
                stop = start + _PIECE
                piece = part(chunk, start, stop)
                piece = replace(piece, points=local_points(about, piece))
                own = None if evidence is None else evidence.part(start, stop)
                _PieceLog(rr, recording, about, piece).log(scene, own)
                up = up + upward(about.joints, piece)
        recording.log(_WORLD, _up_axis(rr, up), static=True)
        recording.flush()
        recording.disconnect()


def _layout(rr: Any, rrb: Any, about: About, scene: Scene | None) -> Any:
    """Return the layout of the viewer: as the page's, 3D on the left and the images beside it."""
    hidden = rrb.EntityBehavior(visible=False)
    overrides = {_RAYS: hidden, _HYPOTHESES: hidden}
    space = rrb.Spatial3DView(origin=_WORLD, name="3D", overrides=overrides)
    images = []
    if scene is not None:
        for name in about.camera_names:
            images.append(rrb.Spatial2DView(origin=_image_path(rr, name), name=name))
    top = space
    if images:
        grid = rrb.Grid(*images, grid_columns=_VIEW_COLUMNS, name="views")
        top = rrb.Horizontal(space, grid, column_shares=_SHARES)
    error = rrb.TimeSeriesView(origin=_ERROR, name="mean reprojection error, px")
    timeline = rrb.TimePanel(state="collapsed", timeline="time" if about.rate_hz else "frame")
    panels = (rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    whole = rrb.Vertical(top, error, row_shares=(5, 1))
    return rrb.Blueprint(whole, *panels, timeline, auto_views=False)


def _up_axis(rr: Any, up: Tensor) -> Any:
    """Return the viewer's name of the world's axis nearest to ``up``."""
    z = to_z_up(up)[2]
    axis = int(z.abs().argmax())
    direction = "DOWN" if z[axis] < 0 else "UP"
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{direction}")


def _evidence(scene: Scene | None) -> Iterator[Evidence | None]:
    """Return the evidence of each chunk, None where there is none."""
    if scene is None or scene.evidence is None:
        return repeat(None)
    return scene.evidence()


def _log_cameras(rr: Any, recording: Any, about: About, cameras: Cameras) -> None:
    views = zip(about.camera_names, cameras.K, cameras.R, cameras.centre, strict=True)
    for name, K, R, centre in views:
        pose = rr.Transform3D(translation=centre.tolist(), mat3x3=R.T.numpy())
        image_size = 2 * K[:2, 2]
        lens = rr.Pinhole(
            image_from_camera=K.numpy(),
            resolution=image_size.tolist(),
            image_plane_distance=300.0,
        )
        recording.log(_camera_path(rr, name), pose, static=True)
        recording.log(_image_path(rr, name), lens, static=True)


def _camera_path(rr: Any, name: str) -> str:
    return f"world/cameras/{rr.escape_entity_path_part(name)}"


def _image_path(rr: Any, name: str) -> str:
    return f"{_camera_path(rr, name)}/image"


class _PieceLog:
    """Logs some frames."""

    def __init__(self, rr: Any, recording: Any, about: About, piece: Reconstruction) -> None:
        self.rr = rr
        self.recording = recording
        self.about = about
        self.piece = piece
        frame = piece.frame.numpy()
        self.times = [rr.TimeColumn("frame", sequence=frame)]
        if about.rate_hz:
            self.times.append(rr.TimeColumn("time", duration=frame / about.rate_hz))
        colours = torch.tensor([_COLOUR[side_of(joint)] for joint in about.joints])
        self.colours = torch.where(piece.state == State.FILLED, colours - _PALE, colours)

    def log(self, scene: Scene | None, evidence: Evidence | None) -> None:
        piece = self.piece
        joints = self.rr.Points3D
        self._points(joints, "world/joints", piece.points, piece.has_position, self.colours, 15.0)
        self._bones()
        self._errors()
        if scene is not None:
            self._views(scene.cameras, evidence)
        if evidence is not None and evidence.hypotheses is not None:
            self._hypotheses(evidence.hypotheses)

    def _bones(self) -> None:
        piece = self.piece
        bones = torch.tensor(bones_of(self.about), dtype=torch.long).reshape(-1, 2)
        start, end = bones.unbind(-1)
        strips = piece.points[:, bones]
        present = piece.has_position[:, bones].all(-1)
        colours = torch.minimum(self.colours[:, start], self.colours[:, end])
        self._strips("world/bones", strips, present, colours, 6.0)

    def _errors(self) -> None:
        observed = self.piece.is_measured
        total = torch.where(observed, self.piece.error, 0.0).sum(1)
        mean = total / observed.sum(1)
        self._send(_ERROR, self.rr.Scalars.columns(scalars=mean.double().numpy()))

    def _hypotheses(self, hypotheses: Tensor) -> None:
        origin = torch.tensor(self.about.origin, dtype=torch.float64)
        pool = hypotheses.flatten(1, 2).double() - origin
        finite = finite_vectors(pool)
        colours = torch.full_like(pool[..., 0], _GREY)
        self._points(self.rr.Points3D, _HYPOTHESES, pool, finite, colours, 4.0)

    def _views(self, cameras: Cameras, evidence: Evidence | None) -> None:
        rr = self.rr
        piece = self.piece
        points = piece.points.double()
        double = cameras.to(torch.float64)
        pixels, depth = project(double, points)
        observed = piece.is_measured
        grey = torch.full_like(piece.state, _GREY, dtype=torch.long)
        for v, name in enumerate(self.about.camera_names):
            centre = double.centre[v].expand_as(points)
            rays = torch.stack([centre, points], dim=-2)
            path = f"{_RAYS}/{rr.escape_entity_path_part(name)}"
            self._strips(path, rays, piece.views[:, v] & observed, grey, 1.0)
            image = _image_path(rr, name)
            visible = piece.has_position & (depth[:, v] > 0)
            path = f"{image}/reprojected"
            self._points(rr.Points2D, path, pixels[:, v], visible, self.colours, 3.0)
            if evidence is not None:
                key_points = evidence.key_points[:, v]
                valid = evidence.valid[:, v]
                colours = torch.full_like(valid, _GREY, dtype=torch.long)
                self._points(rr.Points2D, f"{image}/key_points", key_points, valid, colours, 5.0)

    def _points(
        self,
        kind: Any,
        path: str,
        points: Tensor,
        present: Tensor,
        colours: Tensor,
        radius: float,
    ) -> None:
        positions = points[present].float().numpy()
        columns = kind.columns(
            positions=positions,
            colors=colours[present].numpy().astype(np.uint32),
            radii=np.full(len(positions), radius, np.float32),
        )
        self._send(path, columns.partition(present.sum(1).numpy()))

    def _strips(
        self,
        path: str,
        strips: Tensor,
        present: Tensor,
        colours: Tensor,
        radius: float,
    ) -> None:
        lines = strips[present].float().numpy()
        columns = self.rr.LineStrips3D.columns(
            strips=lines,
            colors=colours[present].numpy().astype(np.uint32),
            radii=np.full(len(lines), radius, np.float32),
        )
        self._send(path, columns.partition(present.sum(1).numpy()))

    def _send(self, path: str, columns: Any) -> None:
        self.rr.send_columns(path, indexes=self.times, columns=columns, recording=self.recording)
