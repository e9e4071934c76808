"""The program of each process of test_members: ADDRESS RANK FILE; it writes the returns of all members to FILE."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import probe_envs

from sqt_jax import experiment, train
from sqt_jax.members import Layout

SETTINGS = {"steps": 400, "warmup_steps": 40, "batch_size": 16, "hidden": (16, 16), "eval_episodes": 2, "gamma": 0.9}


def start(sweep, config, count):
    keys = jax.vmap(jax.random.key)(jnp.arange(count))
    scalars = jax.tree.map(lambda value: jnp.full(count, value), config.agent.scalars())
    return sweep.init(keys, scalars)


def train_a_little(sweep, state):
    return sweep.advance(sweep.advance(state, 40, False), 50, True)


if __name__ == "__main__":
    address, rank, file = sys.argv[1:]
    jax.config.update("jax_num_cpu_devices", 1)
    jax.distributed.initialize(address, 2, int(rank))
    from jax.experimental import multihost_utils

    config = experiment.make_config("td3_sqt", "cheetah", **SETTINGS)
    layout = Layout(3, tuple(jax.devices()))
    sweep = train.make_sweep(experiment.make_trainer(config, probe_envs.one_step()), layout)
    state = train_a_little(sweep, start(sweep, config, 3))
    np.save(file, multihost_utils.process_allgather(sweep.evaluate(state)[0].returns, tiled=True))
