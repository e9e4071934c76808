"""--launcher=slurm on a real SLURM without accounting: nothing that happens to a job changes a row of its run."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
import slurm_cluster

from experiments.grids.grid import make_cells
from experiments.launchers import slurm_records
from experiments.launchers.cell import read_ended

ROOT = Path(__file__).resolve().parent.parent
TASK = "scaled_pendulum:make"
TINY = [
    *("--seeds=0", "--warmup_steps=500", "--eval_every=2500", "--eval_episodes=1", "--hidden=8"),
    *("--batch_size=16", "--checkpoint_every=1000", "--quiet"),
]
ALGOS = ("td3", "td3_sqt")
PATIENCE = 500.0  # seconds


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
def cluster(hidden):
    with slurm_cluster.cluster(hidden=hidden if slurm_cluster.can_hide() else None) as running:
        yield running


@pytest.fixture
def slurm(cluster):
    for node in slurm_cluster.NODES:
        cluster.bring_back(node)  # SLURM drains a node where a killed process takes long to end
    cluster.wait_until_idle()
    return cluster


class Sweep:
    """`experiments.sweep` with a grid of TD3 and TD3 with SQT, in a process."""

    def __init__(self, slurm, out, grid, *arguments, steps=30000):
        self.slurm = slurm
        flags = [f"--steps={steps}", *TINY]
        self.cells = make_cells(grid, ALGOS, [TASK], out, flags)
        self.command = [sys.executable, "-m", "experiments.sweep", f"--tasks={TASK}", f"--algos={','.join(ALGOS)}"]
        self.command += [f"--grid={grid}", f"--out={out}", *flags, *arguments]
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

    def job(self, cell):
        """The id of the cell's job."""
        return slurm_records.read(cell).job

    def state(self, cell):
        """Of the cell's job: RUNNING, PENDING, ..., or gone."""
        return self.slurm.jobs().get(self.job(cell), "gone") if slurm_records.read(cell) else "not submitted"

    def printed_by_job(self, cell):
        log = slurm_records.read(cell).log
        return log.read_text() if log.exists() else ""

    def saved_and_runs(self, cell):
        return any(cell.path.glob("checkpoint/step_*")) and self.state(cell) == "RUNNING"

    def wait_until(self, condition, process):
        """Waits for a condition while the sweep runs; returns its value."""
        give_up = time.monotonic() + PATIENCE
        while not (found := condition()):
            assert time.monotonic() < give_up, f"waited too long\n{self.slurm.describe()}"
            assert process.poll() is None, f"{process.communicate()[0]}\n{self.slurm.describe()}"
            time.sleep(0.1)
        return found


def send(sweep, name, job):
    """Sends a signal to a job. scancel is ended soon: it sends again while other elements of the array still wait."""
    scancel = subprocess.Popen(["scancel", f"--signal={name}", job], env=sweep.variables)
    threading.Timer(2, lambda: (scancel.kill(), scancel.wait())).start()


@contextmanager
def stopped(sweep, cell):
    """Holds the cell's run, so that it does not end before its time limit, however fast this machine is."""
    job = f"slurm {sweep.job(cell)}"
    runs = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if "experiments.run" in process.cmdline() and process.environ().get("SQT_JOB") == job:
                runs.append(process)
                process.send_signal(signal.SIGSTOP)
    assert runs
    yield
    for process in runs:
        process.send_signal(signal.SIGCONT)


def reach_time_limit(sweep, cell, process):
    with stopped(sweep, cell):
        sweep.wait_until(lambda: "SIGUSR2 received" in sweep.printed_by_job(cell), process)


def lose_node(sweep, cell, process):
    """The node of the cell's job goes down, and comes back when the job has left it."""
    node = sweep.slurm.call("squeue", "-h", "-j", sweep.job(cell), "-o", "%B")
    sweep.slurm.call("scontrol", "update", f"NodeName={node}", "State=DOWN", "Reason=test")
    sweep.wait_until(lambda: sweep.state(cell) != "RUNNING", process)
    sweep.wait_until(lambda: sweep.slurm.bring_back(node), process)


def rows(cell):
    """The run's table without the times."""
    with (cell.path / "evaluations.csv").open() as file:
        return [{name: value for name, value in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


def resumes(cell):
    """How often the run was resumed."""
    return len(json.loads((cell.path / "config.json").read_text()).get("resumed", []))


def test_what_happens_to_jobs_does_not_change_a_row(slurm, tmp_path):
    """Submitted by a command that left, awaited by another; signals, a time limit and a lost node.

    The rows are those of a sweep without SLURM, one cell after another on one core.
    """
    grid = "lr=0.001,0.0003,0.0001"
    limit = "--slurm=time=00:01:00,save_seconds=10"
    sweep = Sweep(slurm, tmp_path / "slurm", grid, "--launcher=slurm", limit)
    code, printed = sweep.run("--detach")
    assert code == 0 and "6 runs, 0 of them finished, 0 already submitted\n6 submitted" in printed
    code, printed = sweep.run("--detach")
    assert code == 0 and "6 already submitted\n0 submitted" in printed
    code, printed = sweep.run("--status")
    assert code == 0 and "job 1_5 (Resources)" in printed and "waiting" in printed
    assert len(set(slurm.jobs())) == 6

    warned, terminated, killed, on_lost_node, limited, _ = sweep.cells
    process = sweep.start()
    events = {
        warned: lambda: send(sweep, "USR2", sweep.job(warned)),
        terminated: lambda: send(sweep, "TERM", sweep.job(terminated)),
        # To the job's programs: to the job itself, it is what a plain scancel does.
        killed: lambda: send(sweep, "KILL", f"{sweep.job(killed)}.0"),
        on_lost_node: lambda: lose_node(sweep, on_lost_node, process),
        limited: lambda: reach_time_limit(sweep, limited, process),
    }
    while events:
        ready = sweep.wait_until(lambda: [cell for cell in events if sweep.saved_and_runs(cell)], process)
        for cell in ready:
            events.pop(cell)()
    printed, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, printed
    assert printed.count("started again") == 1, printed  # the killed one; SLURM has requeued the others
    assert all(resumes(cell) for cell in (warned, terminated, killed, on_lost_node, limited)), printed

    reference = tmp_path / "one_after_another"
    halves = [Sweep(slurm, reference, grid, f"--algos={algo}") for algo in ALGOS]
    for core, half in zip(sorted(os.sched_getaffinity(0)), halves, strict=False):
        half.command = ["taskset", "-c", str(core), *half.command]
    processes = [half.start() for half in halves]
    assert [process.communicate(timeout=PATIENCE) and process.returncode for process in processes] == [0, 0]
    for cell, other in zip(sweep.cells, halves[0].cells, strict=True):
        assert rows(cell) == rows(other) and len(rows(cell)) == 13


def test_a_user_may_cancel_one_job_or_all(slurm, tmp_path):
    """A plain scancel ends a cell for good. Ctrl-C on the sweep lets the others save, and drops those that wait."""
    sweep = Sweep(slurm, tmp_path, "lr=0.001,0.0003", "--launcher=slurm", "--max_jobs=2", steps=1000000)
    cancelled, saved, second, dropped = sweep.cells
    process = sweep.start()
    sweep.wait_until(lambda: sweep.saved_and_runs(cancelled), process)
    assert sweep.state(second) == "PENDING"  # two jobs at a time
    slurm.call("scancel", sweep.job(cancelled))
    sweep.wait_until(lambda: sweep.saved_and_runs(saved) and sweep.state(second) == "RUNNING", process)
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, printed
    assert "1/4 td3 on" in printed and "started again" not in printed
    assert "cancelled before it started" in printed
    assert read_ended(cancelled)[1:3] == read_ended(saved)[1:3] == (130, "interrupted; the same command resumes it")
    assert any(saved.path.glob("checkpoint/step_*")) and not dropped.path.exists()
    assert not {"RUNNING", "PENDING"} & set(slurm.jobs().values())
    code, printed = sweep.run("--status")
    assert code == 0 and printed.endswith("4 runs: 4 interrupted\n")


def test_a_node_that_does_not_see_the_folder_is_named(slurm, hidden):
    if not slurm_cluster.can_hide():
        pytest.skip("no folder can be hidden from a process here")
    sweep = Sweep(slurm, hidden / "out", "lr=0.001", "--algos=td3", "--launcher=slurm", "--slurm=nodelist=sn2")
    code, printed = sweep.run()
    assert code == 2
    line = f"--out={hidden / 'out'}: expects a folder that all machines share; sn2 does not see it (job "
    assert line in printed and "started again" not in printed, printed


def test_errors_of_sbatch_are_one_line(slurm, tmp_path):
    sweep = Sweep(slurm, tmp_path / "out", "lr=0.001", "--launcher=slurm", "--slurm=partition=nowhere")
    code, printed = sweep.run()
    assert code == 2 and printed.count("\n") == 2  # and the line that counts the runs
    assert "--slurm: expects options that sbatch accepts: sbatch: error: " in printed and "nowhere" in printed
    assert not (tmp_path / "out").exists()


def test_setup_lines_run_first(slurm, tmp_path):
    """Here they fail, so that nothing is trained."""
    setup = tmp_path / "setup.sh"
    setup.write_text("echo '--launcher=slurm: no modules today' >&2\nexit 2\n")
    sweep = Sweep(slurm, tmp_path / "out", "lr=0.001", "--launcher=slurm", "--algos=td3", f"--slurm_setup={setup}")
    code, printed = sweep.run()
    assert code == 2 and "td3 on scaled_pendulum:make: --launcher=slurm: no modules today" in printed
