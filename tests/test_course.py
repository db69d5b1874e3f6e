"""The course of a recording in the columns of a picture."""

import numpy as np
import torch

from ghpt.reconstruction import State, select_frames
from ghpt.report.course import sample_course
from ghpt.report.course_figure import ViewCourse, check_figure, course_figure
from ghpt.report.drawing import draw
from reconstructions import random_reconstruction


def course_of(made, bones=((0, 1),)):
    rows = torch.arange(len(made))
    parts = [select_frames(made, part) for part in rows.split(300)]
    return sample_course(iter(parts), len(made), bones)


def test_no_missing_frame_is_lost_in_a_column():
    made = random_reconstruction(2000, missing=0.0)
    made.state[:] = State.OBSERVED
    made.state[1234, 5] = State.REJECTED
    course = course_of(made)
    assert course.state.shape == (400, 17)
    assert torch.nonzero(course.state == State.REJECTED).tolist() == [[1234 // 5, 5]]
    assert course.frame.tolist() == list(range(0, 2000, 5))


def test_lengths_and_middles_are_means_of_what_is_there():
    made = random_reconstruction(4, missing=0.4)
    course = course_of(made)
    there = made.has_position
    for t in range(4):
        length = (made.points[t, 0] - made.points[t, 1]).norm() if there[t, :2].all() else np.nan
        middle = made.points[t][there[t]].mean(0)
        np.testing.assert_allclose(course.length[t].numpy(), [length])
        np.testing.assert_allclose(course.middle[t].numpy(), middle.numpy())


def test_the_figure_of_a_single_frame_and_of_unmeasured_views_is_drawn():
    made = random_reconstruction(1)
    views = ViewCourse(("$a$", "b"), np.zeros(1), np.full((1, 2), np.nan))
    figure = course_figure(views, course_of(made, ()), made_joints(17), None)
    assert draw(figure, "svg").startswith(b"<?xml")
    assert [axes.get_xlim() for axes in figure.axes] == [(0, 1), (0, 1)]


def test_the_views_of_a_camera_check_are_compared_in_the_colours_of_the_first():
    given = np.full((10, 2), 3.0)
    given[5:, 1] = 40.0
    views = {
        name: ViewCourse(("a", "b"), np.arange(10.0), error)
        for name, error in {"given": given, "mended": np.minimum(given, 3.0)}.items()
    }
    figure = check_figure(views, made_joints(3), np.zeros((10, 3), np.int8), 50.0)
    images = [axes.images[0] for axes in figure.axes[:3]]
    assert [image.get_clim() for image in images[:2]] == [(0, 40), (0, 40)]
    np.testing.assert_array_equal(images[0].get_array()[1], given[:, 1])
    assert images[2].get_extent()[:2] == [0, 0.2]


def test_frames_that_are_not_evenly_spread_leave_a_gap_only_where_nobody_is():
    frame = np.concatenate([np.linspace(0, 99, 64).round(), np.linspace(300, 399, 64).round()])
    views = ViewCourse(("a",), frame, np.ones((128, 1)))
    figure = check_figure({"given": views}, made_joints(2), np.zeros((128, 2), np.int8), None)
    shown = np.isfinite(figure.axes[0].images[0].get_array().filled(np.nan)[0])
    gap = np.flatnonzero(~shown)
    assert len(gap) == len(shown) // 2
    assert np.all(np.diff(gap) == 1)


def made_joints(count):
    return tuple(f"joint_{number}" for number in range(count))
