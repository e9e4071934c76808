"""The paper's tables of finished runs: `python -m experiments.tables runs`."""

import sys
from collections.abc import Sequence

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, folder, guarded, one_of

EXAMPLE = "python -m experiments.tables RUNS... --out=tables"
DESCRIPTION = """\
The paper's tables of finished runs: 1, sizes of the tasks; 2, scores; 3, disagreement of the critics and bias; 4, SQT
against SQT-tuple. Tables 2 and 3 also compare each SQT variant with its baseline.

- Seeds are pooled where the algorithm, the task and all settings are equal; otherwise they are separate rows.
- An SQT variant is compared with a run of its baseline that differs from it in the penalty's settings only.
- Footnotes mark incomplete cells (fewer seeds than others, stopped early, diverged) and say why; an empty cell stays
  empty. A cell uses only the evaluations that all its seeds have.
- With five seeds the nominal 95 % intervals cover only about 85 % (mean) or 90 % (IQM)."""
NAMES = ("terminal", "markdown", "csv", "latex")


def parser() -> Parser:
    """The command's flags."""
    made = Parser(DESCRIPTION, EXAMPLE)
    made.add_argument(
        "--format",
        type=one_of(*NAMES),
        default="terminal",
        metavar="NAME",
        help=f"format of the printed tables: {', '.join(NAMES)} (terminal)",
    )
    made.add_argument("--out", type=folder, metavar="FOLDER", help="also write the tables there, in all formats")
    made.add_argument("--overwrite", action="store_true", help="replace existing tables")
    made.add_argument("--reference", action="store_true", help="show published numbers next to ours")
    return made


def command(argv: Sequence[str]) -> None:
    """Prints the tables, and writes them if --out is given. Raises `UsageError`."""
    options = parser().read(argv)
    from experiments.evidence import formats, paper_tables, pooling, task_sizes  # imports JAX

    runs = pooling.collect(options.runs)
    if options.out:
        arguments.reject_existing(options.out, formats.file_names(paper_tables.NAMES), options.overwrite)
    tables = paper_tables.make_tables(runs, options.reference, task_sizes.read_sizes(runs))
    if options.out:
        arguments.write_files(options.out, formats.file_contents(tables))
    formats.show(tables, options.format)
    if options.out:
        print(f"written to {options.out}: {len(tables)} tables as txt, md, csv and tex", file=sys.stderr)


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    return guarded(command, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
