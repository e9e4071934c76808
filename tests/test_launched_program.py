"""The loops and branches of a lockstep step in the program that is lowered for a GPU.

It waits for the host at each of them, except at the loop of a step's updates, whose length is known.
"""

import re

import jax
import jax.numpy as jnp
import probe_envs
import pytest
from algorithm_rows import ONE_OF_EACH, every

from sqt_jax import experiment, train
from sqt_jax.algorithms import ALGORITHMS, features_of
from sqt_jax.members import Layout

MEMBERS = 3
STEPS, RESTART, RETRY = 1, 1, 1  # the loop of steps; a new episode, with a second start if the first is not finite
UPDATES = 1  # the loop of the updates of a step; XLA removes it where it is one


def lowered(config, learn):
    """The program for CUDA, before XLA compiles it. No GPU is needed."""
    trainer = experiment.make_trainer(config, probe_envs.one_step())
    sweep = train.make_sweep(trainer, Layout(MEMBERS))
    keys = jax.vmap(jax.random.key)(jnp.arange(MEMBERS))
    scalars = jax.tree.map(lambda value: jnp.full(MEMBERS, value), config.agent.scalars())
    state = jax.eval_shape(sweep.init, keys, scalars)
    return sweep.advance.trace(state, 1, learn).lower(lowering_platforms=("cuda",)).as_text()


@every(fast=(*ONE_OF_EACH, "redq"))
@pytest.mark.parametrize("learn", [False, True], ids=["warm-up", "training"])
def test_a_step_has_no_more_loops_and_branches_than_these(algo, learn):
    config = experiment.make_config(algo, probe_envs.one_step(), hidden=(8, 8), steps=1_000, warmup_steps=100)
    text = lowered(config, learn)
    td7 = "checkpoints" in features_of(ALGORITHMS[algo], config.agent)
    loops = STEPS + RESTART + RETRY + td7  # an assessment that ends
    if learn:
        delayed_actor, copies = config.agent.policy_delay > 1, td7
        loops += UPDATES + delayed_actor + copies
    assert len(re.findall(r"stablehlo\.while", text)) == loops
    assert not re.search(r"stablehlo\.(?:case|if)\b", text)
