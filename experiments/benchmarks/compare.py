"""This project beside others on the same machine, in turns: `python -m experiments.bench --compare=sbx`.

A peer that trains one seed has two ways to train several: one after the other, or as processes side by side. Both are
measured. Processes side by side have the cores shared out among them.
"""

import functools
import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.measure import Case, Failure, Made, Row, in_turns, loop_steps, updates
from sqt_jax import envs
from sqt_jax.envs import gym_table
from sqt_jax.envs.physics.threads import usable_cores
from sqt_jax.members import usable_devices

PEERS = Path(__file__).parent / "peers"
# What a peer's programs import, by which it is known to be there.
NEEDS = {"sbx": "sbx", "torch": "torch"}
INSTALL = {"sbx": "sbx-rl (pip install sbx-rl)", "torch": "torch (pip install torch)"}
# Which of our algorithms a peer has too.
ALGORITHMS = {"sbx": ("td3", "sac"), "torch": ("td7",)}
UNITS = {"sbx": "env steps", "torch": "member updates"}
PER_CORE = 2  # processes at most


class Peer:
    """A peer's program as some processes side by side; `peer(steps)` returns when each has made so many.

    Raises:
      RuntimeError: it could not be started, or it ended; with the last line of what it wrote to stderr.
    """

    def __init__(
        self, interpreter: str, program: str, arguments: Sequence[Any], processes: int, env: Mapping[str, str]
    ):
        self.program = program
        self.processes: list[subprocess.Popen] = []
        self.folder = tempfile.TemporaryDirectory()  # what each process writes to stderr
        command = [interpreter, str(PEERS / program), *map(str, arguments)]
        try:
            for seed, cores in enumerate(shares(our_cores(), processes)):
                with bound_to(cores), self._errors(seed).open("w") as errors:
                    process = subprocess.Popen(
                        [*command, str(seed)],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        stderr=errors,
                        text=True,
                        errors="replace",
                        env={**env, "OMP_NUM_THREADS": str(len(cores))},  # PyTorch's
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
        """For this line; what else a program prints is no answer."""
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
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(usable_cores()))


def shares(cores: Sequence[int], processes: int) -> list[list[int]]:
    """The cores of each process: of its own, or one in turn where there are more processes than cores."""
    if processes > len(cores):
        return [[cores[index % len(cores)]] for index in range(processes)]
    bounds = [len(cores) * index // processes for index in range(processes + 1)]
    return [list(cores[start:stop]) for start, stop in pairwise(bounds)]


@contextmanager
def bound_to(cores: Sequence[int]) -> Iterator[None]:
    """A process that is started inside runs on these cores alone, with all its threads: it inherits them from this one.

    Its own libraries count the cores that they may use by it. Nothing where the system cannot bind (macOS).
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


def lacks(peer: str, interpreter: str) -> bool:
    """Whether the interpreter is none, or cannot import what the peer is made of."""
    try:
        return subprocess.run([interpreter, "-c", f"import {NEEDS[peer]}"], capture_output=True).returncode != 0
    except OSError:
        return True


def ways(members: int) -> list[int]:
    """How many processes train that many seeds: one after the other, as many as there are cores, all at once.

    Of the last as many as the cores may bear.
    """
    cores = usable_cores()
    return sorted({1, min(members, cores), min(members, PER_CORE * cores)})


def together(seeds: int, processes: int, rates: Mapping[int, float]) -> float:
    """Steps per second of all seeds, trained in full rounds of so many processes side by side and a round of the rest.

    Args:
      rates: processes side by side -> steps per second of one of them.
    """
    rounds, rest = divmod(seeds, processes)
    seconds = rounds / rates[processes] + (1 / rates[rest] if rest else 0.0)  # in which each seed makes a step
    return seeds / seconds


def compare(
    peer: str,
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    interpreter: str,
    environment: Mapping[str, str],
    **timing: Any,
) -> Iterator[Row | Failure]:
    """Rows of one algorithm: SBX's whole training loop beside ours on each physics; PyTorch's update beside ours.

    Args:
      members: seeds that are trained.
      interpreter: the Python that has what the peer imports.
      environment: variables of its processes.
    """

    def row(name: str, count: int, rate: float = 0.0, devices: int = 1) -> Row:
        return Row("compare", f"{algo} on {task}, {name}", count, UNITS[peer], rate, devices=devices)

    spread = usable_devices(members)  # ours, as those of a run
    if peer == "sbx":
        program, arguments = "sbx_loop.py", [algo, gym_table.TASKS[task].gymnasium_id]
        loops = {name: functools.partial(loop_steps, algo, task, members, name, spread) for name in physics}
        ours = [Case(row(f"sqt_jax, {name}", members, devices=spread), make) for name, make in loops.items()]
    else:
        env = envs.make(task)
        device = "cpu" if jax.default_backend() == "cpu" else "cuda"  # as ours
        program, arguments = "torch_td7.py", [str(env.observation_size), str(env.action_size), device]
        update = functools.partial(updates, algo, task, members, spread)
        ours = [Case(row("sqt_jax", members, devices=spread), update)]
    counts = ways(members)
    rests = {members % count for count in counts} - {0}
    rates: dict[int, float] = {}
    with ExitStack() as stack:

        def start(count: int) -> Made:
            return Made(stack.enter_context(closing(Peer(interpreter, program, arguments, count, environment))))

        needed = sorted({*counts, *rests})
        theirs = [Case(row(_name(peer, count), count), functools.partial(start, count)) for count in needed]
        for found in in_turns([*ours, *theirs], **timing):
            if isinstance(found, Failure) or "sqt_jax" in found.what:
                yield found
            else:
                rates[found.members] = found.rate / found.members
    for count in counts:
        if {count, members % count} - {0} <= rates.keys():
            name = peer if members == 1 else _name(peer, count)
            yield row(name, members, together(members, count, rates))


def _name(peer: str, processes: int) -> str:
    return f"{peer}, {processes} processes" if processes > 1 else f"{peer}, one after the other"


def ratios(rows: Sequence[Row]) -> list[str]:
    """Each of our rows against the best of the peer's for the same algorithm, task and members."""
    lines = []
    for row in rows:
        case, _, name = row.what.partition(", ")
        if row.suite == "compare" and name.startswith("sqt_jax"):
            same = [other for other in rows if other.suite == "compare" and other.members == row.members]
            theirs = [other for other in same if other.what.startswith(f"{case}, ") and "sqt_jax" not in other.what]
            if theirs:
                best = max(theirs, key=lambda other: other.rate)
                ratio = f"{row.rate / best.rate:.2f}"
                lines.append(f"{row.what}, {row.members} members / {best.what.partition(', ')[2]} = {ratio}")
    return lines
