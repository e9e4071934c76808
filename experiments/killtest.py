"""Does a run survive being killed? `python -m experiments.killtest --kills=50`.

Trains once without a break. Then kills training again and again (SIGKILL), at random moments and inside the writing of
checkpoints and of the other files of a run, goes on with `--resume`, and compares what is left in the end: every array
of the training state bit for bit, the replay's rows, and the rows of both tables but for their times. One training in
five is killed a second time.
"""

import csv
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags, logging

from experiments import run
from experiments.running import run_config
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.types import Environment

FLAGS = flags.FLAGS
TASKS = ("tiny", "ant")
# The replay's ring goes round, and one checkpoint alone is kept.
COMMON = "--seeds=0,1 --hidden=16,16 --batch_size=16 --replay_capacity=100 --keep_checkpoints=1 --quiet --name=run"
SETTINGS = {
    "tiny": "--steps=160 --warmup_steps=40 --eval_every=70 --eval_episodes=2 --checkpoint_every=20",
    "ant": "--steps=240 --warmup_steps=40 --eval_every=100 --eval_episodes=1 --checkpoint_every=40",
}
DEADLINE = 600  # seconds for one process


class Job(NamedTuple):
    """A training that is killed and gone on with."""

    task: str
    algo: str
    folder: Path

    @property
    def path(self) -> Path:
        return self.folder / "ant" / self.algo / "run"

    def command(self) -> list[str]:
        words = f"--algo={self.algo} --env=ant --out={self.folder} {COMMON} {SETTINGS[self.task]} --resume".split()
        return ["run", *words, *(["--embedding_size=16"] if ALGORITHMS[self.algo].settings.get("networks") else [])]


class Reference(NamedTuple):
    """The training without a break."""

    result: dict[str, Any]
    seconds: float  # from the first table to the end
    file_events: int  # in the run's folder


def tiny_env() -> Environment:
    """A point that is pushed to and fro, with random starts and episodes that terminate: nothing to compile."""

    def start(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return state, state

    def advance(state: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        velocity = 0.9 * state[1] + 0.2 * action[0]
        state = jnp.stack([state[0] + 0.2 * velocity, velocity])
        return state, state, 1.0 - jnp.abs(state[0]), jnp.abs(state[0]) > 1.5

    return make_environment("tiny", 2, 1, 25, start, advance)


def result_of(path: Path) -> dict[str, Any]:
    """All that a finished run left and that must not depend on its breaks, by name."""
    import orbax.checkpoint

    folder = max((path / "checkpoint").glob("step_*"))
    members = len(run_config.read(path).members)
    result: dict[str, Any] = dict(orbax.checkpoint.PyTreeCheckpointer().restore((folder / "state").absolute()))
    rows = []
    for file in sorted((path / "checkpoint").glob("rows_*.bin")):
        start, stop = (int(word) for word in file.stem.split("_")[1:])
        rows.append(np.fromfile(file, np.float32).reshape(members, stop - start, -1))
    # Of earlier ones a file may be left.
    result["rows"] = np.concatenate(rows, axis=1)[:, -run_config.read(path).content["replay_rows"] :]
    for name in ("evaluations", "metrics"):
        with (path / f"{name}.csv").open(newline="") as table:
            result[name] = [
                {column: value for column, value in row.items() if column != "wall_seconds"}
                for row in csv.DictReader(table)
            ]
    return result


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names of what is not the same in both, bit for bit."""
    return [name for name in one.keys() | other.keys() if not _same(one.get(name), other.get(name))]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list):
        return a == b
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def child(job: Job, die_at: int | None, count_into: Path | None) -> None:
    """A process of its own: trains, and kills itself at the `die_at`-th file event in the run's folder."""
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


def start(job: Job, die_at: int | None = None, count_into: Path | None = None) -> Any:
    # Forked from a server that has imported everything and computed nothing: a process starts in no time.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["experiments.run", "experiments.running.plan", "experiments.evidence.figures"])
    process = context.Process(target=child, args=(job, die_at, count_into))
    process.start()
    return process


def finish(process: Any) -> int:
    """The exit code of a process, which is given `DEADLINE` seconds."""
    process.join(DEADLINE)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"a process took more than {DEADLINE} s")
    return process.exitcode


def reference(task: str, algo: str, folder: Path) -> Reference:
    """Trains without a break, twice: compiled programs come from the cache the second time, as they do after a kill.

    Raises:
      RuntimeError: that fails already, or the two differ.
    """
    first, second = (_whole(task, algo, folder.with_name(f"{folder.name}_{number}")) for number in (1, 2))
    wrong = differences(first.result, second.result)
    if wrong:
        raise RuntimeError(f"{task} {algo}: the same command twice differs in {', '.join(sorted(wrong))}")
    return second


def _whole(task: str, algo: str, folder: Path) -> Reference:
    job, counted = Job(task, algo, folder), folder / "events.txt"
    folder.mkdir()
    process = start(job, count_into=counted)
    _wait_for_tables(process, job)
    began = time.monotonic()
    code = finish(process)
    if code:
        raise RuntimeError(f"{task}: training alone ends with {code}: {_end_of_log(job)}")
    return Reference(result_of(job.path), time.monotonic() - began, int(counted.read_text()))


def kill_and_resume(task: str, algo: str, folder: Path, whole: Reference, number: int) -> str:
    """One kill, or two, and what came of it, in a line.

    Raises:
      RuntimeError: the run could not be gone on with, or did not end as the one without a break.
    """
    chance = random.Random(number)
    job = Job(task, algo, folder)
    folder.mkdir()
    told = [_kill(job, chance, whole)]
    if chance.random() < 0.2:
        told.append(_kill_once(job, chance.random() < 0.5, chance.random(), whole) or "not again (it had ended)")
    steps = sorted((job.path / "checkpoint").glob("step_*")) if (job.path / "checkpoint").exists() else []
    last = f"step {int(steps[-1].name[5:15])}" if steps else "none"
    code = finish(start(job))
    if code:
        raise RuntimeError(f"kill {number} ({', '.join(told)}): resuming ends with {code}: {_end_of_log(job)}")
    wrong = differences(whole.result, result_of(job.path))
    if wrong:
        raise RuntimeError(f"kill {number} ({', '.join(told)}): these differ: {', '.join(sorted(wrong))}")
    shutil.rmtree(folder)
    return f"{task} {algo}: killed {', then '.join(told)}; last checkpoint {last}; resumed, identical"


def _kill(job: Job, chance: random.Random, whole: Reference) -> str:
    """Kills a training, and says when; a new one and earlier where it ended before."""
    inside, share = chance.random() < 0.5, chance.random()
    while not (when := _kill_once(job, inside, share, whole)):
        shutil.rmtree(job.path)
        share *= 0.7
    return when


def _kill_once(job: Job, inside: bool, share: float, whole: Reference) -> str | None:
    """Kills one process, `inside` the writing of files or at a moment, and says when; None where it ended before.

    Raises:
      RuntimeError: it ended in another way.
    """
    if inside:
        event = 1 + int(share * whole.file_events)
        process, when = start(job, die_at=event), f"at file event {event}"
    else:
        process, moment = start(job), share * whole.seconds
        _wait_for_tables(process, job)
        process.join(moment)
        process.kill()
        when = f"after {moment:.2f} s"
    code = finish(process)
    if code not in (0, -signal.SIGKILL):
        raise RuntimeError(f"training ends with {code}: {_end_of_log(job)}")
    return when if code else None


def _wait_for_tables(process: Any, job: Job) -> None:
    deadline = time.monotonic() + DEADLINE
    while process.is_alive() and not (job.path / "evaluations.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.02)


def _end_of_log(job: Job) -> str:
    lines = (job.folder / "log.txt").read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def main(argv: Sequence[str]) -> None:
    del argv
    logging.set_verbosity(logging.WARNING)
    for name, known in (("tasks", TASKS), ("algos", ALGORITHMS)):
        for value in getattr(FLAGS, name):
            if value not in known:
                sys.exit(f"--{name}: expects some of {', '.join(known)}, not {value!r}")
    began, failures, done = time.monotonic(), 0, 0
    with tempfile.TemporaryDirectory() as parent, ThreadPoolExecutor(FLAGS.jobs) as pool:
        cases = [(task, algo) for task in FLAGS.tasks for algo in FLAGS.algos]
        for index, (task, algo) in enumerate(cases):
            folder = Path(parent, f"{task}_{algo}")
            folder.mkdir()
            whole = reference(task, algo, folder / "whole")
            print(f"{task} {algo}: without a break {whole.seconds:.1f} s, {whole.file_events} file events", flush=True)
            share = FLAGS.kills // len(cases) + (index < FLAGS.kills % len(cases))
            numbers = [1000 * index + number for number in range(share)]
            tries = [
                pool.submit(kill_and_resume, task, algo, folder / f"kill_{number}", whole, number) for number in numbers
            ]
            for attempt in tries:
                done += 1
                left = (time.monotonic() - began) / done * (FLAGS.kills - done)
                try:
                    line = attempt.result()
                except (RuntimeError, TimeoutError) as error:
                    failures += 1
                    line = f"FAILED {task} {algo}: {error}"
                print(f"{done}/{FLAGS.kills} ({left:.0f} s left) {line}", flush=True)
    print(f"{FLAGS.kills} kills, {FLAGS.kills - failures} resumed to the identical end, {failures} failed")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    flags.DEFINE_integer("kills", 50, "How many trainings are killed.", lower_bound=1)
    flags.DEFINE_list("tasks", list(TASKS), "tiny: a made-up environment; ant: Gymnasium's, on MJX.")
    flags.DEFINE_list("algos", ["td3_sqt", "td7_sqt"], "Algorithms.")
    flags.DEFINE_integer("jobs", 2, "Trainings side by side.", lower_bound=1)
    app.run(main)
