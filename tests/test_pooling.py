"""Pooling of runs: what is one group, what is a row, which baseline belongs to a variant."""

import json

import numpy as np
import pytest
from made_runs import write_run

from experiments.commandline.arguments import UsageError
from experiments.evidence.pooling import collect, row_differences
from experiments.evidence.variants import baseline_of
from sqt_jax.algorithms import ALGORITHMS

NAN = float("nan")


def only(found):
    (group,) = found.groups
    return group


def test_seeds_of_runs_with_equal_settings_are_pooled(tmp_path):
    write_run(tmp_path / "a", curves=[[0, 1, 5], [0, 3, 1]], seeds=[4, 2])
    write_run(tmp_path / "b", curves=[[0, 2, 3]], seeds=[3])
    group = only(collect([str(tmp_path)]))
    assert group.seeds == (2, 3, 4)
    np.testing.assert_array_equal(group.values("return_mean"), [[0, 3, 1], [0, 2, 3], [0, 1, 5]])
    assert (group.score.mean, group.scored_at) == (3.0, 100)
    np.testing.assert_array_equal(group.scores, [1, 3, 5])
    assert group.notes == ()


def test_own_environments_of_one_name_and_several_sizes_are_not_pooled(tmp_path):
    for name, sizes in {"a": (1, 1), "b": (3, 2)}.items():
        write_run(tmp_path, env="point", name=name, sizes=sizes)
        write_run(tmp_path, "td3_sqt", env="point", name=name, sizes=sizes)
    write_run(tmp_path, env="point", name="c", sizes=(3, 2), seeds=[1])
    write_run(tmp_path, env="maze", sizes=(3, 2))
    found = collect([str(tmp_path)])
    assert found.tasks == ["maze", "point (obs 1, action 1)", "point (obs 3, action 2)"]
    assert [row.label for row in found.rows] == ["td3", "td3_sqt"]
    assert [(group.algo, group.env, group.seeds) for group in found.groups] == [
        ("td3", "maze", (0,)),
        ("td3", "point (obs 1, action 1)", (0,)),
        ("td3", "point (obs 3, action 2)", (0, 1)),
        ("td3_sqt", "point (obs 1, action 1)", (0,)),
        ("td3_sqt", "point (obs 3, action 2)", (0,)),
    ]
    for group in found.groups[3:]:
        assert found.baseline(group).group.env == group.env


def test_the_same_seed_twice_is_rejected(tmp_path):
    one, two = write_run(tmp_path / "a", seeds=[3]), write_run(tmp_path / "b", seeds=[3])
    with pytest.raises(UsageError) as error:
        collect([str(tmp_path)])
    message = f"{one} and {two}: both have seed 3 of td3 on cheetah with the same settings; expected only one of them"
    assert str(error.value) == message


def test_runs_that_differ_are_separate_rows_named_by_the_difference(tmp_path):
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", steps=200)
    write_run(tmp_path / "c", updates_per_step=2)
    labels = [row.label for row in collect([str(tmp_path)]).rows]
    assert labels == [
        "td3 (steps 100, updates_per_step 1)",
        "td3 (steps 100, updates_per_step 2)",
        "td3 (steps 200, updates_per_step 1)",
    ]


def test_a_replay_larger_than_the_run_is_no_difference_and_a_smaller_one_is(tmp_path):
    for name, capacity in [("a", 100), ("b", 1_000_000), ("c", 50)]:
        write_run(tmp_path / name, replay_capacity=capacity, seeds=[ord(name)])
    rows = collect([str(tmp_path)]).rows
    assert [row.label for row in rows] == ["td3 (replay_capacity 50)", "td3 (replay_capacity all)"]
    assert rows[1].groups["cheetah"].seeds == (97, 98)


def test_evaluation_on_another_physics_is_a_difference_although_both_said_auto(tmp_path):
    write_run(tmp_path / "a")
    other = write_run(tmp_path / "b")
    content = json.loads((other / "config.json").read_text()) | {"evaluated_on": "mjx"}
    (other / "config.json").write_text(json.dumps(content))
    labels = [row.label for row in collect([str(tmp_path)]).rows]
    assert labels == ["td3 (eval_physics mjx)", "td3 (eval_physics mujoco)"]


def test_a_sweep_is_a_row_per_value(tmp_path):
    curves = [[0, value, value] for value in (1, 2, 3, 4)]
    write_run(tmp_path, "td3_sqt", curves=curves, swept={"penalty_coef": (0.1, 0.5)})
    found = collect([str(tmp_path)])
    assert [row.label for row in found.rows] == ["td3_sqt (penalty_coef 0.1)", "td3_sqt (penalty_coef 0.5)"]
    assert [group.score.mean for group in found.groups] == [1.5, 3.5]


def test_a_coefficient_per_task_is_one_row(tmp_path):
    write_run(tmp_path, "td3_sqt", "cheetah", penalty_coef=0.5)
    write_run(tmp_path, "td3_sqt", "ant", penalty_coef=0.25)
    (row,) = collect([str(tmp_path)]).rows
    assert (row.label, list(row.groups)) == ("td3_sqt", ["cheetah", "ant"])
    assert row_differences(row) == {"penalty_coef": {"cheetah": 0.5, "ant": 0.25}}


def test_rows_and_tasks_have_the_order_of_their_tables(tmp_path):
    for algo, env in [("sac", "humanoid"), ("td3_sqt", "cheetah"), ("td3", "walker"), ("td3", "brax:ant")]:
        write_run(tmp_path, algo, env)
    found = collect([str(tmp_path)])
    assert [row.label for row in found.rows] == ["td3", "td3_sqt", "sac"]
    assert found.tasks == ["cheetah", "walker", "humanoid", "brax:ant"]


def test_incomplete_groups_have_notes(tmp_path):
    write_run(tmp_path / "a", curves=[[0, 1, 2], [0, 5, NAN]])
    write_run(tmp_path / "b", curves=[[0, 3]], seeds=[7], versions={"jax": "0.11.0"})
    group = only(collect([str(tmp_path)]))
    assert group.notes == (
        "seed 1 diverged after step 50: no evaluation after that counts",
        "seed 7 stopped at step 50 of 100",
        "only evaluations up to step 50 count, because not all seeds have later ones",
        "seeds from runs with different versions: jax 0.10.2, 0.11.0",
    )
    assert (group.score.mean, group.scored_at) == (3.0, 50)  # of all three seeds, at a step that all have
    np.testing.assert_array_equal(group.finals, [1, 5, 3])


def test_means_over_intervals_count_only_those_that_all_seeds_measured(tmp_path):
    bias = [[9, 1, 3], [9, 2, NAN]]
    write_run(tmp_path, curves=[[0, 1, 2], [0, 1, 2]], q_std=[0.5, 0.75], more={"value_bias": bias})
    group = only(collect([str(tmp_path)]))
    np.testing.assert_array_equal(group.mean_of("q_std"), [0.5, 0.75])
    np.testing.assert_array_equal(group.mean_of("value_bias"), [1, 2])  # not before the first update
    assert group.mean_of("value_bias_normalised") is None


def test_a_run_without_an_evaluation_is_left_out_and_named(tmp_path):
    write_run(tmp_path / "a")
    path = write_run(tmp_path / "b", "sac", curves=np.zeros((1, 0)))
    found = collect([str(tmp_path)])
    assert len(found.rows) == 1 and found.notes == [f"left out: {path} has no evaluation yet"]
    with pytest.raises(UsageError, match="has no evaluation yet"):
        collect([str(path)])


def test_the_baseline_has_equal_settings_except_the_penalty(tmp_path):
    write_run(tmp_path / "a", "td3")
    write_run(tmp_path / "a", "td3_sqt")
    write_run(tmp_path / "b", "sac", updates_per_step=2)
    write_run(tmp_path / "b", "sac_sqt")
    write_run(tmp_path / "c", "td7_sqt")
    found = collect([str(tmp_path)])
    td3, td3_sqt, _, sac_sqt, td7_sqt = found.groups
    assert found.baseline(td3_sqt) == (td3, "")
    assert found.baseline(sac_sqt) == (
        None,
        "not compared: sac and sac_sqt on cheetah differ in updates_per_step (2, 1)",
    )
    assert found.baseline(td7_sqt) == (None, "no run of td7 on cheetah to compare with")


def test_coefficient_zero_takes_the_place_of_a_baseline_that_was_not_run(tmp_path):
    write_run(tmp_path, "td3_sqt", curves=[[0, 1, 1], [0, 2, 2]], swept={"penalty_coef": (0.0, 0.5)})
    write_run(tmp_path, "td3_sqt_tuple")
    found = collect([str(tmp_path)])
    zero, half, sqt_tuple = found.groups
    for group in (half, sqt_tuple):
        baseline = found.baseline(group)
        assert baseline.group is zero
        assert baseline.note == "no run of td3: compared with td3_sqt at penalty_coef 0, which trains the same"


def test_counterparts(tmp_path):
    write_run(tmp_path, "td3_sqt")
    write_run(tmp_path / "a", "td3_sqt_tuple")
    write_run(tmp_path / "b", "td3_sqt_tuple", gamma=0.9)
    found = collect([str(tmp_path)])
    (other,) = found.counterparts(found.groups[0], "td3_sqt_tuple")
    assert other.settings["gamma"] == 0.99


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_rows_baseline_is_the_same_row_without_the_penalty(algo):
    baseline = ALGORITHMS[baseline_of(algo)]
    own = {name: value for name, value in ALGORITHMS[algo].settings.items() if not name.startswith("penalty")}
    assert (baseline.build, baseline.settings, baseline.training) == (
        ALGORITHMS[algo].build,
        own,
        ALGORITHMS[algo].training,
    )
