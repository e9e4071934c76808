"""What a command that starts runs prints: lines, and its refusal in one."""

import sys
from collections.abc import Callable

from experiments.commandline.arguments import BAD_USAGE, UsageError, printable


def say(*lines: str) -> None:
    """Prints lines at once."""
    for line in lines:
        print(printable(line), flush=True)


def refused_in_one_line(command: Callable[[], int], out: str) -> int:
    """Calls a command and returns its exit code. A `UsageError` or `OSError` becomes one line on stderr.

    Args:
      out: the folder of the results, which an `OSError` is about.
    """
    try:
        return command()
    except UsageError as error:
        line = str(error)
    except OSError as error:
        line = f"--out={out}: expects a folder that can be written: {error}"
    print(printable(line), file=sys.stderr)
    return BAD_USAGE
