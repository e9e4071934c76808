"""What a command that starts runs prints: lines, and its refusal in one."""

import sys
from collections.abc import Callable

from experiments.commandline.arguments import BAD_USAGE, UsageError, printable


def say(*lines: str) -> None:
    """Prints lines at once."""
    for line in lines:
        print(printable(line), flush=True)


def refused_in_one_line(command: Callable[[], int], out: str, os_error: int = BAD_USAGE) -> int:
    """Calls a command and returns its exit code. A `UsageError` or `OSError` becomes one line on stderr.

    Args:
      out: the folder of the results, which an `OSError` is about.
      os_error: the exit code of that.
    """
    try:
        return command()
    except UsageError as error:
        line, code = str(error), BAD_USAGE
    except OSError as error:
        line, code = f"--out={out}: expects a folder that can be written: {error}", os_error
    print(printable(line), file=sys.stderr)
    return code
