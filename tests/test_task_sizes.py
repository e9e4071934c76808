"""Table 1, and the sizes of custom environments."""

import json

from made_runs import made_member, write_run
from table_reader import cells

from experiments.evidence import figures, published, run_details
from experiments.evidence.paper_tables import make_tables
from experiments.evidence.pooling import arrange, collect, pool
from experiments.evidence.task_sizes import read_sizes, table_1


def test_table_1_by_hand():
    sizes = [{"env": "ant", "task": "Ant-v4", "observation": 27, "action": 8, "episode_steps": 1000}]
    assert cells(table_1(sizes, reference=False)) == [["ant", "Ant-v4", "27", "8", "1,000"]]
    table = table_1(sizes, reference=True)
    assert cells(table) == [["ant", "Ant-v4", "27", "8", "1,000", "27 / 8"]]
    assert table.records == [sizes[0] | {"paper_observation": 27, "paper_action": 8}]


def test_the_sizes_are_the_environments(tmp_path):
    write_run(tmp_path, env="hopper")
    runs = collect([str(tmp_path)])
    sizes = {row["env"]: (row["observation"], row["action"]) for row in read_sizes(runs)}
    theirs = {env: tuple(size) for env, size in published.paper()["table1_obs_action"].items()}
    assert sizes == theirs | {"hopper": (11, 3)}


def own(seed=0, env="point", run="run", **settings):
    """A member of a run whose environment was handed in from Python."""
    return made_member(env=env, seed=seed, run=run, physics="own", eval_physics="own", **settings)


def with_policy(run, **sizes):
    (run / "policy").mkdir(parents=True)
    (run / "policy" / "config.json").write_text(json.dumps({"env": "point"} | sizes))
    return run


def test_own_environments_are_pooled_under_their_own_names():
    members = [own(0), own(1), own(0, "maze"), own(0, "cheetah"), own(1, "ant-v4"), made_member()]
    runs = arrange(pool(members))
    groups = {group.env: group for group in runs.groups}
    assert list(groups) == ["cheetah", "ant-v4 (own)", "cheetah (own)", "maze", "point"]
    assert [groups[env].seeds for env in groups] == [(0,), (1,), (0,), (0,), (0, 1)]


def test_an_own_environment_has_the_sizes_of_its_runs_policies(tmp_path):
    damaged = with_policy(tmp_path / "a", observation_size="3")
    run = with_policy(tmp_path / "b", observation_size=3, action_size=2)
    runs = arrange(pool([own(0, run=damaged), own(1, run=run), own(0, "cheetah", run=run), own(0, "maze")]))
    rows = cells(table_1(read_sizes(runs), reference=True))
    assert [row for row in rows if "own environment" in row] == [
        ["cheetah (own)", "own environment", "3", "2", "-", "-"],
        ["point", "own environment", "3", "2", "-", "-"],
    ]
    assert [row[0] for row in rows[:4]] == ["cheetah", "walker", "ant", "humanoid"] and len(rows) == 6  # not maze


def test_all_tables_and_figures_are_made_of_own_environments():
    runs = arrange(pool([own(0), own(1), own(0, algo="td3_sqt", penalty="batch_std", penalty_coef=0.5)]))
    names = [table.name for table in make_tables(runs, True, read_sizes(runs))]
    assert names == ["table1", "table2", "table2_improvement", "table3", "table3_change", "seeds"]
    drawn = {name: draw() for name, draw in figures.all_figures(runs, "iqm").items()}
    assert drawn["learning_curves"] and drawn["performance_profile"]


def test_runs_of_an_own_environment_are_read_from_disk(tmp_path):
    write_run(tmp_path, env="point", sizes=(3, 2))
    runs = collect([str(tmp_path)])
    assert [group.env for group in runs.groups] == ["point"]
    assert cells(table_1(read_sizes(runs), reference=False))[-1] == ["point", "own environment", "3", "2", "-"]
    (details,) = run_details.read_all(runs)
    assert "physics" not in [setting.name for setting in details.settings]


def test_each_size_of_an_own_environment_has_its_line(tmp_path):
    for name, sizes in {"a": (3, 2), "b": (1, 1)}.items():
        write_run(tmp_path, env="point", name=name, sizes=sizes)
    assert cells(table_1(read_sizes(collect([str(tmp_path)])), reference=False))[-2:] == [
        ["point (obs 1, action 1)", "own environment", "1", "1", "-"],
        ["point (obs 3, action 2)", "own environment", "3", "2", "-"],
    ]
