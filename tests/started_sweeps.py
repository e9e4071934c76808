"""Sweeps of tiny runs in processes of their own, the runs that they train, and their rows."""

import csv
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from experiments.launchers import tied

ROOT = Path(__file__).resolve().parent.parent
GRID = ["--algos=td3,td3_sqt,td3_sqt_tuple", "--tasks=hopper", "--physics=mujoco", "--seeds=0,1", "--split=seeds:1"]
GRID += ["--steps=12000", "--warmup_steps=100", "--eval_every=2000", "--checkpoint_every=1000", "--eval_episodes=1"]
GRID += ["--batch_size=8", "--hidden=8", "--quiet", "--notensorboard"]


class Run:
    """A run that another process has started, such as a Ray worker."""

    def __init__(self, worker: psutil.Process, process: psutil.Process):
        self.worker, self.process = worker, process
        flags = dict(word[2:].partition("=")[::2] for word in process.cmdline() if word.startswith("--"))
        self.path = Path(flags["out"]) / flags["env"] / flags["algo"] / flags["name"]

    def is_half_done(self) -> bool:
        """Whether it has been evaluated after its start, and is far from its end: a signal still finds it."""
        table = self.path / "evaluations.csv"
        return table.exists() and 3 <= table.read_text().count("\n") < 5


def wait_for(condition: Callable[[], Any], seconds: float = 120) -> Any:
    """The first result of `condition` that is true."""
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError("waited in vain")


def start_sweep(out, *arguments, core=None, **variables):
    """The process of a sweep, in a session of its own as in a terminal; on one core if `core` is given."""
    pinned = [sys.executable, tied.__file__, str(os.getpid()), str(core)] if core is not None else []
    # Little of a program's optimisation matters here, and most of the time is compilation.
    quick = {"XLA_FLAGS": "--xla_backend_optimization_level=0", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [*pinned, sys.executable, "-m", "experiments.sweep", *GRID, f"--out={out}", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | quick | variables,
    )


def rows(out):
    """All rows of all tables, without the times."""
    found = {}
    for table in out.glob("*/*/*/evaluations.csv"):
        with table.open() as file:
            content = [{k: v for k, v in row.items() if k != "wall_seconds"} for row in csv.DictReader(file)]
        found[table.relative_to(out)] = content
    return found
