from figure_reader import pixels_of
from made_curves import curves
from matplotlib.image import imread

from experiments.theorem.tabular_figure import STYLES, draw


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
