"""Control steps per second of environments: `python -m experiments.bench --suites=env,physics`."""

import concurrent.futures
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import rollout as mujoco_rollout

from experiments.benchmarks.measurements import Case, Failure, Measurement, measure_cases, member_keys, preparing
from sqt_jax import envs, rollout
from sqt_jax.envs import gym_table, gym_tasks
from sqt_jax.job_limits import usable_cores


def bench_env(task: str, members: int, physics: str, **timing: Any) -> Iterator[Measurement | Failure]:
    """Environment steps with random actions, automatic resets included."""
    measurement = Measurement(suite="env", what=f"{task}, {physics}", members=members, unit="env steps")
    return measure_cases([Case(measurement, preparing(env_steps, task, members, physics))], **timing)


def bench_physics(
    task: str, members: int, solver: Mapping[str, dict[str, int]], **timing: Any
) -> Iterator[Measurement | Failure]:
    """One task on each physics, on MuJoCo without JAX, and on MJX with the model file's and with other solver limits.

    Args:
      solver: name -> MJX's options `iterations` and `ls_iterations`.
    """
    steps = {"MuJoCo without JAX": preparing(mujoco_steps, task, members)}
    steps |= {name: preparing(env_steps, task, members, name) for name in envs.PHYSICS if not envs.lacks(name)}
    steps["mjx, the file's iterations"] = preparing(
        env_steps, task, members, "mjx", iterations=None, ls_iterations=None
    )
    for limits, options in solver.items():
        steps[f"mjx {limits}"] = preparing(env_steps, task, members, "mjx", **options)
    cases = [
        Case(Measurement(suite="physics", what=f"{task}, {what}", members=members, unit="env steps"), prepare)
        for what, prepare in steps.items()
    ]
    return measure_cases(cases, **timing)


def env_steps(task: str, members: int, physics: str, **options: Any) -> Callable[[int], Any]:
    """A compiled loop of random actions: number of lockstep steps -> the environments' time steps [M, 1, ...]."""
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


def mujoco_steps(task: str, members: int) -> Callable[[int], None]:
    """The same control steps by MuJoCo without JAX and without resets, on one thread per core.

    `mujoco.rollout` computes no contact forces: for the humanoid, a thread pool steps one robot per call.
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

        def step_robot(robot: mujoco.MjData, ctrl: np.ndarray) -> None:
            robot.ctrl[:] = ctrl
            mujoco.mj_step(model, robot, nstep=row.frame_skip)
            mujoco.mj_rnePostConstraint(model, robot)

        def step() -> None:
            list(pool.map(step_robot, data[:members], control()))

    else:
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.zeros((members, mujoco.mj_stateSize(model, full)))
        for robot_state, robot in zip(state, data, strict=False):
            mujoco.mj_getState(model, robot, robot_state, full)
        rollouts = mujoco_rollout.Rollout(nthread=threads)

        def step() -> None:
            controls = np.repeat(control()[:, None], row.frame_skip, axis=1)
            states, _ = rollouts.rollout(model, data[:threads], state, controls)
            state[:] = states[:, -1]

    def run(steps: int) -> None:
        for _ in range(steps):
            step()

    return run
