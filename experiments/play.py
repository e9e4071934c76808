"""Plays the policy of a run: `python -m experiments.play RUN --video=film.mp4`."""

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.commandline.arguments import INTERRUPTED, guarded
from experiments.playing import play_flags
from experiments.playing.play_flags import parser


def command(argv: Sequence[str]) -> None:
    """Parses `argv`, program name first, and plays. Raises `UsageError`."""
    options = parser().read(argv)
    run = Path(options.runs[0])
    play_flags.check(run, options)
    with play_flags.chosen_graphics(run, options):
        from experiments.playing.performance import perform  # JAX, and MuJoCo, which reads MUJOCO_GL when imported

    perform(run, options)


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    try:
        return guarded(command, argv)
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv))
