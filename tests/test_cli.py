"""The command line from end to end: mostly in this process and on tiny environments, once the literal command."""

import csv
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from experiments.run import main
from experiments.running import records, run_policies
from sqt_jax.envs import physics
from sqt_jax.experiment import make_config

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

# The members and sizes that these runs have in common, so that they share compiled programs.
TINY = (
    "--algo=sac_sqt --env=ant --seeds=3,1 --steps=120 --warmup_steps=30 --eval_every=50 --eval_episodes=2 "
    "--batch_size=8 --hidden=8,8 --name=run"
)
SMALL = "--steps=30 --warmup_steps=20 --eval_every=30 --eval_episodes=1 --batch_size=8 --hidden=8,8 --name=run"


def run(out, *arguments):
    return main(["experiments.run", *TINY.split(), f"--out={out}", *arguments])


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of two seeds and two coefficients: (exit code, its directory)."""
    out = tmp_path_factory.mktemp("runs")
    code = run(out, "--penalty_coef=0,0.5")
    return code, out / "ant" / "sac_sqt" / "run"


def test_the_files_of_a_run(finished):
    code, path = finished
    assert code == 0
    names = {item.name for item in path.iterdir()}
    assert {"config.json", "evaluations.csv", "metrics.csv", "summary.json", "curves.png", "tensorboard"} <= names
    assert not any(name.endswith(".part") for name in names)


def test_the_best_policies_are_those_of_the_best_evaluations_of_the_summary(finished):
    _, path = finished
    summary = json.loads((path / "summary.json").read_text())
    best = [(entry["best_return"], entry["best_env_steps"]) for entry in summary["members"]]
    assert [*run_policies.read_evaluations(path / "policy_best").values()] == best and len(best) == 4
    assert {item.name for item in (path / "policy_best").iterdir()} == {
        "best.json",
        *(item.name for item in (path / "policy").iterdir()),
    }


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "released"])
def test_td7_reports_its_policy_checkpoints(preset, tmp_path):
    """TD7's state and metrics differ from the others': a complete run."""
    more = ("--algo=td7_sqt", "--embedding_size=8", f"--preset={preset}", "--policy_delay=2")
    assert run(tmp_path, *more) == 0
    path = tmp_path / "ant" / "td7_sqt" / "run"
    evaluations, metrics = rows_of(path / "evaluations.csv"), rows_of(path / "metrics.csv")
    assert len(evaluations) == 8 and all(np.isfinite(float(row["return_mean"])) for row in evaluations)
    assert evaluations[-1]["gradient_steps"] == ("180" if preset == "released" else "90")
    last = metrics[-1]
    # Episodes of 5 steps from step 30 to 120; each is an assessment, and all returns are equal, which is never worse.
    assert (last["env_steps"], last["assessments"], last["policy_checkpoint_refreshes"]) == ("120", "18.0", "18.0")
    assert float(last["best_min_return"]) == float(last["train_return"])


@pytest.mark.slow
def test_a_released_run_of_td3_has_sale_networks(tmp_path):
    assert run(tmp_path, "--algo=td3_sqt", "--embedding_size=8", "--preset=released") == 0
    config = json.loads((tmp_path / "ant" / "td3_sqt" / "run" / "config.json").read_text())
    assert (config["preset"], config["settings"]["networks"]) == ("released", "sale")


def test_evaluations_of_a_run(finished):
    rows = rows_of(finished[1] / "evaluations.csv")
    assert tuple(rows[0]) == records.EVALUATION_COLUMNS
    assert [int(row["env_steps"]) for row in rows] == [steps for steps in (0, 50, 100, 120) for _ in range(4)]
    # One update per step after the warm-up.
    assert [int(row["gradient_steps"]) for row in rows[::4]] == [0, 20, 70, 90]
    assert [(row["member"], row["seed"], row["penalty_coef"]) for row in rows[:4]] == [
        ("0", "3", "0.0"),
        ("1", "1", "0.0"),
        ("2", "3", "0.5"),
        ("3", "1", "0.5"),
    ]
    assert {row["return_mean"] for row in rows} == {"5.0"}  # reward 1, five steps
    assert {row["episode_length_mean"] for row in rows} == {"5.0"}
    assert {row["value_bias"] for row in rows} == {""}
    assert {row["q_std"] for row in rows[:4]} == {""}
    assert all(float(row["q_std"]) > 0 for row in rows[4:])


def test_metrics_of_a_run(finished):
    rows = rows_of(finished[1] / "metrics.csv")
    assert [int(row["env_steps"]) for row in rows] == [steps for steps in (50, 100, 120) for _ in range(4)]
    assert [float(row["train_episodes"]) for row in rows[::4]] == [10, 10, 4]
    assert {float(row["train_return"]) for row in rows} == {5.0}
    penalties = {row["member"]: float(row["penalty"]) for row in rows}
    assert penalties["0"] == penalties["1"] == 0.0
    assert penalties["2"] > 0 and penalties["3"] > 0
    evaluations = rows_of(finished[1] / "evaluations.csv")[4:]
    assert [row["q_std"] for row in rows] == [row["q_std"] for row in evaluations]


def test_settings_of_a_run_repeat_it(finished):
    config = json.loads((finished[1] / "config.json").read_text())
    settings = config["settings"]
    assert {"algo": "sac_sqt", "env": "ant", "steps": 120, "hidden": [8, 8]}.items() <= settings.items()
    again = make_config(**settings | {"hidden": tuple(settings["hidden"])})
    assert again.flat() == settings | {"hidden": (8, 8)}
    assert config["versions"]["mujoco"] == config["versions"]["mujoco-mjx"] == "3.17.0"
    assert config["members"][2] == {"member": 2, "seed": 3, "penalty_coef": 0.5}
    assert "--penalty_coef=0,0.5" in config["command"]


def test_summary_of_a_run(finished):
    summary = json.loads((finished[1] / "summary.json").read_text())
    assert (summary["status"], summary["env_steps"], summary["gradient_steps"]) == ("done", 120, 90)
    assert [group["penalty_coef"] for group in summary["groups"]] == [0.0, 0.5]
    assert summary["groups"][1]["score"] == {"mean": 5.0, "std": 0.0, "env_steps": 0}
    assert [(member["seed"], member["final_return"]) for member in summary["members"]] == [(3, 5), (1, 5)] * 2
    assert summary["diverged"] == []


def test_a_directory_that_holds_a_run_is_rejected(finished, capsys):
    path = finished[1]
    before = {item: item.stat().st_mtime_ns for item in path.rglob("*")}
    assert run(path.parents[2]) == 2
    assert (
        capsys.readouterr().err
        == f"--name=run: {path} already holds a run; expects another name, or --overwrite replaces it\n"
    )
    assert {item: item.stat().st_mtime_ns for item in path.rglob("*")} == before


def test_output_of_a_run(tmp_path, capsys):
    assert run(tmp_path, "--penalty_coef=0,0.5", "--notensorboard") == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "per member: 120 training steps; 4 evaluations of 4 episodes, up to 80 steps (40% of all)" in out
    assert "step       120: return 5.0 +- 0.0 over 4 members" in out
    assert "mean +- std" in out
    path = tmp_path / "ant" / "sac_sqt" / "run"
    assert out.splitlines()[-1] == f"curves: {path / 'curves.png'}"
    assert not (path / "tensorboard").exists()


def test_quiet_prints_nothing(tmp_path, capsys):
    assert run(tmp_path, "--penalty_coef=0,0.5", "--quiet") == 0
    assert capsys.readouterr() == ("", "")


def test_a_member_does_not_depend_on_its_neighbours(finished, tmp_path):
    assert run(tmp_path, "--seeds=1,7,3,5") == 0
    rows = rows_of(tmp_path / "ant" / "sac_sqt" / "run" / "metrics.csv")
    before = rows_of(finished[1] / "metrics.csv")

    def of_seed(rows, seed):
        return [
            {name: text for name, text in row.items() if name not in ("member", "wall_seconds")}
            for row in rows
            if (row["seed"], row["penalty_coef"]) == (seed, "0.5")
        ]

    for seed in ("1", "3"):
        assert of_seed(rows, seed) == of_seed(before, seed)
    assert of_seed(rows, "7")[-1]["q_mean"] != of_seed(rows, "1")[-1]["q_mean"]


def test_a_member_that_diverges_is_named_and_the_others_finish(tmp_path, capsys):
    assert run(tmp_path, "--temperature=0.2,1e38") == 3
    summary = json.loads((tmp_path / "ant" / "sac_sqt" / "run" / "summary.json").read_text())
    assert summary["status"] == "diverged"
    assert summary["diverged"] == [{"member": 2, "env_steps": 31}, {"member": 3, "env_steps": 31}]  # the first update
    assert [group["temperature"] for group in summary["groups"]] == [0.2, 1e38]
    assert summary["env_steps"] == 120
    assert "member 2 diverged" in capsys.readouterr().out
    # The returns of a diverged member are in no row, mean or score; those of the others stay.
    rows = rows_of(tmp_path / "ant" / "sac_sqt" / "run" / "evaluations.csv")
    late = [row for row in rows if row["env_steps"] != "0"]
    for column in ("return_mean", "q_mean", "q_std"):
        assert {row["member"] for row in late if row[column]} == {"0", "1"}
    assert [group["final"]["mean"] is None for group in summary["groups"]] == [False, True]
    # The others continue: their rows are those of a run in which no member diverges.
    assert run(tmp_path / "good", "--temperature=0.2,0.3") == 0
    for name in ("evaluations.csv", "metrics.csv"):
        with_it, without = (rows_of(out / "ant" / "sac_sqt" / "run" / name) for out in (tmp_path, tmp_path / "good"))
        for ours, theirs in zip(with_it, without, strict=True):
            del ours["wall_seconds"], theirs["wall_seconds"]
            assert (ours == theirs) == (ours["member"] in ("0", "1"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_its_results_so_far(tmp_path, monkeypatch, number):
    def report(self, report, original=records.Records.report):
        original(self, report)
        if report.env_steps == 50:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(records.Records, "report", report)
    before = signal.getsignal(number)
    assert run(tmp_path, "--penalty_coef=0,0.5") == 130
    assert signal.getsignal(number) == before
    path = tmp_path / "ant" / "sac_sqt" / "run"
    summary = json.loads((path / "summary.json").read_text())
    assert summary["status"] == "interrupted" and summary["env_steps"] == 50
    assert len(rows_of(path / "evaluations.csv")) == 8
    assert (path / "curves.png").exists()


def test_only_a_run_is_replaced_and_only_with_overwrite(tmp_path, capsys):
    path = tmp_path / "ant" / "sac_sqt" / "run"
    path.mkdir(parents=True)
    (path / "config.json").write_text("old")
    assert run(tmp_path) == 2
    assert "already holds a run; expects another name, or --overwrite replaces it" in capsys.readouterr().err
    assert (path / "config.json").read_text() == "old"
    (path / "thesis.tex").write_text("mine")
    assert run(tmp_path, "--overwrite") == 2
    line = capsys.readouterr().err
    assert line.startswith(f"--overwrite: {path} holds other things than a run; expects ") and line.count("\n") == 1
    assert (path / "config.json").read_text() == "old"
    (path / "thesis.tex").unlink()
    assert run(tmp_path, "--overwrite", "--penalty_coef=0,0.5") == 0
    assert json.loads((path / "config.json").read_text())["settings"]["algo"] == "sac_sqt"


def test_the_default_name_has_the_settings_and_the_time(tmp_path):
    arguments = TINY.removesuffix(" --name=run").split()
    options = ["--penalty_coef=0,0.5", "--quiet", f"--out={tmp_path}"]
    assert main(["experiments.run", *arguments, *options]) == 0
    (path,) = (tmp_path / "ant" / "sac_sqt").iterdir()
    assert path.name.startswith("steps=120_warmup_steps=30_batch_size=8_") and "penalty_coef=0.0+0.5" in path.name
    assert path.name[-1] == "Z"


def test_help_lists_every_group(capsys):
    assert main(["experiments.run", "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for words in (
        "What to run:",
        "Training:",
        "Algorithm",
        "Output:",
        "--algo=NAME",
        "Exit codes: 0 done, 1 the results could not be written, 2 bad usage",
    ):
        assert words in out


# Invalid command lines, and how the error line begins. Typing errors are in test_flags.
BAD = [
    ("--stepz=5", "--stepz: unknown flag; did you mean --steps?"),
    ("--steps=two\nlines", "--steps=two\\nlines: expects a whole number"),
    ("--algo=sac_sqtt", "--algo: expects one of td3, td3_sqt, td3_sqt_tuple, sac, sac_sqt, sac_sqt_tuple, "),
    ("--env=antt", "--env: expects one of cheetah, walker, ant, humanoid"),
    ("--algo=sac --penalty_coef=0.5", "--penalty_coef: has no effect with sac"),
    ("--algo=td3_sqt --temperature=0.1,0.2", "--temperature: has no effect with td3_sqt"),
    (
        "--algo=td3 --preset=released --networks=mlp",
        "--train_encoder: has no effect with --networks=mlp (set by --preset=released)",
    ),
    ("--algo=td7_sqt --num_envs=2 --steps=100", "--num_envs: expects 1 for td7_sqt"),
    ("--penalty_coef=-1", "--penalty_coef: expects a number of at least 0"),
    ("--ensemble_size=1", "--ensemble_size: expects at least 2 for sac_sqt"),
    ("--ddof=2", "--ddof: expects a number below the ensemble_size (2)"),
    ("--reduce=max", "--reduce: expects one of min, mean, subset_min"),
    ("--reduce=subset_min --subset_size=3", "--subset_size: expects at most the ensemble_size (2)"),
    ("--batch_size=50 --replay_capacity=40", "--batch_size: expects at most the replay's capacity (40)"),
    ("--warmup_steps=500", "--warmup_steps: expects fewer than the run's steps (120)"),
    ("--num_envs=7", "--steps: expects a multiple of num_envs (7)"),
    ("--hidden=0", "--hidden: expects layer widths"),
    ("--gamma=0.9,1.5", "--gamma: expects a number from 0 to 1"),
    ("--seeds=0,0", "--seeds: expects each value once"),
    ("--steps=2e9 --replay_capacity=2e9", "--replay_capacity=2000000000: 2 members need about"),
    ("--name=" + "x" * 300, "--name=xxxxxx"),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[arguments[:40] for arguments, _ in BAD])
def test_an_invalid_command_is_one_line_and_writes_nothing(tmp_path, capsys, arguments, line):
    # Spaces separate arguments; a newline belongs to one.
    assert run(tmp_path / "out", *arguments.split(" ")) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(line) and err.count("\n") == 1 and err.endswith("\n")
    assert not (tmp_path / "out").exists()


def test_unknown_physics_is_rejected(tmp_path, capsys):
    assert main(["experiments.run", *TINY.split(), f"--out={tmp_path}", "--physics=warp9"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("--physics: expects one of mjx, mujoco, warp, not 'warp9'") and err.count("\n") == 1


@pytest.mark.parametrize("flag", ["physics", "eval_physics"])
def test_physics_that_cannot_run_here_is_rejected(tmp_path, capsys, monkeypatch, flag):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    assert main(["experiments.run", *TINY.split(), f"--out={tmp_path}", f"--{flag}=warp"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"--{flag}: warp needs a part; expects one of mjx, mujoco here\n")
    assert list(tmp_path.iterdir()) == []


def test_the_summary_is_the_last_file(tmp_path, capsys, monkeypatch):
    """It says that the run has ended, so policies and curves are written before it."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_policies, "write_policies", full)
    assert run(tmp_path, "--penalty_coef=0,0.5", "--quiet") == 1
    assert "the results cannot be written: " in capsys.readouterr().err
    assert not (tmp_path / "ant" / "sac_sqt" / "run" / "summary.json").exists()


def test_a_folder_that_cannot_be_written_is_rejected(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file") == 2
    err = capsys.readouterr().err
    assert err.startswith(f"--out={tmp_path / 'file'}: expects a folder that can be written") and err.count("\n") == 1


@pytest.mark.parametrize("physics", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_the_command_itself(tmp_path, physics):
    """The default physics, mjx, takes long to compile."""
    command = [sys.executable, "-m", "experiments.run", "--algo=sac_sqt", "--env=cheetah", "--seeds=0,1"]
    command += [] if physics == "mjx" else [f"--physics={physics}"]
    done = subprocess.run([*command, *SMALL.split(), f"--out={tmp_path}"], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    path = tmp_path / "cheetah" / "sac_sqt" / "run"
    rows = rows_of(path / "evaluations.csv")
    assert [(row["env_steps"], row["seed"], row["episode_length_mean"]) for row in rows] == [
        ("0", "0", "1000.0"),
        ("0", "1", "1000.0"),
        ("30", "0", "1000.0"),
        ("30", "1", "1000.0"),
    ]
    assert np.isfinite([float(row["return_mean"]) for row in rows]).all()
    assert done.stdout.splitlines()[-1] == f"curves: {path / 'curves.png'}"
