"""Figures of finished runs: `python -m experiments.plots runs`."""

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, folder, guarded, one_of

EXAMPLE = "python -m experiments.plots RUNS... --out=figures"
DESCRIPTION = """\
Figures of finished runs: returns, the critics' disagreement and their bias over the environment steps, the score
against penalty_coef, and performance profiles, each if its data exist. Runs are pooled as in
`python -m experiments.tables`."""
FORMATS = ("png", "svg", "pdf")
STATISTICS = ("iqm", "mean")


def parser() -> Parser:
    """The command's flags."""
    made = Parser(DESCRIPTION, EXAMPLE)
    made.add_argument(
        "--out", type=folder, default=Path("figures"), metavar="FOLDER", help="folder of the figures (figures)"
    )
    made.add_argument(
        "--format", type=one_of(*FORMATS), default="png", metavar="NAME", help=f"one of {', '.join(FORMATS)} (png)"
    )
    made.add_argument(
        "--statistic",
        type=one_of(*STATISTICS),
        default="iqm",
        metavar="NAME",
        help="statistic over seeds: iqm or mean (iqm)",
    )
    made.add_argument("--overwrite", action="store_true", help="replace existing figures")
    return made


def command(argv: Sequence[str]) -> None:
    """Writes the figures. Raises `UsageError`."""
    options = parser().read(argv)
    from experiments.evidence import figures, pooling  # imports JAX and matplotlib

    runs = pooling.collect(options.runs)
    draw = figures.all_figures(runs, options.statistic)
    arguments.reject_existing(options.out, [f"{name}.{options.format}" for name in draw], options.overwrite)
    contents, empty = figures.file_contents(draw, options.format)
    arguments.write_files(options.out, contents)
    for name in contents:
        print(options.out / name)
    for text in [*([f"nothing to draw: {', '.join(empty)}"] if empty else []), *runs.notes]:
        print(text, file=sys.stderr)


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    return guarded(command, argv)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
