"""A report on finished runs as one page: `python -m experiments.report runs`."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, file, guarded, one_of, printable
from experiments.plots import STATISTICS

EXAMPLE = "python -m experiments.report RUNS... --out=report.html"
DESCRIPTION = """\
A report on finished runs as one HTML file that needs no other file and no network: the tables of
`python -m experiments.tables`, the figures of `python -m experiments.plots`, and for each run its settings, versions,
returns and the command that repeats it."""


def parser() -> Parser:
    """The command's flags."""
    made = Parser(DESCRIPTION, EXAMPLE)
    made.add_argument("--out", type=file, default=Path("report.html"), metavar="FILE", help="the report (report.html)")
    made.add_argument("--overwrite", action="store_true", help="replace an existing file")
    made.add_argument("--reference", action="store_true", help="show published numbers next to ours, in the tables")
    made.add_argument(
        "--statistic",
        type=one_of(*STATISTICS),
        default="iqm",
        metavar="NAME",
        help="statistic over seeds in the figures: iqm or mean (iqm)",
    )
    return made


def command(argv: Sequence[str]) -> None:
    """Writes the report. Raises `UsageError`."""
    options = parser().read(argv)
    arguments.reject_file("--out", options.out, options.overwrite)
    from experiments.evidence import page, pooling  # imports JAX and matplotlib

    runs = pooling.collect(options.runs)
    shown_command = shlex.join(["python", "-m", "experiments.report", *argv[1:]])
    content = page.make_content(runs, options.reference, options.statistic, shown_command)
    arguments.write_file(options.out, page.page(content).encode())
    print(printable(str(options.out)))
    for note in runs.notes:
        print(printable(note), file=sys.stderr)


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    return guarded(command, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
