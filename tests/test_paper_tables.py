"""Tables 2 to 4 and the table of seeds by hand."""

from made_runs import write_run
from table_reader import cells

from experiments.evidence import paper_tables, published
from experiments.evidence.paper_tables import make_tables, table_2, table_3, table_4
from experiments.evidence.pooling import collect

NAN = float("nan")


def test_table_2_by_hand(tmp_path):
    # Means 0, 5, 4: the score is that of step 50, where the seeds are 4 and 6.
    write_run(tmp_path, "td3", curves=[[0, 4, 6], [0, 6, 2]])
    table = table_2(collect([str(tmp_path)]), reference=False)
    assert table.header == ["algorithm", "cheetah", "penalty_coef", "steps", "UTD"]
    assert cells(table) == [["td3", "5.00 ± 1.00 (2)|5.00 [4.00, 6.00]", "-", "100", "1"]]
    assert table.notes == []
    (record,) = table.records
    numbers = {"mean": 5, "std": 1, "iqm": 5, "mean_low": 4, "mean_high": 6, "iqm_low": 4, "iqm_high": 6}
    where = {"algo": "td3", "env": "cheetah", "quantity": "score", "score_env_steps": 50, "per_seed": "4 6"}
    final = {"final_mean": 4, "final_std": 2, "final_iqm": 4}
    protocol = {"steps": 100, "updates_per_step": 1, "physics": "mjx", "eval_physics": "mujoco", "seeds": "0 1"}
    for name, value in (numbers | where | final | protocol | {"notes": ""}).items():
        assert record[name] == value, name


def test_incomplete_cells_are_marked_and_missing_ones_not_filled(tmp_path):
    write_run(tmp_path, "td3", "cheetah", curves=[[0, 1, 2], [0, 1, 2], [0, 1, 2]])
    write_run(tmp_path, "td3", "ant", curves=[[0, 1, 2], [0, 1, NAN], [0, 1, 2]])
    write_run(tmp_path, "sac", "cheetah", curves=[[0, 3]])
    table = table_2(collect([str(tmp_path)]), reference=False)
    assert cells(table) == [
        ["td3", "2.00 ± 0.00 (3)|2.00 [2.00, 2.00]", "1.00 ± 0.00 (3)|1.00 [1.00, 1.00] [1]", "-", "100", "1"],
        ["sac", "3.00 ± 0.00 (1) [2, 3]", "- [4]", "-", "100", "1"],
    ]
    assert table.notes == [
        "seed 1 diverged after step 50: no evaluation after that counts",
        "seed 0 stopped at step 50 of 100",
        "fewer seeds than other cells, which have 3",
        "not run",
    ]
    assert [record["env"] for record in table.records] == ["cheetah", "ant", "cheetah"]


def test_a_cell_without_an_evaluation_of_all_seeds(tmp_path):
    write_run(tmp_path, curves=[[NAN, NAN]])
    table = table_2(collect([str(tmp_path)]), reference=False)
    assert cells(table)[0][1].startswith("- [")
    assert "its seeds have no evaluation in common" in table.notes


def test_settings_in_which_a_rows_tasks_differ_are_noted(tmp_path):
    write_run(tmp_path, "td3_sqt", "cheetah", penalty_coef=0.5)
    write_run(tmp_path, "td3_sqt", "ant", penalty_coef=0.25, steps=200, physics="mujoco")
    table = table_2(collect([str(tmp_path)]), reference=False)
    assert cells(table)[0][0] == "td3_sqt [1]" and cells(table)[0][-3:] == ["0.5 / 0.25", "100 / 200", "1"]
    assert table.notes[0] == "penalty_coef: 0.5 (cheetah), 0.25 (ant)"
    assert "Cells differ in physics: it is mjx, but mujoco for td3_sqt on ant." in table.caption
    assert "Common to all: warmup_steps 10, eval_physics mujoco" in table.caption


def test_table_3_by_hand(tmp_path):
    bias = {"value_bias": [[9, 2, 4], [9, -1, 1]], "value_bias_normalised": [[NAN, 0.5, 0.5], [NAN, 0.25, 0.75]]}
    write_run(tmp_path, "td3", curves=[[0, 1, 2], [0, 1, 2]], q_std=[0.5, 0.75], more=bias)
    write_run(tmp_path, "td3_sqt", curves=[[0, 1, 2], [0, 1, 2]], q_std=[0.25, 0.25])
    runs = collect([str(tmp_path)])
    table = table_3(runs, reference=False)
    assert [row[1] for row in cells(table)] == [
        "0.62 ± 0.12 (2)|0.62 [0.50, 0.75]|bias +1.50 ± 1.50",
        "0.25 ± 0.00 (2)|0.25 [0.25, 0.25]",
    ]
    assert table.records[0]["value_bias_mean"] == 1.5 and table.records[0]["value_bias_per_seed"] == "3 0"
    assert table.records[0]["value_bias_normalised_mean"] == 0.5
    (change,) = (table for table in make_tables(runs) if table.name == "table3_change")
    assert cells(change)[0][1].startswith("-60.0 % [")


def test_table_4_by_hand(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 0, 1]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 0, 12]])
    write_run(tmp_path, "td3_sqt_tuple", curves=[[0, 0, 10]])
    write_run(tmp_path, "sac_sqt", curves=[[0, 0, 3]])  # without its counterpart
    table = table_4(collect([str(tmp_path)]), reference=False)
    assert [row[:2] for row in cells(table)] == [
        ["td3_sqt", "12.0 ± 0.00 (1)"],
        ["td3_sqt_tuple", "10.0 ± 0.00 (1)"],
        ["td3_sqt against td3_sqt_tuple", "+20.0 %|P 1.00"],
    ]


def test_variants_that_differ_in_more_than_the_penalty_are_not_compared(tmp_path):
    write_run(tmp_path, "td3_sqt")
    write_run(tmp_path, "td3_sqt_tuple", tau=0.1)
    table = table_4(collect([str(tmp_path)]), reference=False)
    assert cells(table)[-1][:2] == ["td3_sqt against td3_sqt_tuple", "- [1]"]
    assert table.notes == ["not compared: td3_sqt and td3_sqt_tuple on cheetah differ in tau (0.005, 0.1)"]


def test_empty_tables_are_not_made(tmp_path):
    write_run(tmp_path, "td3")
    names = [table.name for table in make_tables(collect([str(tmp_path)]))]
    assert names == ["table2", "table3", "seeds"]


def test_published_figures_are_below_ours_with_version_and_source(tmp_path):
    write_run(tmp_path, "td3_sqt", "humanoid", curves=[[0, 1, 2]])
    write_run(tmp_path, "sac", "ant-v5")
    runs = collect([str(tmp_path)])
    table = table_2(runs, reference=True)
    rows = [row for row in cells(table)]
    assert table.header[1:3] == ["humanoid", "ant-v5"]
    labels = [row[0] for row in rows]
    # Published numbers of the baseline, which was not run; then our row and its published numbers.
    assert labels[0].startswith("published: td3, environment v3, 10 seeds|Tianshou")
    ours = labels.index("td3_sqt")
    released = rows[ours + 1]
    assert released[0] == f"published: td3_sqt, environment Gym v2, 5 seeds|{published.RELEASED}"
    assert released[1:] == ["6,648 ± 553", "-", "-", "1,000,000", "2"]  # v2's are not v5's
    (broken,) = [row for row in rows if row[0] == released[0].replace("td3_sqt", "td3")]
    assert broken[1] == "5,043 ± 2,383 [1, 2]" and published.NEVER_LEARNS in table.notes
    sources = [record["source"] for record in table.records]
    assert sources.count("") == 2 and published.PAPER in sources
    q_std = cells(table_3(runs, reference=True))
    assert [row[1] for row in q_std if "published: td3_sqt" in row[0]] == ["2.11"]


def test_missing_published_numbers_are_noted(tmp_path):
    write_run(tmp_path, "redq", "brax:ant")
    table = table_2(collect([str(tmp_path)]), reference=True)
    assert table.caption.endswith("No published numbers for these algorithms and tasks.")


def test_seeds_by_hand(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 4, 9], [0, 6, NAN]], seeds=[3, 5], q_std=[0.5, 0.75])
    table = paper_tables.seeds_table(collect([str(tmp_path)]))
    assert cells(table) == [["td3 [1]", "cheetah", "3: 4.00  5: 6.00", "3: 9.00  5: -", "3: 0.50  5: 0.75"]]
    first, second = table.records
    assert (first["seed"], first["return_at_score"], first["best_return"], first["best_env_steps"]) == (3, 4, 9, 100)
    assert (second["best_return"], second["q_std"]) == (6, 0.75) and second["run"].endswith("cheetah/td3/run")
