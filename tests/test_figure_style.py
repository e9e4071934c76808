"""Colours, lines and panels of figures."""

import io

import matplotlib
import numpy as np
from figure_reader import legend_of, panels
from made_runs import write_run
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from experiments.evidence.figure_style import (
    ALGORITHM_COLOURS,
    PENALTY_LINES,
    Stars,
    add_texts,
    algorithm_style,
    in_our_style,
    make_panels,
    styles,
)
from experiments.evidence.pooling import collect
from experiments.evidence.variants import baseline_of, variant_with
from sqt_jax.algorithms import ALGORITHMS


def luminance(colour):
    return np.dot(to_rgb(colour), [0.2126, 0.7152, 0.0722])


def finished(runs):
    """A figure with nothing in its panels."""
    figure, found = make_panels(runs.rows, runs.tasks)
    add_texts(figure, found, styles(runs.rows), Stars(), "heading", "below", "beside")
    return figure


def test_every_algorithm_has_a_colour_and_a_line_of_its_own():
    assert {*ALGORITHM_COLOURS} == {*ALGORITHMS}
    assert len({str(algorithm_style(algo)) for algo in ALGORITHMS}) == len(ALGORITHMS)
    for baseline in ("td3", "sac", "td7"):  # in grey, an SQT variant is lighter than its baseline
        of_paper = [variant_with(baseline, penalty) for penalty in PENALTY_LINES]
        shades = [luminance(ALGORITHM_COLOURS[algo]) for algo in (baseline, *of_paper)]
        assert shades == sorted(shades) and np.diff(shades).min() > 0.08


def test_a_row_has_the_same_style_whatever_the_other_rows_are(tmp_path):
    write_run(tmp_path / "a", "sac_sqt")
    write_run(tmp_path / "b", "td3")
    both, one = collect([str(tmp_path)]), collect([str(tmp_path / "a")])
    style = styles(both.rows)["sac_sqt"]
    assert styles(one.rows)["sac_sqt"] == style
    assert style == (ALGORITHM_COLOURS["sac_sqt"], PENALTY_LINES["batch_std"], "")


def test_coefficients_of_an_algorithm_are_shades_with_markers(tmp_path):
    write_run(tmp_path, "td3_sqt", curves=[[0, 1]] * 3, swept={"penalty_coef": (0.1, 0.5, 1.0)})
    found = list(styles(collect([str(tmp_path)]).rows).values())
    shades = [luminance(style.colour) for style in found]
    assert shades == sorted(shades, reverse=True) and len({style.marker for style in found}) == 3


def test_few_algorithms_share_a_panel_per_task_and_many_have_one_per_baseline(tmp_path):
    algos = [algo for algo in ALGORITHMS if algo.startswith(("td3", "sac", "td7"))]
    for algo in algos:
        for env in ("cheetah", "ant"):
            write_run(tmp_path / baseline_of(algo), algo, env)
    many = finished(collect([str(tmp_path)]))
    assert len(panels(many)) == 6 and sorted(legend_of(many)) == sorted(algos)
    few = finished(collect([str(tmp_path / "td3"), str(tmp_path / "sac")]))
    assert [axes.get_title() for axes in panels(few)] == ["cheetah", "ant"] and len(legend_of(few)) == 6


def test_many_tasks_are_wrapped_into_rows(tmp_path):
    for env in ("cheetah", "walker", "ant", "humanoid", "hopper"):
        write_run(tmp_path, env=env)
    figure = finished(collect([str(tmp_path)]))
    assert [axes.get_title() for axes in panels(figure)] == ["cheetah", "walker", "ant", "humanoid", "hopper"]


def test_figures_do_not_depend_on_rc_files():
    """A notebook's or a user's settings, set after matplotlib was imported."""

    @in_our_style
    def picture():
        figure = Figure(figsize=(2, 2))
        figure.add_subplot().plot([0, 1], label="$")
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
        return stream.getvalue()

    before = picture()
    with matplotlib.rc_context({"text.usetex": True, "savefig.dpi": 7, "lines.linewidth": 9}):
        assert picture() == before
        assert matplotlib.rcParams["savefig.dpi"] == 7  # the user's own settings are as before
