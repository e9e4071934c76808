"""A trained policy on disk: parameters as plain arrays, settings as JSON. Loading executes nothing.

policy/config.json     settings and sizes
policy/member_0.npz    what acting needs of member 0, by path ("params/layer0/kernel")
policy/act.stablehlo   the function (arrays of a member, obs [B, O]) -> action [B, A], any B, by `jax.export`: it runs
                       where this package is not installed
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from sqt_jax.algorithms import ALGORITHMS, agent_of, make_config
from sqt_jax.config import Config
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Agent, Array, Environment, State


def save_policy(directory: Path | str, config: Config, env: Environment, agent_state: State) -> None:
    """Writes the policy of every member of `agent_state` ([S, ...]) to a new directory.

    Raises:
      FileExistsError: the directory exists.
    """
    directory = Path(directory)
    directory.mkdir(parents=True)
    sizes = {"observation_size": env.observation_size, "action_size": env.action_size}
    (directory / "config.json").write_text(json.dumps(config.flat() | sizes, indent=1) + "\n")
    agent = agent_of(config, env)
    arrays = by_path(jax.device_get(agent.policy(agent_state)))
    (directory / "act.stablehlo").write_bytes(_exported(agent, env.observation_size))
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
    config = make_config(**settings)
    agent = ALGORITHMS[config.algo].make_agent(config.agent, *sizes)
    expected = jax.eval_shape(lambda: agent.policy(agent.init(jax.random.key(0))))
    shapes = {name: leaf.shape for name, leaf in by_path(expected).items()}
    with np.load(directory / f"member_{member}.npz", allow_pickle=False) as file:
        arrays = {name: jnp.asarray(file[name]) for name in file.files}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise ValueError(f"{directory}: member {member} does not hold a policy of {config.algo} for sizes {sizes}")
    params = from_paths(expected, arrays)

    @jax.jit
    def policy(obs: Array) -> Array:
        return agent.policy_action(params, jnp.asarray(obs, jnp.float32))

    return policy


def _exported(agent: Agent, observation_size: int) -> bytes:
    """The policy as a function of its arrays by path and of the observations, serialised."""
    policy = jax.eval_shape(lambda: agent.policy(agent.init(jax.random.key(0))))

    def act(arrays: dict[str, Array], obs: Array) -> Array:
        params = from_paths(policy, arrays)
        return agent.policy_action(params, obs)

    (batch,) = jax.export.symbolic_shape("batch")
    obs = jax.ShapeDtypeStruct((batch, observation_size), jnp.float32)
    exported = jax.export.export(jax.jit(act), platforms=("cpu", "cuda", "tpu"))(by_path(policy), obs)
    return bytes(exported.serialize())
