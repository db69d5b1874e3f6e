"""poses.rrd: a recording for the Rerun viewer: cameras, rays, key points and reprojections, joints,
hypotheses.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.errors import GhptConfigError
from ghpt.export.scene import Evidence, Scene, bones_of, origin_note, side_of, title
from ghpt.export.stream import Chunks, extent, part, points_of_origin
from ghpt.files import atomic_write
from ghpt.geometry.cameras import Cameras, project
from ghpt.reconstruction import About, Reconstruction, State

_PIECE = 500
"""Frames that are handed over at once: each has a ray for every view of every joint."""
_COLOUR = {"left": 0x0072B2FF, "right": 0xD55E00FF, "middle": 0x333333FF}
_PALE = 0x00000080
"""Taken off a colour where a joint is filled: half transparent."""
_GREY = 0x99999966


def write_rerun(path: Path, about: About, chunks: Chunks, scene: Scene | None = None) -> None:
    """Timelines ``frame`` and, with a known rate, ``time``; mm. Missing joints are absent, filled
    ones pale.

    ``scene`` adds cameras and rays, and with evidence key points, reprojections and hypotheses. The
    viewer has float32, so all is relative to ``about.origin``, which the recording's name tells.

    Raises GhptConfigError without the package.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise GhptConfigError(
            "rerun", "needs rerun-sdk", "pip install 'ghpt[viz]', or leave rerun out"
        ) from error
    extent(path, about, chunks)
    if scene is not None:
        origin = torch.tensor(about.origin, dtype=torch.float64)
        scene = replace(scene, cameras=scene.cameras.relative_to(origin))
    evidence = (
        scene.evidence() if scene is not None and scene.evidence is not None else repeat(None)
    )
    with atomic_write(path) as handle:
        recording = rr.RecordingStream("ghpt")
        recording.save(handle.name)
        recording.send_recording_name(" · ".join(filter(None, (title(about), origin_note(about)))))
        if scene is not None:
            _log_cameras(rr, recording, about, scene.cameras)
        for chunk, made_of in zip(chunks(), evidence, strict=False):
            for start in range(0, len(chunk), _PIECE):
                stop = start + _PIECE
                there = (
                    None
                    if made_of is None
                    else Evidence(*(None if x is None else x[start:stop] for x in made_of))
                )
                piece = part(chunk, start, stop)
                near = replace(piece, points=points_of_origin(about, piece))
                _Piece(rr, recording, about, near).log(scene, there)
        recording.flush()
        recording.disconnect()


def _log_cameras(rr: Any, recording: Any, about: About, cameras: Cameras) -> None:
    views = zip(about.camera_names, cameras.K, cameras.R, cameras.centre, strict=True)
    for name, K, R, centre in views:
        pose = rr.Transform3D(translation=centre.tolist(), mat3x3=R.T.numpy())
        lens = rr.Pinhole(
            image_from_camera=K.numpy(),
            resolution=(2 * K[:2, 2]).tolist(),
            image_plane_distance=300.0,
        )
        recording.log(_camera(rr, name), pose, static=True)
        recording.log(f"{_camera(rr, name)}/image", lens, static=True)


def _camera(rr: Any, name: str) -> str:
    return f"world/cameras/{rr.escape_entity_path_part(name)}"


class _Piece:
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
        rr = self.rr
        piece = self.piece
        self._points(
            rr.Points3D, "world/joints", piece.points, piece.has_position, self.colours, 15.0
        )
        bones = torch.tensor(bones_of(self.about.joints), dtype=torch.long).reshape(-1, 2)
        strips = piece.points[:, bones]
        there = piece.has_position[:, bones].all(-1)
        colours = torch.minimum(self.colours[:, bones[:, 0]], self.colours[:, bones[:, 1]])
        self._strips("world/bones", strips, there, colours, 6.0)
        observed = piece.state == State.OBSERVED
        error = torch.where(observed, piece.error, 0.0).sum(1) / observed.sum(1)
        self._send("error_px", rr.Scalars.columns(scalars=error.double().numpy()))
        if scene is not None:
            self._views(scene.cameras, evidence)
        if evidence is not None and evidence.hypotheses is not None:
            pool = evidence.hypotheses.flatten(1, 2)
            pool = pool.double() - torch.tensor(self.about.origin, dtype=torch.float64)
            self._points(
                rr.Points3D,
                "world/hypotheses",
                pool,
                pool.isfinite().all(-1),
                pool[..., 0] * 0 + _GREY,
                4.0,
            )

    def _views(self, cameras: Cameras, evidence: Evidence | None) -> None:
        rr = self.rr
        piece = self.piece
        double = cameras.to(torch.float64)
        pixels, depth = project(double, piece.points.double())
        for v, name in enumerate(self.about.camera_names):
            used = piece.views[:, v] & (piece.state == State.OBSERVED)
            start = double.centre[v].expand_as(piece.points)
            rays = torch.stack([start, piece.points.double()], dim=-2)
            colour = torch.full_like(piece.state, 0, dtype=torch.long) + _GREY
            self._strips(f"world/rays/{rr.escape_entity_path_part(name)}", rays, used, colour, 1.0)
            image = f"{_camera(rr, name)}/image"
            shown = piece.has_position & (depth[:, v] > 0)
            self._points(
                rr.Points2D, f"{image}/reprojected", pixels[:, v], shown, self.colours, 3.0
            )
            if evidence is not None:
                valid = evidence.valid[:, v]
                self._points(
                    rr.Points2D,
                    f"{image}/key_points",
                    evidence.key_points[:, v],
                    valid,
                    colour,
                    5.0,
                )

    def _points(
        self,
        kind: Any,
        path: str,
        points: torch.Tensor,
        there: torch.Tensor,
        colours: torch.Tensor,
        radius: float,
    ) -> None:
        values = {
            "positions": points[there].float().numpy(),
            "colors": colours[there].numpy().astype(np.uint32),
        }
        values["radii"] = np.full(len(values["positions"]), radius, np.float32)
        self._send(path, kind.columns(**values).partition(there.sum(1).numpy()))

    def _strips(
        self,
        path: str,
        strips: torch.Tensor,
        there: torch.Tensor,
        colours: torch.Tensor,
        radius: float,
    ) -> None:
        values = {
            "strips": strips[there].float().numpy(),
            "colors": colours[there].numpy().astype(np.uint32),
        }
        values["radii"] = np.full(len(values["strips"]), radius, np.float32)
        self._send(path, self.rr.LineStrips3D.columns(**values).partition(there.sum(1).numpy()))

    def _send(self, path: str, columns: Any) -> None:
        self.rr.send_columns(path, indexes=self.times, columns=columns, recording=self.recording)
