"""Updates per second of an agent on one fixed batch: `python -m experiments.bench --suites=update`."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks import operations
from experiments.benchmarks.measurements import (
    Case,
    Failure,
    Measurement,
    Prepared,
    device_counts,
    measure_cases,
    member_keys,
    with_devices,
)
from sqt_jax import envs, experiment
from sqt_jax.members import Layout
from sqt_jax.types import Transition

NO_SETTINGS: Mapping[str, Any] = MappingProxyType({})


def bench_updates(
    algo: str,
    task: str,
    members: int,
    devices: Sequence[int | None] = (1,),
    settings: Mapping[str, Any] = NO_SETTINGS,
    **timing: Any,
) -> Iterator[Measurement | Failure]:
    """Updates on one fixed batch, without environment and replay, on each number of devices.

    Args:
      devices: numbers of devices; None is the number that a run would use.
      settings: of the algorithm, as in `experiment.make_config`.
    """
    cases = [
        Case(
            Measurement(
                suite="update",
                what=f"{algo}, {task} {with_devices('sizes', count)}",
                members=members,
                unit="member updates",
                devices=count,
            ),
            functools.partial(updates, algo, task, members, count, **settings),
        )
        for count in device_counts(devices, members)
    ]
    yield from measure_cases(cases, **timing)


def updates(algo: str, task: str, members: int, devices: int = 1, **settings: Any) -> Prepared:
    """A compiled loop of updates, and the floating-point operations of one member's update.

    Raises:
      ConfigError: an invalid setting.
    """
    config = experiment.make_config(algo, task, **settings)
    env = envs.make(task)
    agent = experiment.agent_of(config, env)
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
        return Transition(obs=obs, action=jnp.tanh(action), reward=reward, next_obs=next_obs, discount=jnp.ones(size))

    example = jax.eval_shape(agent.init, jax.random.key(0))
    layout = Layout(members, tuple(jax.local_devices()[:devices]))

    def loop(state, batch, key, steps):
        def body(i, state):
            return agent.update(state, batch, jax.random.fold_in(key, i), i)[0]

        return jax.lax.fori_loop(0, steps, body, state)

    run = jax.jit(layout.over_members(loop, (0, 0, 0, None), 0))
    keys = layout.padded(member_keys(members))
    state = jax.jit(layout.over_members(agent.init, (0,), 0))(keys)
    batch = jax.jit(layout.over_members(random_batch, (0,), 0))(keys)
    one_batch = jax.eval_shape(random_batch, jax.random.key(0))
    count = operations.of_update(agent, example, one_batch, config.agent.policy_delay)
    return Prepared(lambda steps: run(state, batch, keys, steps), count)
