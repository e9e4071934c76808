"""Figures show the numbers of the runs: curves, bands, sweeps, profiles."""

import numpy as np
import pytest
from figure_reader import legend_of, panels, pixels_of
from made_runs import write_run
from matplotlib.image import imread

from experiments.evidence import figures
from experiments.evidence.cells import NOT_RESAMPLED
from experiments.evidence.figure_style import ALGORITHM_COLOURS, COLOURS
from experiments.evidence.figures import draw_curves, over_time
from experiments.evidence.penalty_figure import penalty_sweep
from experiments.evidence.pooling import collect
from experiments.running.records import EVALUATION_COLUMNS

NAN = float("nan")


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


def lines_of(axes, colour):
    return [line.get_xydata() for line in axes.lines if line.get_color() == colour]


def test_each_group_is_drawn_in_its_own_colour(tmp_path):
    draw_curves(table_of([[0, 1, 2], [1, 2, 3], [5, 4, 3]], [0.1, 0.1, 0.5]), tmp_path / "curves.png", "td3 on ant")
    image = imread(tmp_path / "curves.png")
    assert image.shape[1] > 1000
    assert pixels_of(image, COLOURS[0]) > 500 and pixels_of(image, COLOURS[1]) > 500
    assert pixels_of(image, COLOURS[2]) == 0


def test_a_dollar_sign_in_a_name_starts_no_formula(tmp_path):
    draw_curves(table_of([[0, 1]], [0.5]), tmp_path / "curves.png", r"td3 on $\frac$")
    assert (tmp_path / "curves.png").exists()


@pytest.mark.parametrize("curves", [[[1.0]], [[1.0, NAN, 2.0], [2.0, 3.0, NAN]], [[NAN, NAN]]])
def test_short_and_broken_curves_are_drawn_without_complaint(tmp_path, curves, recwarn):
    draw_curves(table_of(curves, [0.5] * len(curves), q_std=NAN), tmp_path / "curves.png", "td3 on ant")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    assert not recwarn.list


def test_a_member_that_lacks_an_evaluation_is_drawn(tmp_path):
    table = table_of([[0, 1, 2], [1, 2, 3]], [0.1, 0.1])
    draw_curves({name: column[:-1] for name, column in table.items()}, tmp_path / "curves.png", "td3 on ant")
    assert pixels_of(imread(tmp_path / "curves.png"), COLOURS[0]) > 500


@pytest.mark.parametrize(("statistic", "middle"), [("iqm", [0, 2, 4]), ("mean", [0, 4, 4.4])])
def test_a_curve_is_the_statistic_at_each_evaluation_and_its_band_the_interval(tmp_path, statistic, middle):
    write_run(tmp_path, curves=[[0, 1, 2], [0, 1, 3], [0, 2, 4], [0, 3, 5], [0, 13, 8]])
    figure = over_time(collect([str(tmp_path)]), "return_mean", statistic)
    (axes,) = panels(figure)
    (line,) = lines_of(axes, ALGORITHM_COLOURS["td3"])
    np.testing.assert_allclose(line, np.transpose([[0, 50, 100], middle]))
    (band,) = axes.collections
    edges = band.get_paths()[0].vertices
    assert edges[:, 1].min() == 0 and 5 <= edges[:, 1].max() <= 13
    assert axes.get_title() == "cheetah" and legend_of(figure) == ["td3"]
    assert {"iqm": "interquartile mean", "mean": "mean"}[statistic] in figure.get_suptitle()


def test_a_single_seed_has_no_band_and_a_diverged_one_ends_the_line(tmp_path):
    write_run(tmp_path / "a", "td3")
    write_run(tmp_path / "b", "sac", curves=[[0, 1, 2], [0, 1, NAN]])
    figure = over_time(collect([str(tmp_path)]), "return_mean", "iqm")
    (axes,) = panels(figure)
    assert len(axes.collections) == 1  # SAC's
    (line,) = lines_of(axes, ALGORITHM_COLOURS["sac"])
    assert line[:, 0].tolist() == [0, 50]
    assert legend_of(figure) == ["td3", "sac *"]
    assert "* sac on cheetah: seed 1 diverged after step 50" in figure.get_supxlabel()


def test_a_quantity_that_was_not_measured_has_no_figure(tmp_path):
    write_run(tmp_path / "a", "td3", more={"value_bias": [[NAN, 2, 3]]})
    write_run(tmp_path / "b", "sac")
    runs = collect([str(tmp_path)])
    assert legend_of(over_time(runs, "value_bias", "iqm")) == ["td3"]
    assert over_time(runs, "value_bias_normalised", "iqm") is None
    assert penalty_sweep(runs, "iqm") is None


def test_a_sweep_has_a_dot_per_seed_and_its_baseline_at_0(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 0, 5], [0, 0, 7]])
    curves = [[0, 0, value] for value in (1, 3, 2, 4)]
    write_run(tmp_path, "td3_sqt", curves=curves, swept={"penalty_coef": (0.25, 0.5)})
    figure = penalty_sweep(collect([str(tmp_path)]), "mean")
    (axes,) = panels(figure)
    assert [scatter.get_offsets()[:, 1].tolist() for scatter in axes.collections] == [[5, 7], [1, 3], [2, 4]]
    (line,) = [line for line in lines_of(axes, ALGORITHM_COLOURS["td3_sqt"]) if len(line) == 3]
    np.testing.assert_allclose(line, [[0, 6], [1, 2], [2, 3]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "0.25", "0.5"]
    assert NOT_RESAMPLED in figure.get_suptitle().replace("\n", " ")
    assert legend_of(figure) == ["td3", "td3_sqt"]


def test_sweeps_of_one_baseline_draw_it_once(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 0, 5]])
    for algo in ("td3_sqt", "td3_sqt_tuple"):
        write_run(tmp_path, algo, curves=[[0, 0, 1], [0, 0, 2]], swept={"penalty_coef": (0.25, 0.5)})
    (axes,) = panels(penalty_sweep(collect([str(tmp_path)]), "mean"))
    assert sum(scatter.get_offsets()[:, 1].tolist() == [5] for scatter in axes.collections) == 1
    assert len(axes.collections) == 5


@pytest.mark.parametrize("other", [{"steps": 200}, {"tau": 0.1}])
def test_runs_that_differ_in_more_than_the_coefficient_are_no_sweep(tmp_path, other):
    write_run(tmp_path / "a", "td3_sqt", penalty_coef=0.1)
    write_run(tmp_path / "b", "td3_sqt", penalty_coef=0.5, **other)
    assert penalty_sweep(collect([str(tmp_path)]), "mean") is None


def test_profile_by_hand(tmp_path):
    # Against the best mean, 10: half of td3's seeds are above 0.5, and half of sac's above 1.
    write_run(tmp_path, "td3", curves=[[0, 0, 4], [0, 0, 8]])
    write_run(tmp_path, "sac", curves=[[0, 0, 5], [0, 0, 15]])
    write_run(tmp_path, "td7", curves=[[NAN, NAN, NAN]])
    figure = figures.performance_profile(collect([str(tmp_path)]))
    (axes,) = panels(figure)
    for algo, steps in {"td3": [(0.39, 1), (0.5, 0.5), (0.81, 0)], "sac": [(0.45, 1), (1, 0.5), (1.51, 0)]}.items():
        (line,) = lines_of(axes, ALGORITHM_COLOURS[algo])
        for threshold, share in steps:
            assert line[np.argmin(np.abs(line[:, 0] - threshold)), 1] == share
    assert legend_of(figure) == ["td3", "sac"]
    assert "left out: td7, which has no score on cheetah" in figure.get_supxlabel()
    assert NOT_RESAMPLED in figure.get_suptitle().replace("\n", " ")


def test_a_profile_has_a_band_only_where_all_its_tasks_have_several_seeds(tmp_path):
    write_run(tmp_path, "td3", "cheetah", curves=[[0, 0, 4], [0, 0, 8]])
    write_run(tmp_path, "td3", "ant", curves=[[0, 0, 4]])
    (axes,) = panels(figures.performance_profile(collect([str(tmp_path)])))
    assert not axes.collections
    write_run(tmp_path / "more", "td3", "ant", curves=[[0, 0, 5]], seeds=[7])
    (axes,) = panels(figures.performance_profile(collect([str(tmp_path)])))
    assert len(axes.collections) == 1


def test_a_profile_without_scores(tmp_path):
    write_run(tmp_path, curves=[[-3, -2, -1]])
    assert figures.performance_profile(collect([str(tmp_path)])) is None


@pytest.mark.parametrize(("kind", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_images(tmp_path, kind, start):
    write_run(tmp_path)
    figure = over_time(collect([str(tmp_path)]), "q_std", "iqm")
    assert figures.image(figure, kind).startswith(start)


def test_every_figure_is_drawn_and_no_text_is_read_as_a_formula(tmp_path):
    write_run(tmp_path / "a", "td3", curves=[[0, 1, 2]], seeds=[0])
    write_run(tmp_path / "b", "td3", curves=[[0, 1, 3]], seeds=[1], versions={"jax": r"$\frac{"})
    draw = figures.all_figures(collect([str(tmp_path)]), "iqm")
    drawn = {name: function() for name, function in draw.items()}
    assert {name for name, figure in drawn.items() if figure} == {"learning_curves", "q_std", "performance_profile"}
    assert drawn["penalty_sweep"] is None and drawn["value_bias"] is None
    curves = drawn["learning_curves"]
    assert r"jax 0.10.2, $\frac{" in " ".join(text.get_text() for text in curves.texts if text.get_text())
    assert figures.image(curves, "svg") == figures.image(draw["learning_curves"](), "svg")
