"""Programs of other implementations (`benchmarks.peers`) as processes, each bound to its share of the cores."""

import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

from sqt_jax.job_limits import usable_cores

PEERS = Path(__file__).parent / "peers"


class PeerProcesses:
    """A peer's program as several processes in parallel; `peer(steps)` returns when each has made `steps` steps.

    Args:
      interpreter: the Python that runs the program.
      program: a file in `PEERS`.
      arguments: of the program; the seed, from 0, is appended.
      processes: their number.
      env: their environment variables.

    Raises:
      RuntimeError: a process did not start or has ended; the text has the last line of its stderr.
    """

    def __init__(
        self, interpreter: str, program: str, arguments: Sequence[Any], processes: int, env: Mapping[str, str]
    ):
        self.program = program
        self.processes: list[subprocess.Popen] = []
        self.folder = tempfile.TemporaryDirectory()  # the stderr of each process
        command = [interpreter, str(PEERS / program), *map(str, arguments)]
        try:
            for seed, cores in enumerate(core_shares(our_cores(), processes)):
                with bound_to(cores), self._errors(seed).open("w") as errors:
                    process = subprocess.Popen(
                        [*command, str(seed)],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        stderr=errors,
                        text=True,
                        errors="replace",
                        env={**env, "OMP_NUM_THREADS": str(len(cores))},  # PyTorch's threads
                    )
                self.processes.append(process)
            for process in self.processes:
                self._wait(process, "ready")
        except BaseException:
            self.close()
            raise

    def __call__(self, steps: int) -> None:
        for process in self.processes:
            assert process.stdin
            try:
                process.stdin.write(f"{steps}\n")
                process.stdin.flush()
            except OSError:
                raise self._ended(process) from None
        for process in self.processes:
            self._wait(process, "done")

    def close(self) -> None:
        """Kills the processes."""
        self._stop()
        self.folder.cleanup()

    def _stop(self) -> None:
        for process in self.processes:
            process.kill()
            with suppress(OSError), process:  # closes its pipes, and waits for it
                pass

    def _errors(self, seed: int) -> Path:
        return Path(self.folder.name) / str(seed)

    def _wait(self, process: subprocess.Popen, answer: str) -> None:
        """Waits for this line; other output is ignored."""
        assert process.stdout
        for line in process.stdout:
            if line == f"{answer}\n":
                return
        raise self._ended(process)

    def _ended(self, process: subprocess.Popen) -> RuntimeError:
        self._stop()
        text = self._errors(self.processes.index(process)).read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        self.close()
        return RuntimeError(f"{self.program} ended: {lines[-1] if lines else 'it wrote no error'}")


def our_cores() -> list[int]:
    """The numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(usable_cores()))


def core_shares(cores: Sequence[int], processes: int) -> list[list[int]]:
    """The cores of each process: several of its own, or one shared core if there are more processes than cores."""
    if processes > len(cores):
        return [[cores[index % len(cores)]] for index in range(processes)]
    bounds = [len(cores) * index // processes for index in range(processes + 1)]
    return [list(cores[start:stop]) for start, stop in pairwise(bounds)]


@contextmanager
def bound_to(cores: Sequence[int]) -> Iterator[None]:
    """Processes started inside run only on these cores: they inherit the binding from this process.

    Libraries that count their cores see only these. No effect if the system cannot bind processes (macOS).
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
