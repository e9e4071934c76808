"""Runs a program that the system kills when the process that started it dies, on a part of the cores.

    python tied.py PARENT CORES PROGRAM ARGUMENTS...

PARENT is the process id of the starter, CORES a list like 0,1 or `all`. The program replaces this one, so that there is
one process. Linux only has the signal (prctl(2), PR_SET_PDEATHSIG); elsewhere the program outlives its starter.

A file of its own that imports nothing of ours: Python's `preexec_fn` would run between fork and exec of a process with
threads, where it may hang.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main(parent: str, cores: str, *command: str) -> None:
    """Becomes `command`."""
    if sys.platform == "linux":
        # SIGKILL: a retry may start at once, and must not meet a process that still saves.
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != int(parent):  # it died before the call
            sys.exit(128 + signal.SIGKILL)
    if cores != "all":
        os.sched_setaffinity(0, map(int, cores.split(",")))
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(*sys.argv[1:])
