"""One run of many members against several runs side by side: `python -m experiments.bench --suites=batches`.

Whole runs in processes of their own, with start and compilation, as the batches of `experiments.tune`.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence

from experiments.benchmarks.measurements import Measurement

PROCESSES = (1, 8)
STEPS, WARMUP_STEPS = 2_000, 500
FLAGS = (f"--steps={STEPS}", f"--warmup_steps={WARMUP_STEPS}", f"--eval_every={STEPS}", "--eval_episodes=1")
NO_FILES = ("--checkpoint_every=0", "--notensorboard", "--quiet")


def run_together(commands: Sequence[Sequence[str]]) -> None:
    """Runs commands side by side to their end. Raises `RuntimeError` with the last line of one that fails."""
    started = [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) for command in commands
    ]
    ended = [(process.communicate()[1], process.returncode) for process in started]
    for errors, code in ended:
        if code:
            raise RuntimeError((errors.strip().splitlines() or [f"a run ended with exit code {code}"])[-1])


def bench_batches(
    algo: str,
    task: str,
    members: int,
    physics: str,
    run: Callable[[Sequence[Sequence[str]]], None] = run_together,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Measurement]:
    """Members per second, trained in one process and in several that share them.

    Args:
      run: as `run_together`.
    """
    for processes in PROCESSES:
        if members % processes:
            raise ValueError(f"expects a multiple of {processes} members, not {members}")
        share = members // processes
        with tempfile.TemporaryDirectory() as out:
            commands = [
                [sys.executable, "-m", "experiments.run", f"--algo={algo}", f"--env={task}", f"--physics={physics}"]
                + [f"--seeds={','.join(map(str, range(index * share, (index + 1) * share)))}", f"--out={out}"]
                + [f"--name={index}", *FLAGS, *NO_FILES]
                for index in range(processes)
            ]
            began = clock()
            run(commands)
            seconds = clock() - began
        how = "one process" if processes == 1 else f"{processes} processes of {share}"
        what = f"{algo} on {task}, {physics}, {STEPS:,} steps, {how}: {seconds:.0f} s"
        yield Measurement(suite="batches", what=what, members=members, unit="members", rate=members / seconds)
