"""Where a run's policies are: in the run's folder once training has ended, in its checkpoints from the first one on.

RUN/policy/, RUN/policy_best/    the policies of the last state, and those of each member's best evaluation
RUN/checkpoint/step_0000050000/  the same two folders, at that environment step
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

LAST, BEST, CHECKPOINTS = "policy", "policy_best", "checkpoint"
CHECKPOINT = re.compile(r"step_(\d{10})(?:\.(\d))?")  # of environment steps; a step can have a second one, "….1"

Result = TypeVar("Result")


class PolicyFolder(NamedTuple):
    """A folder with the members' policies."""

    path: Path
    env_steps: int | None  # of the checkpoint that holds it; None: it is the run's own


def is_run(folder: Path) -> bool:
    """Whether this is the folder of a run that has policies or may have them in its checkpoints."""
    return any((folder / name).is_dir() for name in (LAST, BEST, CHECKPOINTS))


def find(run: Path, best: bool = False) -> list[PolicyFolder]:
    """The folders of a run with its last or its best policies: the run's own, then its checkpoints', newest first.

    Links in checkpoints are not followed.
    """
    name = BEST if best else LAST
    found = [PolicyFolder(run / name, None)] if (run / name).is_dir() else []
    checkpoints = run / CHECKPOINTS
    if checkpoints.is_symlink() or not checkpoints.is_dir():
        return found
    matches = (CHECKPOINT.fullmatch(item.name) for item in checkpoints.iterdir())
    for match in sorted(filter(None, matches), key=lambda match: match[0], reverse=True):
        folder = checkpoints / match[0] / name
        if folder.is_dir() and not _has_links(folder):
            found.append(PolicyFolder(folder, int(match[1])))
    return found


def read_first(run: Path, best: bool, read: Callable[[Path], Result]) -> tuple[Result, PolicyFolder]:
    """What `read` returns for the first folder of `find` that it can read, and that folder.

    Training that still runs may remove a checkpoint while it is read: the next one is read then.

    Args:
      read: is called with a folder, and raises OSError or ValueError if a file in it is missing or damaged. Only
        checkpoints have a next one: an error in the run's own folder is raised.

    Raises:
      FileNotFoundError: there is no such folder.
      OSError, ValueError: of `read`, the first one.
    """
    tried: dict[PolicyFolder, Exception] = {}
    # Found again each time: a checkpoint may have been added since the last one was removed.
    while left := [folder for folder in find(run, best) if folder not in tried]:
        try:
            return read(left[0].path), left[0]
        except (OSError, ValueError) as error:
            if left[0].env_steps is None and not isinstance(error, FileNotFoundError):
                raise
            tried[left[0]] = error
    if tried:
        raise next(iter(tried.values()))
    name = BEST if best else LAST
    raise FileNotFoundError(
        f"{run}: expects a run with {name}/, which is saved with each checkpoint and when training ends; it has none"
    )


def _has_links(folder: Path) -> bool:
    """Whether a checkpoint's folder of policies, or anything in it, is a link; also if it has been removed."""
    try:
        return any(item.is_symlink() for item in (folder.parent, folder, *folder.iterdir()))
    except OSError:  # also of a file system that has lost it
        return True
