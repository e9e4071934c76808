"""The grids: their algorithms and tasks, and the names of their runs."""

from pathlib import Path

import pytest

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.grids.grid import GRIDS, cells_of, make_cells, run_name
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


def test_shortened_names_still_differ():
    common = [f"--seeds={','.join(map(str, range(100)))}"]
    one, other = (run_name([*common, f"--steps={steps}"]) for steps in (100, 200))
    assert one != other == run_name([*common, "--steps=200"]) and len(one) == len(other) == 200


def test_flags_of_every_run_are_passed_on():
    (cell,) = make_cells("table2", ["td3"], ["Ant-v4"], Path("runs"), ["--preset=released", "--steps=1e4"])
    assert cell.path == Path("runs/ant/td3/preset=released_steps=1e4")
    options = flags.parse(["run", *cell.command])
    assert (options.preset, options.settings, options.resume) == ("released", {"steps": 10_000}, flags.LATEST)


@pytest.mark.parametrize("name", [None, "released"])
def test_an_unknown_grid_is_rejected(name):
    with pytest.raises(UsageError, match="^--grid: expects one of table2, table3, table4, all, alpha"):
        make_cells(name, [], [], Path("runs"), [])


@pytest.mark.parametrize("word", ["--env=ant", "--resume", "ant", "-steps=5"])
def test_flags_that_the_grid_sets_are_rejected(word):
    with pytest.raises(UsageError, match=f"^{word}: expects flags of experiments.run in the form --flag=value, exc"):
        make_cells("table2", [], [], Path("runs"), [word])
