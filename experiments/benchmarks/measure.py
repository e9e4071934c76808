"""The measurements of the benchmark: how fast one part is, compiled as it is used.

What is to be compared is made first and then measured in turns (`in_turns`). A case that fails gives a line that says
why, in place of its row.
"""

import concurrent.futures
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as rollout_c

from experiments.benchmarks import kernels, operations
from experiments.benchmarks.timing import tried_in_turns
from sqt_jax import algorithms, envs, lap, replay, rollout, train
from sqt_jax.config import Config
from sqt_jax.envs import gym_table, gym_tasks
from sqt_jax.envs.physics.threads import usable_cores
from sqt_jax.members import Layout, usable_devices
from sqt_jax.ring import Ring
from sqt_jax.types import Array, Transition

BATCH = 256
MEGABYTES = "MB"
NO_SETTINGS: Mapping[str, Any] = MappingProxyType({})
LOOP_ROWS = 1_000_000  # of the replays of all members together, where a loop is measured
LARGE = (
    8e9  # bytes on the device, of loops that are measured in turns: what expects more is measured one after the other
)
PROFILED = 4  # lockstep steps; the actor learns in half of them


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure. `rate` counts the unit in all members together, per second."""

    suite: str
    what: str
    members: int
    unit: str
    rate: float = 0.0
    compile_seconds: float | None = None  # None: not measured
    operations: float = 0.0  # floating-point, of one unit; 0: not counted
    devices: int = 1
    kinds: tuple[kernels.Kind, ...] | None = None  # what runs on the device, of a lockstep step; None: not profiled
    point: tuple[str, str, int] | None = None  # in a figure of growth: what is varied, the line, the value

    @property
    def figure(self) -> tuple[str, str]:
        """The rate and its unit as they are shown; memory is no rate."""
        rate = f"{self.rate:,.0f}" if self.rate >= 100 else f"{self.rate:.3g}"
        return rate, self.unit if self.unit == MEGABYTES else f"{self.unit}/s"


class Failure(NamedTuple):
    """What there is no figure of, and why, in a line."""

    what: str
    why: str


class Made(NamedTuple):
    """What is ready to be measured."""

    run: Callable[[int], Any]  # a number of iterations, each of all members -> what it waits for
    operations: float = 0.0  # as in a row
    compile_seconds: float | None = None  # None: those of the first call


class Case(NamedTuple):
    """Something to be measured beside others."""

    row: Row  # without its figures
    make: Callable[[], Made]


def in_turns(cases: Sequence[Case], profiled: bool = False, **timing: Any) -> Iterator[Row | Failure]:
    """Makes all cases and measures them in turns; one that fails is told in its place, and the others go on.

    A profile that fails leaves its row as it is without one.
    """
    ready = []
    for row, make in cases:
        try:
            ready.append((row, make()))
        except Exception as error:
            yield failure(row, error)
    for (row, made), found in zip(ready, tried_in_turns([made.run for _, made in ready], **timing), strict=True):
        if isinstance(found, Exception):
            yield failure(row, found)
            continue
        rate, first_seconds = found
        seconds = first_seconds if made.compile_seconds is None else made.compile_seconds
        row = dataclasses.replace(row, rate=rate * row.members, compile_seconds=seconds, operations=made.operations)
        if profiled:
            try:
                row = dataclasses.replace(row, kinds=tuple(kernels.profile(made.run, PROFILED)))
            except Exception as error:
                yield failure(row, error, "profile of ")
        yield row


def failure(row: Row, error: Exception, part: str = "") -> Failure:
    return Failure(f"{part}{row.suite}: {row.what}, {row.members} members", why(error))


def why(error: Exception) -> str:
    """An error in one line."""
    line = next(filter(None, map(str.strip, str(error).splitlines())), "")
    return f"{type(error).__name__}: {line[:300]}"


def making(steps: Callable[..., Callable[[int], Any]], *arguments: Any, **options: Any) -> Callable[[], Made]:
    return lambda: Made(steps(*arguments, **options))


def member_keys(members: int) -> Array:
    return jax.vmap(jax.random.key)(jnp.arange(members))


def bench_env(task: str, members: int, physics: str, **timing: Any) -> Iterator[Row | Failure]:
    """Environment steps with random actions, automatic restarts included."""
    row = Row("env", f"{task}, {physics}", members, "env steps")
    return in_turns([Case(row, making(env_steps, task, members, physics))], **timing)


def env_steps(task: str, members: int, physics: str, **options: Any) -> Callable[[int], Any]:
    """A number of lockstep steps -> the environments after them."""
    env = envs.make(task, physics, **options)

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
    return lambda steps: run(start, keys, steps)


def bare_steps(task: str, members: int) -> Callable[[int], None]:
    """The same control steps by MuJoCo alone, without JAX and without restarts, on as many threads.

    `mujoco.rollout` gives no contact forces: for the humanoid, a thread pool makes the calls one robot at a time.
    """
    row = gym_table.TASKS[task]
    model = gym_tasks.load_model(row)
    threads = usable_cores()
    data = [mujoco.MjData(model) for _ in range(max(members, threads))]
    generator = np.random.default_rng(0)
    low, high = model.actuator_ctrlrange.T

    def control() -> np.ndarray:
        return generator.uniform(low, high, (members, model.nu))

    if row.quantities:
        pool = concurrent.futures.ThreadPoolExecutor(threads)

        def one(robot: mujoco.MjData, ctrl: np.ndarray) -> None:
            robot.ctrl[:] = ctrl
            mujoco.mj_step(model, robot, nstep=row.frame_skip)
            mujoco.mj_rnePostConstraint(model, robot)

        def step() -> None:
            list(pool.map(one, data[:members], control()))

    else:
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.zeros((members, mujoco.mj_stateSize(model, full)))
        for row_of, robot in zip(state, data, strict=False):
            mujoco.mj_getState(model, robot, row_of, full)
        rollouts = rollout_c.Rollout(nthread=threads)

        def step() -> None:
            controls = np.repeat(control()[:, None], row.frame_skip, axis=1)
            states, _ = rollouts.rollout(model, data[:threads], state, controls)
            state[:] = states[:, -1]

    def run(steps: int) -> None:
        for _ in range(steps):
            step()

    return run


def bench_physics(
    task: str, members: int, solver: Mapping[str, dict[str, int]], **timing: Any
) -> Iterator[Row | Failure]:
    """One task on each physics, beside MuJoCo alone and MJX with the model file's and with other solver settings."""
    made = {"MuJoCo alone": making(bare_steps, task, members)}
    made |= {name: making(env_steps, task, members, name) for name in envs.PHYSICS if not envs.lacks(name)}
    made["mjx, the file's iterations"] = making(env_steps, task, members, "mjx", iterations=None, ls_iterations=None)
    made |= {f"mjx {limits}": making(env_steps, task, members, "mjx", **options) for limits, options in solver.items()}
    cases = [Case(Row("physics", f"{task}, {what}", members, "env steps"), make) for what, make in made.items()]
    return in_turns(cases, **timing)


def bench_updates(
    algo: str,
    task: str,
    members: int,
    devices: Sequence[int | None] = (1,),
    settings: Mapping[str, Any] = NO_SETTINGS,
    **timing: Any,
) -> Iterator[Row | Failure]:
    """Updates on one fixed batch, on each number of devices in turn: the learner alone."""
    cases = [
        Case(
            Row("update", f"{algo}, {task} {on('sizes', count)}", members, "member updates", devices=count),
            functools.partial(updates, algo, task, members, count, **settings),
        )
        for count in fitting(devices, members)
    ]
    yield from in_turns(cases, **timing)


def on(what: str, devices: int) -> str:
    """A row's `what` with its number of devices, where these are several."""
    return f"{what}, {devices} devices" if devices > 1 else what


def fitting(devices: Sequence[int | None], members: int) -> list[int]:
    """Those numbers of devices that have a member for each, None as a run chooses; a line says so where none has."""
    chosen = [usable_devices(members) if count is None else count for count in devices]
    found = [count for count in dict.fromkeys(chosen) if count <= members]
    if not found:
        numbers = " or ".join(map(str, chosen))
        print(f"no figure of {members} members on {numbers} devices: each expects one at least", flush=True)
    return found


def updates(algo: str, task: str, members: int, devices: int = 1, **settings: Any) -> Made:
    """A number of updates -> the state after them; and the floating-point operations of one member's update."""
    config = algorithms.make_config(algo, task, **settings)
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
    layout = Layout(members, tuple(jax.local_devices()[:devices]))

    def loop(state, batch, key, steps):
        def body(i, state):
            return agent.update(state, batch, jax.random.fold_in(key, i), i)[0]

        return jax.lax.fori_loop(0, steps, body, state)

    run = jax.jit(layout.over_members(loop, (0, 0, 0, None), 0))
    keys = layout.filled(member_keys(members))
    state = jax.jit(layout.over_members(agent.init, (0,), 0))(keys)
    batch = jax.jit(layout.over_members(random_batch, (0,), 0))(keys)
    one = jax.eval_shape(random_batch, jax.random.key(0))
    count = operations.of_update(agent, example, one, config.agent.policy_delay)
    return Made(lambda steps: run(state, batch, keys, steps), count)


REPLAYS = {"uniform": replay.uniform, "lap": lap.lap}


def bench_replay(
    kind: str, what: str, task: str, capacity: int, members: int, **timing: Any
) -> Iterator[Row | Failure]:
    """One insert of a row, or one sampled batch and what it feeds back, on a full buffer."""
    return in_turns([replay_case(kind, what, task, capacity, members)], **timing)


def replay_case(kind: str, what: str, task: str, capacity: int, members: int) -> Case:
    row = Row("replay", f"{kind} {what}, {task} rows, capacity {capacity:,}", members, f"{what}s")
    return Case(row, making(replay_steps, kind, what, task, capacity, members))


def replay_steps(kind: str, what: str, task: str, capacity: int, members: int) -> Callable[[int], Any]:
    """A number of inserts or samples -> what it waits for."""
    env = envs.make(task)
    ring = Ring(capacity, env.observation_size, env.action_size, min_mean_episode_length=env.min_mean_episode_length)
    store = REPLAYS[kind](ring, BATCH)
    axes = store.member_axes
    obs, action, scalar = jnp.ones((1, env.observation_size)), jnp.zeros((1, env.action_size)), jnp.ones(1)

    def insert(state, total, key, step):
        return store.insert(state, Transition(obs, action, scalar, obs, scalar)), total

    def sample(state, total, key, step):
        batch, rows = store.sample(state, key)
        state = store.feedback(state, rows, jax.random.uniform(key, (BATCH,), maxval=3.0), step + 1)
        # All of the batch: XLA does not read what nobody uses.
        return state, total + sum(map(jnp.sum, batch))

    one = jax.vmap({"insert": insert, "sample": sample}[what], in_axes=(axes, 0, 0, None), out_axes=(axes, 0))

    def loop(step_of, state, total, keys, steps):
        def body(i, carry):
            return step_of(*carry, jax.vmap(jax.random.fold_in, (0, None))(keys, i), i)

        return jax.lax.fori_loop(0, steps, body, (state, total))

    run = jax.jit(functools.partial(loop, one), donate_argnums=0)
    insert_one = jax.vmap(insert, in_axes=(axes, 0, 0, None), out_axes=(axes, 0))
    fill = jax.jit(functools.partial(loop, insert_one), donate_argnums=0)
    keys, total = member_keys(members), jnp.zeros(members)
    state, _ = fill(jax.jit(jax.vmap(lambda _: store.init(), out_axes=axes))(keys), total, keys, capacity)

    def once(steps):
        nonlocal state
        state, total = run(state, jnp.zeros(members), keys, steps)
        return total

    return once


def bench_loops(
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    devices: Sequence[int | None] = (1,),
    profiled: bool = False,
    **timing: Any,
) -> Iterator[Row | Failure]:
    """The whole training loop, on each physics and number of devices in turn: environment, insert, sample, update.

    Where all of them together would take too much memory, one after the other.
    """
    counts = fitting(devices, members)
    cases = [
        Case(
            Row("loop", f"{algo} on {task}, {on(name, count)}", members, "env steps", devices=count),
            functools.partial(loop_steps, algo, task, members, name, count),
        )
        for name in physics
        for count in counts
    ]
    large = len(cases) * algorithms.memory_estimate(loop_config(algo, task, members), members) > LARGE
    for together in [[case] for case in cases] if large else [cases]:
        yield from in_turns(together, profiled, **timing)


def loop_config(algo: str, task: str, members: int, physics: str | None = None) -> Config:
    capacity = min(100_000, max(1_000, LOOP_ROWS // members))
    return algorithms.make_config(algo, task, replay_capacity=capacity, physics=physics)


def loop_steps(algo: str, task: str, members: int, physics: str, devices: int = 1) -> Made:
    """A number of lockstep steps of training -> what it waits for; and the seconds of compilation."""
    config = loop_config(algo, task, members, physics)
    layout = Layout(members, tuple(jax.local_devices()[:devices]))
    sweep = train.make_sweep(algorithms.make_trainer(config), layout)
    scalars = jax.tree.map(lambda value: jnp.full(members, value), config.agent.scalars())
    state = sweep.init(member_keys(members), scalars)
    start = time.perf_counter()
    state = jax.block_until_ready(sweep.advance(state, 1, False))
    compile_seconds = time.perf_counter() - start
    state = sweep.advance(state, 299, False)

    def once(steps: int) -> Array:
        nonlocal state
        state = sweep.advance(state, steps, True)
        return state.env_steps

    return Made(once, compile_seconds=compile_seconds)
