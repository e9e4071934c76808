"""The measurements of the benchmark: how fast one part is, compiled as it is used."""

import concurrent.futures
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as rollout_c

from experiments import kernels, operations
from experiments.timing import measure, measure_in_turns
from sqt_jax import algorithms, envs, lap, replay, rollout, train
from sqt_jax.cores import usable_cores
from sqt_jax.envs import gym_table, gym_tasks
from sqt_jax.members import Layout, member_axes
from sqt_jax.ring import Ring
from sqt_jax.types import Array, Transition

BATCH = 256
NO_SETTINGS: Mapping[str, Any] = MappingProxyType({})
LOOP_ROWS = 1_000_000  # of the replays of all members together, where a loop is measured
PROFILED = 4  # lockstep steps; the actor learns in half of them


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure. `rate` counts the unit in all members together, per second."""

    suite: str
    what: str
    members: int
    unit: str
    rate: float
    compile_seconds: float
    operations: float = 0.0  # floating-point, of one unit; 0: not counted
    kinds: tuple[kernels.Kind, ...] = ()  # what runs on the device, of a lockstep step; empty: not profiled
    point: tuple[str, str, int] | None = None  # in a figure of growth: what is varied, the line, the value


def member_keys(members: int) -> Array:
    return jax.vmap(jax.random.key)(jnp.arange(members))


def bench_env(task: str, members: int, physics: str, **timing: Any) -> Row:
    """Environment steps with random actions, automatic restarts included."""
    rate, compile_seconds = measure(env_steps(task, members, physics), **timing)
    return Row("env", f"{task}, {physics}", members, "env steps", rate * members, compile_seconds)


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


def bench_physics(task: str, members: int, solver: Mapping[str, dict[str, int]], **timing: Any) -> Iterator[Row]:
    """One task on each physics, beside MuJoCo alone and MJX with the model file's and with other solver settings."""
    runs = {"MuJoCo alone": bare_steps(task, members)}
    runs |= {name: env_steps(task, members, name) for name in envs.PHYSICS if not envs.lacks(name)}
    runs["mjx, the file's iterations"] = env_steps(task, members, "mjx", iterations=None, ls_iterations=None)
    runs |= {f"mjx {limits}": env_steps(task, members, "mjx", **options) for limits, options in solver.items()}
    rates = measure_in_turns(list(runs.values()), **timing)
    for what, (rate, compile_seconds) in zip(runs, rates, strict=True):
        yield Row("physics", f"{task}, {what}", members, "env steps", rate * members, compile_seconds)


def bench_updates(
    algo: str,
    task: str,
    members: int,
    devices: Sequence[int] = (1,),
    settings: Mapping[str, Any] = NO_SETTINGS,
    **timing: Any,
) -> Iterator[Row]:
    """Updates on one fixed batch, on each number of devices in turn: the learner alone."""
    cases = {_on("sizes", count): count for count in devices if count <= members}
    runs, counts = zip(*(updates(algo, task, members, count, **settings) for count in cases.values()), strict=True)
    rates = measure_in_turns(runs, **timing)
    for name, count, (rate, seconds) in zip(cases, counts, rates, strict=True):
        yield Row("update", f"{algo}, {task} {name}", members, "member updates", rate * members, seconds, count)


def _on(what: str, devices: int) -> str:
    return f"{what}, {devices} devices" if devices > 1 else what


def updates(
    algo: str, task: str, members: int, devices: int = 1, **settings: Any
) -> tuple[Callable[[int], Any], float]:
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
    axes = member_axes(example)
    layout = Layout(members, tuple(jax.local_devices()[:devices]))

    def loop(state, batch, key, steps):
        def body(i, state):
            return agent.update(state, batch, jax.random.fold_in(key, i))[0]

        return jax.lax.fori_loop(0, steps, body, state)

    run = jax.jit(layout.over_members(loop, (axes, 0, 0, None), axes))
    keys = layout.filled(member_keys(members))
    state = jax.jit(layout.over_members(agent.init, (0,), axes))(keys)
    batch = jax.jit(layout.over_members(random_batch, (0,), 0))(keys)
    one = jax.eval_shape(random_batch, jax.random.key(0))
    count = operations.of_update(agent, example, one, config.agent.policy_delay)
    return lambda steps: run(state, batch, keys, steps), count


REPLAYS = {"uniform": replay.uniform, "lap": lap.lap}


def bench_replay(kind: str, what: str, task: str, capacity: int, members: int, **timing: Any) -> Row:
    """One insert of a row, or one sampled batch and what it feeds back, on a full buffer."""
    env = envs.make(task)
    ring = Ring(capacity, env.observation_size, env.action_size, shortest_episode=env.shortest_episode)
    store = REPLAYS[kind](ring, BATCH)
    axes = member_axes(jax.eval_shape(store.init))
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


def bench_loops(
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    devices: Sequence[int] = (1,),
    profiled: bool = False,
    **timing: Any,
) -> Iterator[Row]:
    """The whole training loop, on each physics and number of devices in turn: environment, insert, sample, update."""
    cases = {_on(name, count): (name, count) for name in physics for count in devices if count <= members}
    runs, compile_seconds = zip(*(loop_steps(algo, task, members, *case) for case in cases.values()), strict=True)
    rates = measure_in_turns(runs, **timing)
    for name, run, (rate, _), seconds in zip(cases, runs, rates, compile_seconds, strict=True):
        kinds = tuple(kernels.profile(run, PROFILED)) if profiled else ()
        yield Row("loop", f"{algo} on {task}, {name}", members, "env steps", rate * members, seconds, kinds=kinds)


def loop_steps(
    algo: str, task: str, members: int, physics: str, devices: int = 1
) -> tuple[Callable[[int], Any], float]:
    """A number of lockstep steps of training -> what it waits for; and the seconds of compilation."""
    capacity = min(100_000, max(1_000, LOOP_ROWS // members))
    config = algorithms.make_config(algo, task, replay_capacity=capacity, physics=physics)
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

    return once, compile_seconds
