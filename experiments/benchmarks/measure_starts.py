"""How long a run takes to start: `python -m experiments.bench --suites=starts --tasks=humanoid --physics=mjx`.

A whole run of one step of warm-up and one of training (batches of two rows), as a process: Python's imports, the
compilation of evaluation, warm-up and training, two evaluations of one episode, and the policy. First with an empty
compilation cache (cold), then with the cache that this left (warm).
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from experiments.benchmarks.measurements import SECONDS, Measurement
from experiments.benchmarks.part_process import output_of

FLAGS = ("--steps=2", "--warmup_steps=1", "--batch_size=2", "--eval_every=2", "--eval_episodes=1")
NO_FILES = ("--checkpoint_every=0", "--notensorboard", "--quiet")


def bench_starts(
    algo: str,
    task: str,
    members: int,
    physics: str,
    run: Callable[[Sequence[str], Mapping[str, str]], Any] = output_of,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Measurement]:
    """Seconds of a cold start, then of a warm one.

    Args:
      run: as `part_process.output_of`.
    """
    seeds = ",".join(map(str, range(members)))
    command = [sys.executable, "-m", "experiments.run", f"--algo={algo}", f"--env={task}", f"--physics={physics}"]
    with tempfile.TemporaryDirectory() as folder:
        for start in ("cold", "warm"):
            began = clock()
            run(
                [*command, f"--seeds={seeds}", f"--out={folder}/{start}", *FLAGS, *NO_FILES],
                {**os.environ, "JAX_COMPILATION_CACHE_DIR": f"{folder}/cache"},
            )
            what = f"{algo} on {task}, {physics}, {start}"
            yield Measurement(suite="starts", what=what, members=members, unit=SECONDS, rate=clock() - began)
