"""`--wandb` with the package wandb itself, against a server on this machine."""

import importlib.util
import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from wandb_server import serving

from experiments.running import records

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        getattr(importlib.util.find_spec("wandb"), "origin", None) is None,
        reason="needs wandb: pip install -c constraints.txt -e '.[wandb]'",
    ),
]
TESTS = Path(__file__).parent
COMMAND = (
    "--algo=td3_sqt --env=probe_envs:constant_reward --seeds=3,1 --steps=2000 --warmup_steps=20 --eval_every=20 "
    "--eval_episodes=1 --batch_size=8 --hidden=8,8 --checkpoint_every=200 --replay_capacity=40 --notensorboard "
    "--name=run --resume --quiet"
)
KEY = "0" * 40


class Runs:
    """Starts one run of a folder again and again."""

    def __init__(self, out, address, **variables):
        self.out, self.path = out, out / "constant_reward" / "td3_sqt" / "run"
        own = {name: text for name, text in os.environ.items() if not name.startswith("WANDB_")}
        path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
        self.variables = own | {"HOME": str(out), "PYTHONPATH": path, "WANDB_BASE_URL": address} | variables

    def start(self, *arguments, **streams):
        words = [sys.executable, "-m", "experiments.run", *COMMAND.split(), f"--out={self.out}", *arguments]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} | streams
        return subprocess.Popen(words, env=self.variables, cwd=self.out, text=True, **streams)

    def finish(self, *arguments):
        """The exit code and the output of a process that nothing stops."""
        process = self.start(*arguments)
        return process.wait(timeout=300), self.output(process)

    @staticmethod
    def output(process):
        """What a process has printed, without the line about a checkpoint that a kill left incomplete."""
        lines = process.stdout.read().splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("the checkpoint at step"))

    def rows(self):
        table = self.path / "evaluations.csv"
        return len(table.read_text().splitlines()) - 1 if table.exists() else 0

    def stop(self, number, rows):
        """Sends a signal after so many more rows; returns the exit code, and the output."""
        process, before = self.start("--wandb=proj"), self.rows()
        end = time.monotonic() + 300
        while not (self.path / "checkpoint").exists() or self.rows() < before + rows:
            assert process.poll() is None and time.monotonic() < end
            before = min(before, self.rows())  # cut to the checkpoint
            time.sleep(0.01)
        services = [child for child in psutil.Process(process.pid).children() if "wandb" in child.name()]
        assert len(services) == 1
        if number == signal.SIGKILL and "WANDB_MODE" in self.variables:
            process.send_signal(signal.SIGSTOP)
            time.sleep(2)  # until wandb has written its file, which it does each second
        process.send_signal(number)
        process.wait(timeout=100)
        psutil.wait_procs(services, timeout=20)
        assert not services[0].is_running(), "wandb's process outlives the run"
        return process.returncode, self.output(process)

    def compare(self, runs, may_lack=None):
        """Compares the rows of the server's runs with evaluations.csv; the row at one step may be missing."""
        name = json.loads((self.path / "wandb.json").read_text())["id"]
        assert sorted(runs) == [f"{name}-0", f"{name}-1"]
        table = records.read_evaluations(self.path / "evaluations.csv")
        for member, seed in enumerate((3, 1)):
            run = runs[f"{name}-{member}"]
            assert (run["displayName"], run["project"]) == (f"seed={seed},penalty_coef=0.5", "proj")
            assert (run["groupName"], run["jobType"]) == ("constant_reward/td3_sqt/run", "td3_sqt")
            assert run["exit_code"] == 0
            steps = records.of_member(table, member, "env_steps")
            kept = (steps != may_lack) | (may_lack in [row["_step"] for row in run["rows"]])
            assert [row["_step"] for row in run["rows"]] == list(steps[kept])
            for column, key in (("return_mean", "eval/return_mean"), ("q_std", "train/q_std")):
                values = records.of_member(table, member, column)[kept]
                np.testing.assert_array_equal([row.get(key, np.nan) for row in run["rows"]], values)
            config = json.loads(run["config"])
            told = [config[name]["value"] for name in ("seed", "steps", "member")]
            assert told == [seed, 2000, member]


def test_a_run_that_is_killed_stopped_and_resumed_has_each_row_once(tmp_path):
    with serving() as (address, runs):
        run = Runs(tmp_path, address, WANDB_API_KEY=KEY)
        assert run.stop(signal.SIGKILL, rows=30) == (-9, "")
        code, output = run.stop(signal.SIGINT, rows=10)
        assert code == 130 and output.startswith("stopping when") and output.count("\n") == 1
        assert {kept["exit_code"] for kept in runs.values()} == {130}
        assert run.finish("--wandb=proj") == (0, "")
        run.compare(runs)


def test_parts_written_offline_are_one_run_after_wandb_sync(tmp_path):
    with serving() as (address, runs):
        run = Runs(tmp_path, address, WANDB_MODE="offline")
        assert run.stop(signal.SIGTERM, rows=30)[0] == 130
        assert run.stop(signal.SIGKILL, rows=30) == (-9, "")
        killed_at = json.loads((run.path / "wandb.json").read_text())["env_steps"]
        assert run.finish("--wandb=proj") == (0, "") and runs == {}
        parts = sorted(run.path.glob("wandb/offline-run-*"))
        assert len(parts) == 6
        words = [sys.executable, "-m", "wandb", "sync", *map(str, parts)]
        variables = run.variables | {"WANDB_API_KEY": KEY, "WANDB_MODE": "online"}
        done = subprocess.run(words, env=variables, cwd=tmp_path, capture_output=True, text=True, timeout=100)
        assert done.returncode == 0 and done.stderr.count("Finished syncing") == 6
        run.compare(runs, may_lack=killed_at)


def test_without_a_network_training_ends_as_without_wandb(tmp_path):
    run = Runs(tmp_path, "http://127.0.0.1:9", WANDB_API_KEY=KEY)
    code, output = run.finish("--wandb=proj", "--steps=100")
    assert code == 0 and run.rows() == 12
    assert output.startswith("--wandb: ") and output.endswith("training continues without it\n")
    assert "connection refused" in output and output.count("\n") == 1


def test_a_terminal_is_not_asked_for_a_login(tmp_path):
    run = Runs(tmp_path, "http://127.0.0.1:9")
    ours, theirs = pty.openpty()
    process = run.start("--wandb=proj", "--steps=100", stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    output = b""
    while process.poll() is None or b"without it" not in output:
        try:
            output += os.read(ours, 1000)
        except OSError:  # the other end is closed
            break
    assert process.wait(timeout=300) == 0
    lines = output.decode().splitlines()
    assert [line for line in lines if "login" in line] == [
        "--wandb: no login; expects `wandb login`, WANDB_API_KEY, or WANDB_MODE=offline; training continues without it"
    ]
    os.close(ours)
