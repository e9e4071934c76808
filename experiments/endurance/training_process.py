"""A small training in a process of its own, which can kill itself at a file event."""

import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from experiments import run
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.types import Environment

TASKS = ("tiny", "ant")
# With a replay that is overwritten, and with a single checkpoint.
COMMON = "--seeds=0,1 --hidden=16,16 --batch_size=16 --replay_capacity=100 --keep_checkpoints=1 --quiet --name=run"
SETTINGS = {
    "tiny": "--steps=160 --warmup_steps=40 --eval_every=70 --eval_episodes=2 --checkpoint_every=20",
    "ant": "--env=ant --steps=240 --warmup_steps=40 --eval_every=100 --eval_episodes=1 --checkpoint_every=40",
}
DEADLINE = 600  # seconds for one process


class Job(NamedTuple):
    """A training, and the folder for its files."""

    task: str  # of TASKS
    algo: str
    folder: Path

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self.folder / self.task / self.algo / "run"

    def command(self) -> list[str]:
        """The arguments of `run.main`, which start the run or resume it."""
        words = f"--algo={self.algo} --out={self.folder} {COMMON} {SETTINGS[self.task]} --resume".split()
        return ["run", *words, *(["--embedding_size=16"] if ALGORITHMS[self.algo].settings.get("networks") else [])]


def tiny_env() -> Environment:
    """A point pushed left and right, with random starts and episodes that terminate. It compiles quickly."""

    def start(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return state, state

    def advance(state: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        velocity = 0.9 * state[1] + 0.2 * action[0]
        state = jnp.stack([state[0] + 0.2 * velocity, velocity])
        return state, state, 1.0 - jnp.abs(state[0]), jnp.abs(state[0]) > 1.5

    return make_environment("tiny", 2, 1, 25, start, advance)


def start(job: Job, die_at: int | None = None, count_into: Path | None = None) -> Any:
    """Starts a process that trains `job`.

    Args:
      die_at: the process kills itself at this file event in the run's folder, counted from 1.
      count_into: a file for the number of file events.
    """
    # Forked from a server that has imported everything and computed nothing: the process starts quickly.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["experiments.run", "experiments.running.session"])
    process = context.Process(target=_train, args=(job, die_at, count_into))
    process.start()
    return process


def _train(job: Job, die_at: int | None, count_into: Path | None) -> None:
    descriptor = os.open(job.folder / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    events = 0

    def watch(event: str, arguments: tuple) -> None:
        nonlocal events
        if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir") and str(job.path) in str(arguments[0]):
            events += 1
            if events == die_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    code = run.main(job.command(), tiny_env() if job.task == "tiny" else None)
    if count_into:
        count_into.write_text(str(events))
    os._exit(code)


def finish(process: Any) -> int:
    """Waits for a process and returns its exit code.

    Raises:
      TimeoutError: it did not end within `DEADLINE` seconds, and was killed.
    """
    process.join(DEADLINE)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"a process ran for more than {DEADLINE} s")
    return process.exitcode


def wait_for_tables(process: Any, job: Job) -> None:
    """Returns when the run has its first table, or has ended."""
    deadline = time.monotonic() + DEADLINE
    while process.is_alive() and not (job.path / "evaluations.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.02)


def last_line(job: Job) -> str:
    """The last line that the job's processes have printed."""
    lines = (job.folder / "log.txt").read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"
