"""Parsing the flags of a command that passes all others on to the runs that it starts."""

import re
import sys
from collections.abc import Sequence

from absl import flags

from experiments.commandline.arguments import BAD_USAGE, printable


def parse_known(argv: Sequence[str]) -> list[str]:
    """Parses the flags that absl knows; returns the other words. A wrong value ends the process with one line."""
    try:
        return flags.FLAGS(argv, known_only=True)
    except flags.Error as error:
        line = str(error).removeprefix("flag ").splitlines()[0]
        found = re.match(r"-*(\w+)=", line)
        if found and found[1] in flags.FLAGS:
            # absl says nothing of switches
            line = f"--{found[1]}: expects {flags.FLAGS[found[1]].parser.syntactic_help or 'true or false'}"
        print(printable(line), file=sys.stderr)
        sys.exit(BAD_USAGE)
