"""`--launcher=ray`: cells as tasks of a Ray cluster, through a process that talks to Ray (`ray_driver.py`)."""

import importlib.util
import os
import queue
import secrets
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from experiments.commandline.arguments import DIVERGED, DONE, FAILED, UsageError
from experiments.launchers import node_check
from experiments.launchers.cell import Cell, Ended, read_ended
from experiments.launchers.message_process import MessageProcess
from experiments.launchers.ray_options import RayOptions, parse

CONNECT_SECONDS = 20.0  # to a cluster that runs
START_SECONDS = 120.0  # of a cluster on this machine
READY_SECONDS = 180.0  # of the check of all nodes
FORWARDED = ("JAX_", "XLA_")  # beginnings of the variables that cells have from the sweep
DRIVER = (sys.executable, "-m", "experiments.launchers.ray_driver")
BELONGING = "a Ray cluster that this machine belongs to"


class RayLauncher:
    """Sends all cells to Ray, which starts them when it has room.

    Args:
      options: the resources of a cell.
      out: the folder of the results, which all nodes have to share.
      address: of the cluster; None: one is started on this machine and stopped with the context.
      program: the driver's process.
    """

    def __init__(self, options: RayOptions, out: Path, address: str | None, program: Sequence[str] = DRIVER):
        self._options, self._out, self._address, self._program = options, out, address, program
        self._numbers: dict[Cell, int] = {}  # a cell that is started again keeps its number
        self._running: dict[int, Cell] = {}
        self._driver: MessageProcess | None = None
        self._held = ExitStack()

    def submit(self, cells: Sequence[Cell]) -> None:
        """As `Launcher.submit`. The first call connects to the cluster and checks its nodes."""
        if not cells:
            return
        self._driver = self._driver or self._start()
        numbered = {self._numbers.setdefault(cell, len(self._numbers)): cell for cell in cells}
        self._running |= numbered
        fields = [[number, c.task, c.algo, str(c.path), c.command, c.detail] for number, c in numbered.items()]
        self._driver.send(submit=fields)

    def ended(self) -> list[Ended]:
        """As `Launcher.ended`."""
        found: list[Ended] = []
        with suppress(queue.Empty):
            while self._driver:
                found += self._ended_by(self._driver.receive(1.0 if self._running and not found else 0))
        return found

    def cancel(self) -> None:
        """As `Launcher.cancel`."""
        if self._driver:
            self._driver.send(cancel=True)

    def _start(self) -> MessageProcess:
        expected = self._held.enter_context(node_check.expected_here(self._out))
        driver = self._held.enter_context(MessageProcess(self._program, driver_variables(self._address, os.environ)))
        driver.send(
            address=self._address,
            options=self._options._asdict(),
            expected=expected,
            variables=forwarded_variables(os.environ),
            folder=os.getcwd(),
            sweep=secrets.token_hex(4),
        )
        if self._address:
            _wait_for("connected", driver, CONNECT_SECONDS, f"RAY_ADDRESS={self._address}: expects {BELONGING}")
        else:
            _wait_for("connected", driver, START_SECONDS, "--launcher=ray: expects to start a Ray cluster")
        _wait_for("ready", driver, READY_SECONDS, "--launcher=ray: expects all nodes of the Ray cluster")
        return driver

    def _ended_by(self, message: dict[str, Any] | None) -> list[Ended]:
        """The cells that have ended by the driver's message; None: the driver has ended."""
        if message is None or "lost" in message:
            assert self._driver
            why = message["lost"] if message else self._driver.last_error()
            self._driver = None
            cells = [*self._running.values()]
            self._running.clear()
            return [_done_unheard(cell) or Ended(cell, FAILED, f"the Ray cluster is gone: {why}") for cell in cells]
        number, code, reason, lost = message["ended"]
        cell = self._running.pop(number, None)
        return [Ended(cell, code, reason, lost)] if cell else []

    def __enter__(self) -> "RayLauncher":
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()  # the driver disconnects, and stops a cluster of its own


def _wait_for(word: str, driver: MessageProcess, seconds: float, expected: str) -> None:
    """Waits for a message of the driver's. Raises `UsageError` if another one comes, or none."""
    try:
        message = driver.receive(seconds)
    except queue.Empty:
        driver.kill()  # Ray goes on trying
        if "InvalidAuthToken" in driver.errors():
            raise UsageError(f"{expected}, and RAY_AUTH_MODE=token with the token of the cluster") from None
        raise UsageError(f"{expected}; none answers within {seconds:.0f} s") from None
    if message is None:
        raise UsageError(f"--launcher=ray: Ray ended: {driver.last_error()}")
    if word not in message:
        raise UsageError(message.get("refused") or f"--launcher=ray: Ray ended: {message.get('lost')}")


def _done_unheard(cell: Cell) -> Ended | None:
    """How a cell ended, if it is done and the driver did not hear of it."""
    ended = read_ended(cell)
    return ended if ended and ended.code in (DONE, DIVERGED) else None


def driver_variables(address: str | None, variables: Mapping[str, str]) -> dict[str, str]:
    """Variables for the process that connects to a cluster, or starts one (None)."""
    if address:
        return {}
    quiet = {"RAY_USAGE_STATS_ENABLED": "0"}  # else the cluster reports to Ray's authors
    if "RAY_AUTH_MODE" in variables:
        return quiet
    # Else others on the network could run code in it; and Ray would leave its token in the user's home folder, where
    # clusters of the user's own would find it.
    return quiet | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}


def forwarded_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """The variables that cells have from the sweep: where Python finds modules, and how JAX computes."""
    return {name: value for name, value in variables.items() if name == "PYTHONPATH" or name.startswith(FORWARDED)}


def make(text: str, out: Path) -> RayLauncher:
    """The launcher of `--launcher=ray --ray=TEXT`.

    Raises:
      UsageError: Ray is not installed, or an option or the variable RAY_ADDRESS is invalid.
    """
    if not importlib.util.find_spec("ray"):
        raise UsageError("--launcher=ray: expects the package ray; pip install 'sqt_jax[ray]'")
    address = os.environ.get("RAY_ADDRESS") or None
    if address and "://" in address:
        raise UsageError(f"RAY_ADDRESS={address}: expects HOST:PORT of a cluster that this machine belongs to, or auto")
    return RayLauncher(parse(text), out, address)
