"""A trained policy on disk: parameters as plain arrays, settings as JSON. Loading executes nothing.

policy/config.json     settings and sizes
policy/member_0.npz    the actor's parameters of member 0, by path ("params/layer0/kernel")
"""

import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from sqt_jax.algorithms import ALGORITHMS, make_config
from sqt_jax.config import Config
from sqt_jax.types import Array, Environment, State


def save_policy(directory: Path | str, config: Config, env: Environment, agent_state: State) -> None:
    """Writes the policy of every member of `agent_state` ([S, ...]) to a new directory.

    Raises:
      FileExistsError: the directory exists.
    """
    directory = Path(directory)
    directory.mkdir(parents=True)
    sizes = {"observation_size": env.observation_size, "action_size": env.action_size}
    (directory / "config.json").write_text(json.dumps(config.flat() | sizes, indent=1) + "\n")
    arrays = traverse_util.flatten_dict(jax.device_get(agent_state.actor), sep="/")
    for member in range(next(iter(arrays.values())).shape[0]):
        np.savez(directory / f"member_{member}.npz", **{name: array[member] for name, array in arrays.items()})


def load_policy(directory: Path | str, member: int = 0) -> Callable[[Array], Array]:
    """The deterministic policy of one member: obs [B, O] -> action [B, A] in [-1, 1].

    Raises:
      FileNotFoundError: there is no such policy or member.
      ValueError: the parameters are not those of the stated algorithm and sizes.
    """
    directory = Path(directory)
    settings = json.loads((directory / "config.json").read_text())
    sizes = settings.pop("observation_size"), settings.pop("action_size")
    config = make_config(**settings | {"hidden": tuple(settings["hidden"])})
    agent = ALGORITHMS[config.algo].make_agent(config.agent, *sizes)
    with np.load(directory / f"member_{member}.npz", allow_pickle=False) as file:
        actor = traverse_util.unflatten_dict({name: jnp.asarray(file[name]) for name in file.files}, sep="/")
    state = agent.init(jax.random.key(0))
    if jax.tree.map(jnp.shape, actor) != jax.tree.map(jnp.shape, state.actor):
        raise ValueError(f"{directory}: member {member} does not hold the actor of {config.algo} for sizes {sizes}")
    state = state._replace(actor=actor)

    @jax.jit
    def policy(obs: Array) -> Array:
        return agent.act(state, jnp.asarray(obs, jnp.float32), jax.random.key(0), deterministic=True)

    return policy
