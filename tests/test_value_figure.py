"""The figure of the tabular study."""

import pytest
from figure_reader import pixels_of
from made_curves import curves
from matplotlib.figure import Figure
from matplotlib.image import imread

from experiments.theorem.learning_curves import interval
from experiments.theorem.value_figure import STYLES, _draw, _style_axes, draw


def test_an_algorithm_has_its_colour_and_an_mdp_its_column(tmp_path):
    one = {("grid", "q_learning"): curves(error=(9, 8, 7)), ("grid", "maxmin"): curves(tables=2, std=(3, 2, 1))}
    draw(one, tmp_path / "one.png")
    image = imread(tmp_path / "one.png")
    assert pixels_of(image, STYLES["q_learning"][0]) > 200 and pixels_of(image, STYLES["maxmin"][0]) > 200
    assert pixels_of(image, STYLES["double_q"][0]) == 0
    draw(one | {("chain", "double_q"): curves(tables=2)}, tmp_path / "two.png")
    wider = imread(tmp_path / "two.png")
    assert pixels_of(wider, STYLES["double_q"][0]) > 200
    assert wider.shape[0] == image.shape[0] and wider.shape[1] > 1.5 * image.shape[1]


def test_a_band_is_the_interval_and_only_the_axis_cuts_it():
    axes = Figure().add_subplot()
    found = curves(error=(9.0, 3.0, 1.0))
    found.record.error_max[0] *= 8  # one seed far from the others: the interval extends below 0
    _draw(axes, "q_learning", found, "error_max")
    _style_axes(axes, "error_max")
    (band,) = axes.collections
    mean, width = interval(found.record.error_max[:, 0, 0])
    assert band.get_paths()[0].vertices[:, 1].min() == pytest.approx(mean - width) and mean < width
    assert axes.get_ylim()[0] == pytest.approx(axes.lines[0].get_ydata().min() / 1.5)
