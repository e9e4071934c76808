"""This project beside others on the same machine, in turns: `python -m experiments.bench --compare=sbx`.

A peer that trains one seed has two ways to train several: one after the other, or as processes side by side. Both are
measured.
"""

import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from experiments.measure import Row, loop_steps, updates
from experiments.timing import measure_in_turns
from sqt_jax import envs
from sqt_jax.cores import usable_cores
from sqt_jax.envs import gym_table

PEERS = Path(__file__).parent / "peers"
# What a peer's programs import, by which it is known to be there.
NEEDS = {"sbx": "sbx", "torch": "torch"}
INSTALL = {"sbx": "sbx-rl (pip install sbx-rl)", "torch": "torch (pip install torch)"}
# Which of our algorithms a peer has too.
ALGORITHMS = {"sbx": ("td3", "sac"), "torch": ("td7",)}


class Peer:
    """A peer's program as some processes side by side; `peer(steps)` returns when each has made so many.

    Raises:
      RuntimeError: it could not be started, or it ended.
    """

    def __init__(
        self, interpreter: str, program: str, arguments: Sequence[Any], processes: int, env: Mapping[str, str]
    ):
        began = time.perf_counter()
        threads = max(1, usable_cores() // processes)
        command = [interpreter, str(PEERS / program), *map(str, arguments)]
        self.processes = [
            subprocess.Popen(
                [*command, str(seed)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**env, "OMP_NUM_THREADS": str(threads)},
            )
            for seed in range(processes)
        ]
        for process in self.processes:
            self._wait(process)
        self.start_seconds = time.perf_counter() - began

    def __call__(self, steps: int) -> None:
        for process in self.processes:
            assert process.stdin
            process.stdin.write(f"{steps}\n")
            process.stdin.flush()
        for process in self.processes:
            self._wait(process)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()

    def _wait(self, process: subprocess.Popen) -> None:
        assert process.stdout
        if not process.stdout.readline():
            self.close()
            raise RuntimeError(f"the peer's program ended: {process.args!r}")


def lacks(peer: str, interpreter: str) -> bool:
    """Whether the interpreter is none, or cannot import what the peer is made of."""
    try:
        return subprocess.run([interpreter, "-c", f"import {NEEDS[peer]}"], capture_output=True).returncode != 0
    except OSError:
        return True


def ways(members: int) -> list[int]:
    """How many processes train that many seeds: one after the other, as many as there are cores, all at once."""
    return sorted({1, min(members, usable_cores()), members})


def compare(
    peer: str,
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    interpreter: str,
    environment: Mapping[str, str],
    **timing: Any,
) -> Iterator[Row]:
    """Rows of one algorithm: SBX's whole training loop beside ours on each physics; PyTorch's update beside ours.

    Args:
      members: seeds that are trained.
      interpreter: the Python that has what the peer imports.
      environment: variables of its processes.
    """
    env = envs.make(task)
    if peer == "sbx":
        program, arguments, unit = "sbx_loop.py", [algo, gym_table.TASKS[task].gymnasium_id], "env steps"
        ours = {f"sqt_jax, {name}": loop_steps(algo, task, members, name) for name in physics}
    else:
        program, arguments, unit = "torch_td7.py", [str(env.observation_size), str(env.action_size)], "member updates"
        ours = {"sqt_jax": (updates(algo, task, members)[0], 0.0)}
    runs = {name: (run, seconds, members) for name, (run, seconds) in ours.items()}
    with ExitStack() as stack:
        for count in ways(members):
            theirs = stack.enter_context(closing(Peer(interpreter, program, arguments, count, environment)))
            name = (
                f"{peer}, {count} processes" if count > 1 else f"{peer}, one after the other" if members > 1 else peer
            )
            runs[name] = (theirs, theirs.start_seconds, count)
        rates = measure_in_turns([run for run, _, _ in runs.values()], **timing)
    for (name, (_, seconds, count)), (rate, _) in zip(runs.items(), rates, strict=True):
        yield Row("compare", f"{algo} on {task}, {name}", members, unit, rate * count, seconds)


def ratios(rows: Sequence[Row]) -> list[str]:
    """Each of our rows against the best of the peer's for the same algorithm, task and members."""
    lines = []
    for row in rows:
        case, _, name = row.what.partition(", ")
        if row.suite == "compare" and name.startswith("sqt_jax"):
            same = [other for other in rows if other.suite == "compare" and other.members == row.members]
            theirs = [other for other in same if other.what.startswith(f"{case}, ") and "sqt_jax" not in other.what]
            best = max(theirs, key=lambda other: other.rate)
            lines.append(
                f"{row.what}, {row.members} members / {best.what.partition(', ')[2]} = {row.rate / best.rate:.2f}"
            )
    return lines
