"""The commands (`python -m experiments.COMMAND`) and the packages behind them; the guide is README.md."""

import sys

from experiments.surroundings import streams, variables

# While Python looks for the module of `python -m experiments.COMMAND`: before any library is imported.
if sys.argv[:1] == ["-m"]:
    streams.guard()
    variables.prepare(sys.orig_argv[sys.orig_argv.index("-m") + 1])
