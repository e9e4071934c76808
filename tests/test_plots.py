import numpy as np
import pytest
from matplotlib.image import imread

from experiments.plots import COLOURS, draw_curves
from experiments.records import EVALUATION_COLUMNS


def table_of(curves, coefs, q_std=1.0):
    """Columns of an evaluations.csv: `curves` [members, evaluations], a coefficient per member."""
    curves = np.asarray(curves, float)
    members, evaluations = curves.shape
    table = {name: np.zeros(members * evaluations) for name in EVALUATION_COLUMNS}
    table["member"] = np.repeat(np.arange(members, dtype=float), evaluations)
    table["seed"] = table["member"]
    table["penalty_coef"] = np.repeat(np.asarray(coefs, float), evaluations)
    table["env_steps"] = np.tile(np.arange(evaluations) * 1000.0, members)
    table["return_mean"] = curves.ravel()
    table["q_std"] = np.full(members * evaluations, q_std)
    return table


def pixels_of(image, colour):
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return int((np.abs(image[..., :3] - rgb).max(axis=-1) < 0.02).sum())


def test_each_group_is_drawn_in_its_own_colour(tmp_path):
    draw_curves(table_of([[0, 1, 2], [1, 2, 3], [5, 4, 3]], [0.1, 0.1, 0.5]), tmp_path / "curves.png", "td3 on ant")
    image = imread(tmp_path / "curves.png")
    assert image.shape[1] > 1000
    assert pixels_of(image, COLOURS[0]) > 500 and pixels_of(image, COLOURS[1]) > 500
    assert pixels_of(image, COLOURS[2]) == 0


@pytest.mark.parametrize("curves", [[[1.0]], [[1.0, np.nan, 2.0], [2.0, 3.0, np.nan]], [[np.nan, np.nan]]])
def test_short_and_broken_curves_are_drawn_without_complaint(tmp_path, curves, recwarn):
    draw_curves(table_of(curves, [0.5] * len(curves), q_std=np.nan), tmp_path / "curves.png", "td3 on ant")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    assert not recwarn.list


def test_a_member_that_is_an_evaluation_short_is_drawn(tmp_path):
    table = table_of([[0, 1, 2], [1, 2, 3]], [0.1, 0.1])
    draw_curves({name: column[:-1] for name, column in table.items()}, tmp_path / "curves.png", "td3 on ant")
    assert pixels_of(imread(tmp_path / "curves.png"), COLOURS[0]) > 500
