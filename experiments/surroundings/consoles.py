"""Consoles of rich that suit their stream."""

import sys

from rich.console import Console

UNLIMITED = 1000  # columns: tables use what they need


def console(stderr: bool = False) -> Console:
    """A console on stdout or stderr.

    Only a terminal gets a live line and colours, whatever FORCE_COLOR and its like say. In files, pipes and notebooks
    tables are as wide as they need, whatever COLUMNS says.
    """
    stream = sys.stderr if stderr else sys.stdout
    interactive = stream is not None and stream.isatty()
    width = None if interactive else UNLIMITED
    return Console(stderr=stderr, force_terminal=interactive, force_jupyter=False, width=width)
