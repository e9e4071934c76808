"""What every launcher does: start cells, say how they ended, stop them."""

from collections.abc import Sequence
from typing import Protocol

from experiments.launchers.cell import Cell, Ended


class Launcher(Protocol):
    """Starts the runs of cells on some machine. A context manager: leaving it leaves no process behind."""

    def submit(self, cells: Sequence[Cell]) -> None:
        """Takes cells, which it starts when there is room for them, in their order.

        Raises:
          UsageError: the engine refuses them.
        """
        ...

    def ended(self) -> list[Ended]:
        """The cells that have ended since the last call. Waits up to a second for one."""
        ...

    def cancel(self) -> None:
        """Asks running cells to save and end, and drops those that wait. `ended` then reports each as interrupted.

        A second call ends them at once.
        """
        ...

    def __enter__(self) -> "Launcher": ...

    def __exit__(self, *error: object) -> None: ...
