"""The sweep command."""

import glob
import json
import shlex
import signal
import subprocess
import sys
import time

import pytest
from made_runs import write_run


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("", "--grid: expects one of table2, table3, table4, all, alpha, or settings like"),
        ("--grid=lr=1,2 --algos=td3", "--grid: expects one of table2, "),
        ("--grid=table2 --split=tasks:2", "--split=tasks:2: expects seeds:K"),
        ("--grid=table2 --split=seeds:0", "--split=seeds:0: expects seeds:K"),
        ("--grid=table2 --launcher=locla", "--launcher: expects one of local"),
        ("--grid=table2 --workers=1000", "--workers=1000: expects at most "),
        ("--preset=table2", "--grid: expects one of table2, "),
        ("--grid=table2 --algos=td4", "--algos: expects one of td3, "),
        ("--grid=table2 --tasks=antt", "--tasks: expects one of cheetah, "),
        (
            "--grid=table2 --name=x",
            "--name=x: expects flags of experiments.run in the form --flag=value, except --algo",
        ),
        ("--grid=table2 --max_jobs=2 --dry_run", "--max_jobs: has no effect with --launcher=local; expects slurm"),
        ("--grid=table2 --launcher=slurm --detach --retries=2", "--retries: has no effect with --detach; expects "),
        ("--grid=table2 --tasks=ant --stepz=4", "--stepz: unknown flag; did you mean --steps?"),
    ],
)
def test_the_command_rejects_in_one_line(tmp_path, commands, arguments, line):
    done = commands.run("sweep", f"--out={tmp_path / 'out'}", *arguments.split())
    assert done.returncode == 2
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists() or not any(path.is_dir() for path in (tmp_path / "out").glob("*/*/*"))


COMMAND = ["sweep", "--algos=td3,td3_sqt", "--tasks=ant"]


def test_dry_run_prints_a_command_per_run_that_is_not_finished(tmp_path, commands):
    write_run(tmp_path, "td3", "ant", name="lr=0.1")
    summary = {"status": "done", "diverged": [], "groups": []}
    (tmp_path / "ant" / "td3" / "lr=0.1" / "summary.json").write_text(json.dumps(summary))
    done = commands.run(*COMMAND, "--lr=0.1", f"--out={tmp_path}", "--dry_run")
    assert done.returncode == 0, done.stderr
    assert shlex.split(done.stdout) == [
        *("python", "-m", "experiments.run", "--algo=td3_sqt", "--env=ant"),
        *(f"--out={tmp_path}", "--name=lr=0.1", "--resume", "--lr=0.1"),
    ]


def test_status_of_a_grid_that_has_not_begun(tmp_path, commands):
    done = commands.run(*COMMAND, "--lr=0.1", f"--out={tmp_path / 'new'}", "--status")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "td3 on ant      waiting\ntd3_sqt on ant  waiting\n2 runs: 2 waiting\n"
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_ctrl_c_saves_every_running_cell_and_the_same_command_ends_the_grid(tmp_path):
    words = (
        "--physics=mujoco --seeds=0,1 --steps=30000 --warmup_steps=100 --eval_every=1000 --eval_episodes=1 --hidden=8"
    )
    command = [sys.executable, "-m", f"experiments.{COMMAND[0]}", *COMMAND[1:], *words.split()]
    command += [f"--out={tmp_path}", "--batch_size=8"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    tables = [tmp_path / "ant" / algo / "*" / "evaluations.csv" for algo in ("td3",)]
    give_up = time.monotonic() + 300
    while not all(glob.glob(str(table)) for table in tables) and time.monotonic() < give_up:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "1/2 td3_sqt on ant: not started" in output and "td3 on ant: interrupted; the same command" in output
    (checkpoint,) = (tmp_path / "ant" / "td3").glob("*/checkpoint")
    assert any(checkpoint.iterdir()) and not (tmp_path / "ant" / "td3_sqt").exists()
    shown = subprocess.run([*command, "--status"], capture_output=True, text=True, timeout=120, check=True).stdout
    assert "td3 on ant      interrupted" in shown and "td3_sqt on ant  waiting" in shown


def test_help_says_that_other_flags_go_to_every_run(commands):
    out = commands.run("sweep", "--help").stdout
    assert "--grid" in out and "to every run, for example --steps=1000000" in " ".join(out.split())
