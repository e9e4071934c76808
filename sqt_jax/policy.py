"""A trained policy on disk: parameters as plain arrays, settings as JSON. Loading executes nothing.

policy/config.json     settings and sizes
policy/member_0.npz    what acting needs of member 0, by path ("params/layer0/kernel")
policy/act.stablehlo   the function (arrays of a member, obs [B, O]) -> action [B, A], any B, by `jax.export`: it runs
                       where this package is not installed
"""

import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from sqt_jax.algorithms import agent_of, make_config, make_parts
from sqt_jax.config import Config
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Agent, Array, Environment, State

MAX_CONFIG_BYTES = 1_000_000
MAX_SIZE = 1_000_000  # of an observation or an action


def save_policy(
    directory: Path | str, config: Config, env: Environment, agent_state: State, members: int | None = None
) -> None:
    """Writes the policies of the first `members` (None: all) of `agent_state` to a new directory.

    Args:
      agent_state: of a sweep, with a leading axis of members, [S, ...]; that of one agent, by
        `jax.tree.map(lambda x: x[None], state)`.

    Raises:
      FileExistsError: the directory exists.
      ValueError: the state has no axis of members, or is another agent's.
    """
    directory = Path(directory)
    agent = agent_of(config, env)
    arrays = by_path(jax.device_get(agent.views.policy(agent_state)))
    expected = {name: leaf.shape for name, leaf in by_path(_shapes(agent)).items()}
    if {name: array.shape[1:] for name, array in arrays.items()} != expected:
        raise ValueError(f"agent_state has to be {config.algo}'s with a leading axis of members, [S, ...]")
    directory.mkdir(parents=True)
    sizes = {"observation_size": env.observation_size, "action_size": env.action_size}
    (directory / "config.json").write_text(json.dumps(config.flat() | sizes, indent=1) + "\n")
    (directory / "act.stablehlo").write_bytes(_exported(agent, env.observation_size))
    held = next(iter(arrays.values())).shape[0]
    for member in range(held if members is None else members):
        np.savez(directory / f"member_{member}.npz", **{name: array[member] for name, array in arrays.items()})


def load_policy(directory: Path | str, member: int = 0) -> Callable[[Array], Array]:
    """The deterministic policy of one member: obs [B, O] -> action [B, A] in [-1, 1].

    Raises:
      FileNotFoundError: there is no such policy or member.
      ValueError: a file is damaged, or the parameters are not those of the stated algorithm and sizes.
    """
    directory = Path(directory)
    config, sizes = _read_config(directory / "config.json")
    agent = make_parts(config.algo, config.agent, *sizes).agent
    expected = _shapes(agent)
    arrays = _read_arrays(directory / f"member_{member}.npz", by_path(expected))
    if arrays is None:
        raise ValueError(f"{directory}: member {member} does not hold a policy of {config.algo} for sizes {sizes}")
    params = from_paths(expected, {name: jnp.asarray(array) for name, array in arrays.items()})

    @jax.jit
    def policy(obs: Array) -> Array:
        return agent.views.policy_action(params, jnp.asarray(obs, jnp.float32))

    return policy


def _read_config(path: Path) -> tuple[Config, tuple[int, int]]:
    """Settings, and the sizes of observations and actions."""
    try:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: there is no such file")
        with path.open("rb") as file:
            content = file.read(MAX_CONFIG_BYTES + 1)
        if len(content) > MAX_CONFIG_BYTES:
            raise ValueError(f"more than {MAX_CONFIG_BYTES:,} bytes")
        settings = json.loads(content)
        sizes = settings.pop("observation_size"), settings.pop("action_size")
        if not all(type(size) is int and 1 <= size <= MAX_SIZE for size in sizes):
            raise ValueError(f"sizes are whole numbers from 1 to {MAX_SIZE}")
        return make_config(**settings), sizes
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError, OSError) as error:
        raise ValueError(f"{path}: not the settings of a policy: {_one_line(error)}") from None


def _read_arrays(path: Path, expected: dict[str, Any]) -> dict[str, np.ndarray] | None:
    """The arrays of an .npz file; None where they are not of the expected names, shapes and types.

    What a file says of its sizes is compared before anything of that size is read.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            if sorted(archive.namelist()) != sorted(f"{name}.npy" for name in expected):
                return None
            arrays = {}
            for name, leaf in expected.items():
                with archive.open(f"{name}.npy") as file:
                    version = np.lib.format.read_magic(file)
                    if version != (1, 0):
                        raise ValueError(f"arrays of version {version}")
                    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
                    if (shape, dtype) != (leaf.shape, leaf.dtype):
                        return None
                    size = math.prod(shape) * dtype.itemsize
                    data = file.read(size + 1)
                    if len(data) != size:
                        raise ValueError(f"{name} is truncated or too long")
                    arrays[name] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C")
            return arrays
    except Exception as error:  # whatever zipfile and NumPy say of a file that is not theirs
        raise ValueError(f"{path}: not the parameters of a policy: {_one_line(error)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def _shapes(agent: Agent) -> Any:
    """What acting needs of one member, as shapes and types."""
    return jax.eval_shape(lambda: agent.views.policy(agent.init(jax.random.key(0))))


def _exported(agent: Agent, observation_size: int) -> bytes:
    """The policy as a function of its arrays by path and of the observations, serialised."""
    policy = _shapes(agent)

    def act(arrays: dict[str, Array], obs: Array) -> Array:
        params = from_paths(policy, arrays)
        return agent.views.policy_action(params, obs)

    (batch,) = jax.export.symbolic_shape("batch")
    obs = jax.ShapeDtypeStruct((batch, observation_size), jnp.float32)
    exported = jax.export.export(jax.jit(act), platforms=("cpu", "cuda", "tpu"))(by_path(policy), obs)
    return bytes(exported.serialize())
