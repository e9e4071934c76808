"""The grids: their algorithms and tasks, and the names of their runs."""

from pathlib import Path

import pytest

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.grids.grid import GRIDS, Grid, cells_of, make_cells, run_name, split_seeds
from experiments.grids.own_grid import parse_variants
from sqt_jax.algorithms import ALGORITHMS


@pytest.mark.parametrize("name", GRIDS)
def test_grids_have_algorithms_and_tasks_that_exist(name):
    grid = cells_of(GRIDS[name], (), (), Path("runs"), ())
    assert {cell.algo for cell in grid} <= ALGORITHMS.keys() and len(grid) == len(set(grid)) > 0
    assert all(flags.parse(["run", *cell.command]) for cell in grid)


def test_tables_2_to_4_are_the_papers_nine_on_its_four_tasks():
    def of(name):
        return {(cell.algo, cell.path) for cell in cells_of(GRIDS[name], (), (), Path("runs"), ("--steps=1000",))}

    assert of("table2") == of("table3") and of("table2") | of("table4") == of("all")
    assert len({algo for algo, _ in of("all")}) == 9 and len(of("all")) == 36


def test_a_cell_is_named_by_its_flags():
    assert run_name(["--steps=10", "--hidden=8,8", "--out=a/b"]) == "hidden=8,8_out=a-b_steps=10"
    assert run_name([]) == "default"
    assert run_name(["--steps=10", "--wandb=mine"]) == run_name(["--steps=10", "--wandb"]) == "steps=10"


def test_shortened_names_still_differ():
    common = [f"--seeds={','.join(map(str, range(100)))}"]
    one, other = (run_name([*common, f"--steps={steps}"]) for steps in (100, 200))
    assert one != other == run_name([*common, "--steps=200"]) and len(one) == len(other) == 200


def test_flags_of_every_run_are_passed_on():
    (cell,) = make_cells("table2", ["td3"], ["Ant-v4"], Path("runs"), ["--preset=released", "--steps=1e5"])
    assert cell.path == Path("runs/ant/td3/preset=released_steps=1e5")
    options = flags.parse(["run", *cell.command])
    assert (options.preset, options.settings, options.resume) == ("released", {"steps": 100_000}, flags.LATEST)


@pytest.mark.parametrize("name", [None, "released"])
def test_an_unknown_grid_is_rejected(name):
    with pytest.raises(
        UsageError, match="^--grid: expects one of table2, table3, table4, all, alpha, (not .*, )?or settings"
    ):
        make_cells(name, [], [], Path("runs"), [])


def test_a_grid_of_ones_own_has_a_run_for_each_combination():
    cells = make_cells("penalty_coef=0.1,0.5", ["td3_sqt", "sac_sqt"], ["ant", "walker"], Path("runs"), [])
    assert len({cell.path for cell in cells}) == 8
    assert cells[0].path == Path("runs/ant/td3_sqt/penalty_coef=0.1")
    assert len(make_cells(None, ["td3"], ["ant"], Path("runs"), [])) == 1


def test_cells_of_one_algorithm_and_task_have_labels_that_differ():
    grid = "penalty_coef=0.1,0.5;ensemble_size=2,5"
    cells = make_cells(grid, ["td3_sqt"], ["ant"], Path("runs"), ["--seeds=0,1"], seeds_per_cell=1)
    assert cells[0].label == "td3_sqt on ant, penalty_coef=0.1 ensemble_size=2 seeds=0"
    assert len({cell.label for cell in cells}) == 8
    cells = make_cells("alpha", [], [], Path("runs"), ["--seeds=0,1"], seeds_per_cell=1)
    assert [cell.label for cell in cells] == ["td3_sqt on cheetah, seeds=0", "td3_sqt on cheetah, seeds=1"]
    assert make_cells("alpha", [], [], Path("runs"), [])[0].label == "td3_sqt on cheetah"


def test_a_grid_of_too_many_runs_is_rejected():
    many = ",".join(map(str, range(101)))
    with pytest.raises(UsageError, match="^--grid: expects at most 10,000 runs, not 10,201"):
        cells_of(Grid(("td3",), ("ant",), parse_variants(f"warmup_steps={many};eval_every={many}")), (), (), Path(), ())


def test_seeds_are_split_over_cells(tmp_path):
    assert split_seeds(["--seeds=3,1,4,5,9", "--steps=10"], 2) == [
        ("--steps=10", "--seeds=3,1"),
        ("--steps=10", "--seeds=4,5"),
        ("--steps=10", "--seeds=9"),
    ]
    assert [flags[-1] for flags in split_seeds([], 3)] == ["--seeds=0,1,2", "--seeds=3,4"]  # the default
    (tmp_path / "file.yaml").write_text("seeds: [7, 8]")
    assert split_seeds([f"--config={tmp_path / 'file.yaml'}"], 1)[1][-1] == "--seeds=8"
    cells = make_cells("alpha", [], [], tmp_path, ["--seeds=0,1"], seeds_per_cell=1)
    assert [flags.parse(["run", *cell.command]).seeds for cell in cells] == [(0,), (1,)]
    assert len({cell.path for cell in cells}) == 2


def test_the_folder_of_an_own_environment_is_that_of_its_name():
    def folder(task):
        (cell,) = make_cells(None, ["td3"], [task], Path("runs"), ["--env_args=scale=2.0"])
        return cell.path.parent.parent.name

    assert folder("scaled_pendulum:make") == "pendulum"


@pytest.mark.parametrize("word", ["--env=ant", "--resume", "ant", "-steps=5"])
def test_flags_that_the_grid_sets_are_rejected(word):
    with pytest.raises(UsageError, match=f"^{word}: expects flags of experiments.run in the form --flag=value, exc"):
        make_cells("table2", [], [], Path("runs"), [word])
