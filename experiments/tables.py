"""The paper's tables of finished runs: `python -m experiments.tables runs`.

Exit codes: 0 done; 2 bad usage (one line, nothing written).
"""

import sys
from collections.abc import Sequence

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, folder, guarded, one_of

EXAMPLE = "python -m experiments.tables RUNS... --out=tables"
DESCRIPTION = """\
The paper's tables of finished runs: 1, sizes of the tasks; 2, scores; 3, disagreement of the critics and bias; 4, sqt
against sqt_tuple. Runs of one algorithm on one task are pooled over seeds where all their settings agree, and kept
apart where they do not. Cells that are not all they should be are marked, and a footnote says why."""
NAMES = ("terminal", "markdown", "csv", "latex")


def parser() -> Parser:
    made = Parser(DESCRIPTION, EXAMPLE)
    made.add_argument(
        "--format",
        type=one_of(*NAMES),
        default="terminal",
        metavar="NAME",
        help=f"of what is shown: {', '.join(NAMES)}",
    )
    made.add_argument("--out", type=folder, metavar="FOLDER", help="also write the tables there, in every format")
    made.add_argument("--overwrite", action="store_true", help="replace tables that are there")
    made.add_argument("--reference", action="store_true", help="show published figures beside ours")
    return made


def command(argv: Sequence[str]) -> None:
    options = parser().read(argv)
    from experiments.evidence import formats, paper_tables, pooling  # these and what they bring take a second or two

    runs = pooling.collect(options.runs)
    if options.out:
        names = [f"{name}.{suffix}" for name in paper_tables.NAMES for suffix, _ in formats.FORMATS.values()]
        arguments.reject_existing(options.out, names, options.overwrite)
    tables = paper_tables.make_tables(runs, options.reference, paper_tables.task_sizes(runs))
    if options.out:
        contents = {
            f"{table.name}.{suffix}": write(table).encode()
            for table in tables
            for suffix, write in formats.FORMATS.values()
        }
        arguments.write_files(options.out, contents)
    if options.format == "terminal" and sys.stdout.isatty():
        from rich.console import Console

        for table in tables:
            Console().print(formats.rich_table(table))
    else:
        print("\n".join(formats.FORMATS[options.format][1](table) for table in tables), end="")
    if options.out:
        print(f"written to {options.out}: {len(tables)} tables as txt, md, csv and tex", file=sys.stderr)


def main(argv: Sequence[str]) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    return guarded(command, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
