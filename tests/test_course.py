"""The course of a recording in the columns of a picture."""

import numpy as np
import torch

from ghpt.reconstruction import State, select_frames
from ghpt.report.course import sample_course
from ghpt.report.course_figure import ViewCourse, course_figure
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


def made_joints(count):
    return tuple(f"joint_{number}" for number in range(count))
