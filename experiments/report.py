"""A report on finished runs as one page: `python -m experiments.report runs`.

Exit codes: 0 done; 2 bad usage (one line, nothing written).
"""

import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, file, guarded, one_of, printable
from experiments.plots import STATISTICS

EXAMPLE = "python -m experiments.report RUNS... --out=report.html"
DESCRIPTION = """\
A report on finished runs as one HTML file that needs no other file and no network: what was run, the tables of
`python -m experiments.tables`, the figures of `python -m experiments.plots`, and of each run its settings, versions,
returns and the command that repeats it."""


def parser() -> Parser:
    made = Parser(DESCRIPTION, EXAMPLE)
    made.add_argument(
        "--out", type=file, default=Path("report.html"), metavar="FILE", help="where it goes (report.html)"
    )
    made.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    made.add_argument("--reference", action="store_true", help="show published figures beside ours, in the tables")
    made.add_argument(
        "--statistic", type=one_of(*STATISTICS), default="iqm", metavar="NAME", help="of the figures: iqm or mean (iqm)"
    )
    return made


def command(argv: Sequence[str]) -> None:
    options = parser().read(argv)
    arguments.reject_file("--out", options.out, options.overwrite)
    from experiments.evidence import figures, page, paper_tables, pooling, run_details
    from experiments.running import run_config  # they take a second or two

    runs = pooling.collect(options.runs)
    content = page.Content(
        runs,
        paper_tables.make_tables(runs, options.reference, paper_tables.task_sizes(runs)),
        {name: draw() for name, draw in figures.every(runs, options.statistic).items()},
        run_details.read_all(runs),
        datetime.now(UTC),
        f"sqt_jax {run_config.versions()['sqt_jax'] or 'of an unknown version'}",
        shlex.join(["python", "-m", "experiments.report", *argv[1:]]),
    )
    arguments.write_file(options.out, page.page(content).encode())
    print(printable(str(options.out)))
    for note in runs.notes:
        print(printable(note), file=sys.stderr)


def main(argv: Sequence[str]) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    return guarded(command, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
