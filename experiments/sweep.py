"""The paper's experiments, one run after another: `python -m experiments.sweep --grid=table2 --steps=1000000`.

A cell of a grid is one run of `experiments.run`: an algorithm on a task, with all seeds. Flags other than those below
go to every run, for example --steps=1000000, --physics=mujoco or --preset=released. Finished runs are skipped and
interrupted ones resumed, so the same command can be repeated. Runs of the same flags are shared by all grids.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from absl import app, flags

from experiments.commandline.arguments import BAD_USAGE, UsageError, printable, reject_folder
from experiments.commandline.path_flags import define_path
from experiments.grids.grid import GRIDS, make_cells
from experiments.grids.train_cells import train_cells, train_in_process

FLAGS = flags.FLAGS


def main(argv: Sequence[str]) -> int:
    """Trains the grid; `argv` has the program name and the flags for every run. Returns the exit code."""
    try:
        reject_folder("--out", Path(FLAGS.out))
        cells = make_cells(FLAGS.grid, FLAGS.algos, FLAGS.tasks, Path(FLAGS.out), argv[1:])
        return train_cells(cells, train_in_process, lambda line: print(line, flush=True))
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except OSError as error:  # of a cell's log
        print(printable(f"--out={FLAGS.out}: expects a folder that can be written: {error}"), file=sys.stderr)
        return BAD_USAGE


if __name__ == "__main__":
    flags.DEFINE_string("grid", None, f"What to train: {', '.join(GRIDS)}.")
    flags.DEFINE_list("algos", [], "Algorithms, if not the grid's.")
    flags.DEFINE_list("tasks", [], "Tasks, if not the grid's.")
    define_path("out", "runs", "Results go to OUT/TASK/ALGO/NAME/.")
    # known_only: unknown flags stay in argv.
    app.run(main, flags_parser=lambda argv: FLAGS(argv, known_only=True))
