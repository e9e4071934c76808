"""--launcher=slurm on a real SLURM without accounting: nothing that happens to a job changes a row of its run."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import slurm_cluster

from experiments.grids.grid import make_cells
from experiments.launchers import slurm_records

ROOT = Path(__file__).resolve().parent.parent
TASK = "scaled_pendulum:make"
TINY = (
    "--seeds=0 --steps=20000 --warmup_steps=500 --eval_every=2500 --eval_episodes=1 --hidden=8 --batch_size=16 "
    "--checkpoint_every=1000 --quiet"
).split()
ALGOS, SIX = ["td3", "td3_sqt"], "updates_per_step=1,2,10"  # the last two cells take longer: they meet the time limit
PATIENCE = 400.0  # seconds


def _missing() -> str | None:
    try:
        import submitit  # noqa: F401
    except ImportError:
        return "submitit is not installed: pip install '.[slurm]'"
    return slurm_cluster.missing()


pytestmark = [pytest.mark.slow, pytest.mark.engine, pytest.mark.skipif(bool(_missing()), reason=str(_missing()))]


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """A folder that the second node does not see."""
    return tmp_path_factory.mktemp("hidden")


@pytest.fixture(scope="module")
def slurm(hidden):
    with slurm_cluster.cluster(hidden=hidden) as running:
        yield running


class Sweep:
    """`experiments.sweep` with a grid, in a process."""

    def __init__(self, slurm, out, grid, *arguments):
        self.slurm = slurm
        self.cells = make_cells(grid, ALGOS, [TASK], out, TINY)
        self.command = [sys.executable, "-m", "experiments.sweep", f"--algos={','.join(ALGOS)}", f"--tasks={TASK}"]
        self.command += [f"--grid={grid}"] if grid else []
        self.command += [f"--out={out}", *TINY, *arguments]
        path = [str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
        self.variables = dict(slurm.variables) | {"PYTHONPATH": os.pathsep.join(filter(None, path))}

    def start(self, *more):
        return subprocess.Popen(
            [*self.command, *more],
            env=self.variables,
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def run(self, *more):
        """The exit code and what is printed."""
        process = self.start(*more)
        printed, _ = process.communicate(timeout=PATIENCE)
        return process.returncode, printed

    def state(self, cell):
        """Of the cell's job: RUNNING, PENDING, ..., or gone."""
        submitted = slurm_records.read(cell)
        return self.slurm.jobs().get(submitted.job, "gone") if submitted else "not submitted"

    def job(self, cell):
        return slurm_records.read(cell).job

    def saved_and_runs(self, cell):
        return any(cell.path.glob("checkpoint/step_*")) and self.state(cell) == "RUNNING"


def wait_until(condition, process=None):
    give_up = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < give_up, "waited too long"
        assert process is None or process.poll() is None, process.communicate()[0]
        time.sleep(0.2)
    return found


def rows(cell):
    """The run's table without the times."""
    with (cell.path / "evaluations.csv").open() as file:
        return [{name: value for name, value in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


def resumes(cell):
    """How often the run was resumed."""
    return len(json.loads((cell.path / "config.json").read_text()).get("resumed", []))


def send(sweep, name, job):
    """Sends a signal to a job. scancel is ended then: it sends again if other elements of the array still wait."""
    scancel = subprocess.Popen(["scancel", f"--signal={name}", job], env=sweep.variables)
    with suppress(subprocess.TimeoutExpired):
        assert scancel.wait(3) == 0
    scancel.kill()
    scancel.wait()


def set_down(slurm, sweep, cell):
    """The node of the cell's job goes down, and comes back when the job has left it."""
    node = slurm.call("squeue", "-h", "-j", sweep.job(cell), "-o", "%B")
    slurm.call("scontrol", "update", f"NodeName={node}", "State=DOWN", "Reason=test")
    wait_until(lambda: sweep.state(cell) != "RUNNING")
    with suppress(subprocess.CalledProcessError):  # it may be back already
        slurm.call("scontrol", "update", f"NodeName={node}", "State=RESUME")


def test_what_happens_to_jobs_does_not_change_a_row(slurm, tmp_path):
    """Signals, a time limit and a lost node: six cells end like those of a sweep without SLURM on one core."""
    limit = "--slurm=time=00:01:00,save_seconds=10"
    sweep = Sweep(slurm, tmp_path / "slurm", SIX, "--launcher=slurm", limit)
    warned, terminated, killed, on_lost_node, *long = sweep.cells
    events = [
        (warned, lambda: send(sweep, "USR2", sweep.job(warned))),
        (terminated, lambda: send(sweep, "TERM", sweep.job(terminated))),
        # To the job's programs: to the job itself, it is what a plain scancel does.
        (killed, lambda: send(sweep, "KILL", f"{sweep.job(killed)}.0")),
        (on_lost_node, lambda: set_down(slurm, sweep, on_lost_node)),
    ]
    process = sweep.start()
    while events:
        cell, event = wait_until(lambda: next((e for e in events if sweep.saved_and_runs(e[0])), None), process)
        event()
        events.remove((cell, event))
    printed, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, printed
    assert printed.count("started again") == 1, printed  # the killed one; SLURM has requeued the others
    assert all(resumes(cell) >= 1 for cell in sweep.cells), printed

    alone = Sweep(slurm, tmp_path / "alone", SIX)
    cores = sorted(os.sched_getaffinity(0))[:2]
    halves = [Sweep(slurm, tmp_path / "alone", SIX, f"--algos={algo}") for algo in ALGOS]
    for core, half in zip(cores, halves, strict=True):
        half.command = ["taskset", "-c", str(core), *half.command]
    processes = [half.start() for half in halves]
    assert [process.communicate(timeout=PATIENCE) and process.returncode for process in processes] == [0, 0]
    for cell, other in zip(sweep.cells, alone.cells, strict=True):
        assert rows(cell) == rows(other) and len(rows(cell)) == 9
