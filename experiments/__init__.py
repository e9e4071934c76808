"""The commands (`python -m experiments.COMMAND`) and the packages behind them; the guide is README.md."""

import sys

from experiments.surroundings import streams, variables

# While Python looks for the module of `python -m experiments.COMMAND`: before any library is imported.
if sys.argv[:1] == ["-m"] and (command := variables.module_of(sys.orig_argv)).startswith("experiments."):
    streams.guard()
    variables.prepare(command)
