"""Trains a grid of runs: `python -m experiments.sweep --grid=table2 --steps=1000000`.

A cell of a grid is one run of `experiments.run`: an algorithm on a task, with all seeds. Flags other than those below
go to every run, for example --steps=1000000, --physics=mujoco or --preset=released. Finished runs are skipped and
interrupted ones resumed, so the same command can be repeated. Runs of the same flags are shared by all grids.

--launcher says where the runs are started: in processes here or on a cluster. A run that fails does not stop the
others. The exit code is the worst of the runs': 130 interrupted, 1 failed, 2 bad usage, 3 a member diverged, 0 done.
"""

from collections.abc import Sequence
from pathlib import Path

from absl import app, flags

from experiments.commandline.answers import refused_in_one_line, say
from experiments.commandline.arguments import DONE, UsageError, reject_folder
from experiments.commandline.known_flags import parse_known
from experiments.commandline.path_flags import define_path
from experiments.grids import status
from experiments.grids.grid import GRIDS, OWN_GRID, make_cells, needs_training
from experiments.grids.stopping import collected_signals
from experiments.grids.train_cells import repeat_command, submit_and_leave, train_cells
from experiments.launchers import launcher_flags, slurm_status
from experiments.launchers.choice import check_launcher, make_launcher
from experiments.launchers.slurm import SlurmLauncher

FLAGS = flags.FLAGS


def main(argv: Sequence[str]) -> int:
    """Trains the grid; `argv` has the program name and the flags for every run. Returns the exit code."""
    return refused_in_one_line(lambda: sweep(argv[1:]), FLAGS.out)


def sweep(run_flags: Sequence[str]) -> int:
    """As `main`. Raises `UsageError`, and `OSError` if --out cannot be written."""
    out = Path(FLAGS.out)
    cells = make_cells(FLAGS.grid, FLAGS.algos, FLAGS.tasks, out, run_flags, _seeds_per_cell(FLAGS.split))
    options = launcher_flags.given(FLAGS, out)
    check_launcher(options)
    for name in ("fail_fast", "retries"):
        if FLAGS.detach and FLAGS[name].present:
            raise UsageError(f"--{name}: has no effect with --detach; expects a sweep that waits for its runs")
    if FLAGS.status:
        say(*status.status_lines(cells, slurm_status.job_texts(cells, out)))
        return DONE
    if FLAGS.dry_run:
        say(*(repeat_command(cell) for cell in cells if needs_training(cell)))
        return DONE
    reject_folder("--out", out)
    launcher = make_launcher(options)
    if FLAGS.detach and isinstance(launcher, SlurmLauncher):
        return submit_and_leave(cells, launcher, say)
    with collected_signals() as received:
        return train_cells(
            cells,
            launcher,
            say,
            retries=FLAGS.retries,
            fail_fast=FLAGS.fail_fast,
            signals=lambda: len(received),
        )


def _seeds_per_cell(text: str | None) -> int | None:
    """K of `--split=seeds:K`."""
    if text is None:
        return None
    name, _, count = text.partition(":")
    if name != "seeds" or not (count.isascii() and count.isdecimal() and int(count[:9]) > 0):
        raise UsageError(f"--split={text}: expects seeds:K, the seeds of each run in cells of K")
    return int(count[:9])


if __name__ == "__main__":
    flags.DEFINE_string("grid", None, f"What to train: {', '.join(GRIDS)}, or {OWN_GRID}.")
    flags.DEFINE_list("algos", [], "Algorithms, if not the grid's.")
    flags.DEFINE_list("tasks", [], "Tasks, if not the grid's.")
    flags.DEFINE_string("split", None, "seeds:K: each run's seeds in cells of K, which tables pool as one row.")
    define_path("out", "runs", "Results go to OUT/TASK/ALGO/NAME/. On a cluster: a folder that all machines share.")
    launcher_flags.define("With local: runs side by side, each on GPUs or cores of its own.")
    flags.DEFINE_bool("detach", None, "With slurm: submit and leave; --status shows the runs.")
    flags.DEFINE_bool("fail_fast", False, "Stop at the first run that fails.")
    flags.DEFINE_bool("status", False, "Print the state of the grid's runs and train nothing.")
    flags.DEFINE_bool("dry_run", False, "Print a command per run that is not finished, and train nothing.")
    app.run(main, flags_parser=parse_known)
