"""Leaves no half study behind when a cluster refuses the first batch of a new one."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from experiments.commandline.arguments import UsageError


@contextmanager
def removed_if_refused(new: Sequence[Path], started: Path) -> Iterator[None]:
    """Removes files and empty folders if a `UsageError` comes before anything was trained, and raises it again.

    Args:
      new: what did not exist before, in the order of removal.
      started: a folder that exists as soon as a run was started.
    """
    try:
        yield
    except UsageError:
        if not started.exists():
            for path in new:
                with suppress(OSError):  # a folder that holds something else by now
                    path.rmdir() if path.is_dir() else path.unlink()
        raise
