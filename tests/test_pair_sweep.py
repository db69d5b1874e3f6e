import numpy as np
import pytest

from ghpt.report.figures import image
from ghpt.report.sweep import CLIP, frames_sweep, sweep_table


def test_sweep_shows_means_bands_and_the_cut():
    results = {
        "weight": {m: [10.0, 12.0, 14.0] for m in (10, 20, 40)},
        "eight_point": {10: [70.0, 90.0, 200.0], 20: [20.0, 30.0, 40.0], 40: [np.inf, 1.0, 1.0]},
    }
    figure = frames_sweep(results, "pair (2, 3) on synthetic Human3.6M")
    (axes,) = figure.axes
    weight, eight = axes.lines
    np.testing.assert_allclose(weight.get_ydata(), 12)
    np.testing.assert_allclose(eight.get_ydata(), [CLIP, 30, CLIP])
    band = axes.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == pytest.approx((10, 14))
    assert axes.collections[1].get_paths()[0].vertices[:, 1].max() <= CLIP
    assert "synthetic" in axes.get_title()
    assert (
        len({(line.get_linestyle(), line.get_marker()) for line in axes.lines}) == 2
    )  # told apart without colour
    assert image(figure).std() > 10


def test_sweep_table_has_mean_deviation_and_median():
    eight_point = {10: [np.inf, 1.0, 3.0], 20: [2.0]}
    table = sweep_table({"weight": {10: [10.0, 12.0, 17.0]}, "eight_point": eight_point})
    assert table.header == ["M", "weight", "8-point"]
    assert table.rows == [
        ["10", "13.0 ± 3.6 (12.0)", "– ± – (3.0)"],
        ["20", "–", "2.0 ± 0.0 (2.0)"],
    ]
