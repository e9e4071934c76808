"""Throughput of each part: `python -m experiments.bench --suites=env,update,loop --members=1,5`.

Each figure is the median over `--repeats` timed calls of a compiled loop that runs for about `--seconds`, after a
first call that compiles. The suites of one process run one after the other; compare figures of one run only, since a
machine's speed changes with what else it does.
"""

import dataclasses
import functools
import itertools
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from absl import app, flags, logging
from rich.console import Console
from rich.table import Table

from experiments import runtime
from sqt_jax import algorithms, envs, lap, replay, rollout, train
from sqt_jax.types import Array, Transition

SUITES = ("env", "update", "replay", "loop")
BATCH = 256
FLAGS = flags.FLAGS
flags.DEFINE_list("suites", list(SUITES), f"What to measure: {', '.join(SUITES)}.")
PAPERS_TASKS = ["cheetah", "walker", "ant", "humanoid"]
flags.DEFINE_list("tasks", PAPERS_TASKS, "Tasks; the suite replay takes the rows of the first one.")
flags.DEFINE_list("physics", list(envs.PHYSICS), "Physics of the suites env and loop.")
flags.DEFINE_list("algos", ["td3", "sac", "td7"], "Algorithms of the suites update and loop.")
flags.DEFINE_list("members", ["1", "5"], "Numbers of members.")
flags.DEFINE_list("capacities", ["10000", "1000000"], "Capacities of the suite replay.")
flags.DEFINE_integer("repeats", 5, "Timed calls per figure; the median counts.", lower_bound=1)
flags.DEFINE_float("seconds", 1.0, "About how long one timed call runs.", lower_bound=0.0)
flags.DEFINE_string("json", "", "Also write the rows to this file.")


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure. `rate` counts the unit in all members together, per second."""

    suite: str
    what: str
    members: int
    unit: str
    rate: float
    compile_seconds: float


def measure(run: Callable[[int], Any], seconds: float, repeats: int) -> tuple[float, float]:
    """Iterations per second of `run(iterations)` (median), and the seconds of the first call, which compiles."""

    def timed(iterations: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(run(iterations))
        return time.perf_counter() - start

    compile_seconds = timed(1)
    iterations = 1
    while (elapsed := timed(iterations)) < seconds / 4:
        iterations = min(iterations * 10, max(iterations + 1, int(iterations * seconds / max(elapsed, 1e-9))))
    iterations = max(1, round(iterations * seconds / elapsed))
    return statistics.median(iterations / timed(iterations) for _ in range(repeats)), compile_seconds


def member_keys(members: int) -> Array:
    return jax.vmap(jax.random.key)(jnp.arange(members))


def bench_env(task: str, members: int, physics: str, **timing: Any) -> Row:
    """Environment steps with random actions, automatic restarts included."""
    env = envs.make(task, physics)

    def step(timestep, key):
        def policy(_):
            return rollout.uniform_actions(key, 1, env.action_size)

        return rollout.step(env, timestep, policy)[0]

    @jax.jit
    def run(timestep, keys, steps):
        def body(i, timestep):
            return jax.vmap(step)(timestep, jax.vmap(jax.random.fold_in, (0, None))(keys, i))

        return jax.lax.fori_loop(0, steps, body, timestep)

    keys = member_keys(members)
    start = jax.jit(jax.vmap(lambda key: rollout.reset(env, key, 1)))(keys)
    rate, compile_seconds = measure(lambda steps: run(start, keys, steps), **timing)
    return Row("env", f"{task}, {physics}", members, "env steps", rate * members, compile_seconds)


def bench_update(algo: str, task: str, members: int, **timing: Any) -> Row:
    """Updates on one fixed batch: the learner alone, without environment and replay."""
    config = algorithms.make_config(algo, task)
    env = envs.make(task)
    agent = algorithms.agent_of(config, env)
    size = config.train.batch_size

    def random_batch(key):
        obs, action, reward, next_obs = (
            jax.random.normal(k, shape)
            for k, shape in zip(
                jax.random.split(key, 4),
                [(size, env.observation_size), (size, env.action_size), (size,), (size, env.observation_size)],
                strict=True,
            )
        )
        return Transition(obs, jnp.tanh(action), reward, next_obs, jnp.ones(size))

    example = jax.eval_shape(agent.init, jax.random.key(0))
    axes = train.member_axes(example)
    update = jax.vmap(agent.update, in_axes=(axes, 0, 0), out_axes=(axes, 0, 0))

    @jax.jit
    def run(state, batch, keys, steps):
        def body(i, state):
            return update(state, batch, jax.vmap(jax.random.fold_in, (0, None))(keys, i))[0]

        return jax.lax.fori_loop(0, steps, body, state)

    keys = member_keys(members)
    state, batch = jax.jit(jax.vmap(agent.init, out_axes=axes))(keys), jax.vmap(random_batch)(keys)
    rate, compile_seconds = measure(lambda steps: run(state, batch, keys, steps), **timing)
    return Row("update", f"{algo}, {task} sizes", members, "member updates", rate * members, compile_seconds)


REPLAYS = {"uniform": replay.uniform, "lap": lap.lap}


def bench_replay(kind: str, what: str, task: str, capacity: int, members: int, **timing: Any) -> Row:
    """One insert of a row, or one sampled batch and what it feeds back, on a full buffer."""
    env = envs.make(task)
    store = REPLAYS[kind](capacity, BATCH, env.observation_size, env.action_size)
    axes = train.member_axes(jax.eval_shape(store.init))
    obs, action, scalar = jnp.ones((1, env.observation_size)), jnp.zeros((1, env.action_size)), jnp.ones(1)

    def insert(state, total, key, step):
        return store.insert(state, Transition(obs, action, scalar, obs, scalar)), total

    def sample(state, total, key, step):
        batch, rows = store.sample(state, key)
        state = store.feedback(state, rows, jax.random.uniform(key, (BATCH,), maxval=3.0), step + 1)
        return state, total + jnp.sum(batch.obs)

    one = jax.vmap({"insert": insert, "sample": sample}[what], in_axes=(axes, 0, 0, None), out_axes=(axes, 0))

    def loop(step_of, state, total, keys, steps):
        def body(i, carry):
            return step_of(*carry, jax.vmap(jax.random.fold_in, (0, None))(keys, i), i)

        return jax.lax.fori_loop(0, steps, body, (state, total))

    run = jax.jit(functools.partial(loop, one), donate_argnums=0)
    fill = jax.jit(functools.partial(loop, jax.vmap(insert, in_axes=(axes, 0, 0, None), out_axes=(axes, 0))))
    keys, total = member_keys(members), jnp.zeros(members)
    state, _ = fill(jax.jit(jax.vmap(lambda _: store.init(), out_axes=axes))(keys), total, keys, capacity)

    def once(steps):
        nonlocal state
        state, total = run(state, jnp.zeros(members), keys, steps)
        return total

    rate, compile_seconds = measure(once, **timing)
    name = f"{kind} {what}, {task} rows, capacity {capacity:,}"
    return Row("replay", name, members, f"{what}s", rate * members, compile_seconds)


def bench_loop(algo: str, task: str, members: int, physics: str, **timing: Any) -> Row:
    """The whole training loop: environment step, insert, sample, update."""
    config = algorithms.make_config(algo, task, replay_capacity=100_000, physics=physics)
    sweep = train.make_sweep(algorithms.make_trainer(config))
    scalars = jax.tree.map(lambda value: jnp.full(members, value), config.agent.scalars())
    state = sweep.init(member_keys(members), scalars)
    start = time.perf_counter()
    state = jax.block_until_ready(sweep.advance(state, 1, False))
    compile_seconds = time.perf_counter() - start
    state = sweep.advance(state, 299, False)

    def once(steps):
        nonlocal state
        state = sweep.advance(state, steps, True)
        return state.env_steps

    rate, _ = measure(once, **timing)
    return Row("loop", f"{algo} on {task}, {physics}", members, "env steps", rate * members, compile_seconds)


def check_flags() -> None:
    """Leaves with one line that names the first flag with a value that cannot be."""
    known = {"suites": SUITES, "tasks": envs.TASKS, "algos": algorithms.ALGORITHMS, "physics": envs.PHYSICS}
    for name, values in known.items():
        for value in getattr(FLAGS, name):
            if value not in values:
                sys.exit(f"--{name}: takes some of {', '.join(values)}, not {value!r}")
    for name in ("members", "capacities"):
        for value in getattr(FLAGS, name):
            if not value.isdecimal() or int(value) < 1:
                sys.exit(f"--{name}: takes whole numbers of at least 1, not {value!r}")


def rows(suites: Sequence[str], **timing: Any) -> Iterator[Row]:
    tasks, algos, physics = FLAGS.tasks, FLAGS.algos, FLAGS.physics
    members = [int(value) for value in FLAGS.members]
    for suite in suites:
        for count in members:
            if suite == "env":
                yield from (bench_env(task, count, name, **timing) for task in tasks for name in physics)
            elif suite == "update":
                yield from (bench_update(algo, task, count, **timing) for algo in algos for task in tasks)
            elif suite == "replay":
                yield from (
                    bench_replay(kind, what, tasks[0], int(size), count, **timing)
                    for kind in REPLAYS
                    for what in ("insert", "sample")
                    for size in FLAGS.capacities
                )
            elif suite == "loop":
                cases = itertools.product(algos, tasks, physics)
                yield from (bench_loop(algo, task, count, name, **timing) for algo, task, name in cases)


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = f"{len(names)} x {names[0]}" if names else cpu
    device = jax.devices()[0]
    return {"cpu": cpu, "device": f"{device.platform}: {device.device_kind}", "jax": jax.__version__}


def markdown(all_rows: Sequence[Row]) -> str:
    lines = ["| suite | what | members | rate | unit | compile s |", "|---|---|---|---|---|---|"]
    for r in all_rows:
        lines.append(f"| {r.suite} | {r.what} | {r.members} | {r.rate:,.0f} | {r.unit}/s | {r.compile_seconds:.1f} |")
    return "\n".join(lines)


def main(argv: Sequence[str]) -> None:
    del argv
    check_flags()
    logging.set_verbosity(logging.WARNING)
    runtime.prepare()
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are figures here
    console = Console()
    console.print(", ".join(f"{key}: {value}" for key, value in machine().items()), highlight=False)
    found = []
    for row in rows(FLAGS.suites, seconds=FLAGS.seconds, repeats=FLAGS.repeats):
        found.append(row)
        console.print(f"{row.suite}: {row.what}, {row.members} members: {row.rate:,.0f} {row.unit}/s", highlight=False)
    table = Table("suite", "what", "members", "rate", "unit", "compile s", title="median of repeats")
    for r in found:
        cells = (str(r.members), f"{r.rate:,.0f}", f"{r.unit}/s", f"{r.compile_seconds:.1f}")
        table.add_row(r.suite, r.what, *cells)
    console.print(table)
    print(markdown(found))
    if FLAGS.json:
        report = {"machine": machine(), "rows": [dataclasses.asdict(row) for row in found]}
        Path(FLAGS.json).write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    app.run(main)
