"""Figures that stay blank: to draw them is most of what a small test costs."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure

from ghpt.commands import cameras
from ghpt.commands.prediction import page
from ghpt.report import pair_tensorboard, rig_files, tensorboard

FIGURES = (
    (tensorboard, "skeletons"),
    (tensorboard, "pose_prior_bars"),
    (pair_tensorboard, "rig_figure"),
    (rig_files, "rig_figure"),
    (page, "rig_figure"),
    (page, "course_figure"),
    (cameras, "rig_figure"),
)


@contextmanager
def blank_figures() -> Iterator[None]:
    """Within the block TensorBoard's figures, and those of rigs, have nothing on them."""
    image = np.zeros((8, 8, 3), np.uint8)
    with ExitStack() as stack:
        for module in (tensorboard, pair_tensorboard):
            stack.enter_context(patch.object(module, "image", lambda figure: image))
        for module, name in FIGURES:
            stack.enter_context(patch.object(module, name, lambda *args: Figure((1, 1))))
        yield
