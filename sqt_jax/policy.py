"""A trained policy on disk: parameters as plain arrays, settings as JSON. Loading executes no code from the files.

policy/config.json     settings, and the sizes of observations and actions
policy/member_0.npz    the parameters that member 0 needs to act, by path ("params/layer0/kernel")
policy/act.stablehlo   the function (arrays of a member by path, obs [B, O]) -> action [B, A] for any B, made by
                       `jax.export` (https://docs.jax.dev/en/latest/export/export.html): it runs without this package.
                       Loading does not need it, and checkpoints have none
"""

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from sqt_jax import policy_folders
from sqt_jax.algorithms import make_parts
from sqt_jax.config import Config
from sqt_jax.experiment import agent_of, make_config
from sqt_jax.one_line import one_line
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Agent, Array, Environment, State

MAX_CONFIG_BYTES = 1_000_000
MAX_SIZE = 1_000_000  # of an observation or an action
EXPORTED = "act.stablehlo"


def save_policy(
    directory: Path | str, config: Config, env: Environment, agent_state: State, members: int | None = None
) -> None:
    """Write the policies of a sweep's members to a new directory.

    Args:
      directory: is created.
      config: of the run.
      env: the environment, for its sizes.
      agent_state: with a leading axis of members, [S, ...]. A single agent's state gets one by
        `jax.tree.map(lambda x: x[None], state)`.
      members: how many to write, the first ones; None: all.

    Raises:
      FileExistsError: the directory exists.
      ValueError: the state has no axis of members, or is that of another algorithm or of other sizes.
    """
    directory = Path(directory)
    agent = agent_of(config, env)
    arrays = by_path(jax.device_get(agent.views.policy(agent_state)))
    expected = {name: leaf.shape for name, leaf in by_path(_shapes(agent)).items()}
    if {name: array.shape[1:] for name, array in arrays.items()} != expected:
        raise ValueError(f"agent_state: expected that of {config.algo} with a leading axis of members, [S, ...]")
    write_policies(directory, config, env, {name: array[:members] for name, array in arrays.items()})
    (directory / EXPORTED).write_bytes(export_policy(config, env))


def write_policies(directory: Path, config: Config, env: Environment, arrays: Mapping[str, np.ndarray]) -> None:
    """Write policies to a new directory, without act.stablehlo.

    Args:
      arrays: the policies' parameters by path, [S, ...] each.

    Raises:
      FileExistsError: the directory exists.
    """
    directory.mkdir(parents=True)
    sizes = {"observation_size": env.observation_size, "action_size": env.action_size}
    (directory / "config.json").write_text(json.dumps(config.flat() | sizes, indent=1) + "\n")
    for member in range(len(next(iter(arrays.values())))):
        np.savez(directory / f"member_{member}.npz", **{name: array[member] for name, array in arrays.items()})


def export_policy(config: Config, env: Environment) -> bytes:
    """The content of act.stablehlo: the policy as a function of its arrays by path and the observations."""
    agent = agent_of(config, env)
    policy = _shapes(agent)

    def act(arrays: dict[str, Array], obs: Array) -> Array:
        params = from_paths(policy, arrays)
        return agent.views.policy_action(params, obs)

    (batch,) = jax.export.symbolic_shape("batch")
    obs = jax.ShapeDtypeStruct((batch, env.observation_size), jnp.float32)
    exported = jax.export.export(jax.jit(act), platforms=("cpu", "cuda", "tpu"))(by_path(policy), obs)
    return bytes(exported.serialize())


def read_policies(directory: Path, config: Config, env: Environment, members: int) -> dict[str, np.ndarray]:
    """The parameters of the first `members` policies in a directory by path, [S, ...] each.

    Raises:
      FileNotFoundError: a member's file is missing.
      ValueError: a file is damaged, or does not have the parameters of `config` and the sizes of `env`.
    """
    expected = by_path(_shapes(agent_of(config, env)))
    read = [_read_arrays(directory / f"member_{member}.npz", expected) for member in range(members)]
    found = [arrays for arrays in read if arrays is not None]
    if len(found) < members:
        raise ValueError(f"{directory}: does not have the parameters of {config.algo} on {config.env}")
    return {name: np.stack([arrays[name] for arrays in found]) for name in expected}


def load_policy(directory: Path | str, member: int = 0, best: bool = False) -> Callable[[Array], Array]:
    """Load the deterministic policy of one member.

    Args:
      directory: written by `save_policy`; or the folder of a run: its policy/ or, before training has ended, that of
        its newest checkpoint.
      member: its number, from 0.
      best: of a run, the policy of the member's best evaluation (policy_best/) in place of the last one.

    Returns:
      A compiled function obs [B, O] -> action [B, A] in [-1, 1]. It raises ValueError for other sizes of obs.

    Raises:
      FileNotFoundError: the directory has no policy, or no such member.
      ValueError: a file is damaged, or the parameters do not fit the algorithm and sizes in config.json; `best` is
        given and the directory is not the folder of a run.
    """
    directory = Path(directory)
    if policy_folders.is_run(directory):
        return policy_folders.read_first(directory, best, lambda folder: _load(folder, member))[0]
    if best:
        raise ValueError(f"best: expects the folder of a run, not {directory}")
    return _load(directory, member)


def _load(directory: Path, member: int) -> Callable[[Array], Array]:
    """The policy of a member in a folder written by `write_policies`. Raises as `load_policy`."""
    config, sizes = _read_config(directory / "config.json")
    agent = make_parts(config.algo, config.agent, *sizes).agent
    expected = _shapes(agent)
    arrays = _read_arrays(directory / f"member_{member}.npz", by_path(expected))
    if arrays is None:
        raise ValueError(
            f"{directory}: member {member} does not have the parameters of a {config.algo} policy for sizes {sizes}"
        )
    params = from_paths(expected, {name: jnp.asarray(array) for name, array in arrays.items()})

    @jax.jit
    def policy(obs: Array) -> Array:
        obs = jnp.asarray(obs, jnp.float32)
        if obs.shape[-1:] != sizes[:1]:
            raise ValueError(f"obs: expected [B, {sizes[0]}], got {list(obs.shape)}")
        return agent.views.policy_action(params, obs)

    return policy


def _read_config(path: Path) -> tuple[Config, tuple[int, int]]:
    """The settings in config.json, and the sizes of observations and actions."""
    try:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: there is no such file")
        with path.open("rb") as file:
            content = file.read(MAX_CONFIG_BYTES + 1)
        if len(content) > MAX_CONFIG_BYTES:
            raise ValueError(f"expected at most {MAX_CONFIG_BYTES:,} bytes")
        settings = json.loads(content)
        sizes = settings.pop("observation_size"), settings.pop("action_size")
        if not all(type(size) is int and 1 <= size <= MAX_SIZE for size in sizes):
            raise ValueError(f"expected sizes from 1 to {MAX_SIZE}, got {sizes}")
        return make_config(**settings), sizes
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError, OSError) as error:
        raise ValueError(f"{path}: not the settings of a policy: {one_line(error)}") from None


def _read_arrays(path: Path, expected: dict[str, Any]) -> dict[str, np.ndarray] | None:
    """The arrays of an .npz file; None if their names, shapes or types are not the expected ones.

    The sizes stated in the file are checked before data of that size is read.
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
                        raise ValueError(f"expected arrays of version 1.0, got {version}")
                    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
                    if (shape, dtype) != (leaf.shape, leaf.dtype):
                        return None
                    size = math.prod(shape) * dtype.itemsize
                    data = file.read(size + 1)
                    if len(data) != size:
                        raise ValueError(f"{name} is truncated or too long")
                    arrays[name] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C")
            return arrays
    except FileNotFoundError:  # removed just now
        raise FileNotFoundError(f"{path}: there is no such file") from None
    except Exception as error:  # of any type: zipfile and NumPy raise many for a file that is damaged
        raise ValueError(f"{path}: not the parameters of a policy: {one_line(error)}") from None


def _shapes(agent: Agent) -> Any:
    """The parameters that one member needs to act, as shapes and types."""
    return jax.eval_shape(lambda: agent.views.policy(agent.init(jax.random.key(0))))
