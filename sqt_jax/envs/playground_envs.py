"""Playground's environments (`playground:CartpoleBalance`, ...), under our episode contract (`autoreset`).

https://github.com/google-deepmind/mujoco_playground is the extra `playground`, imported when one of them is made. Its
wrappers are not used: their auto-reset returns to the first start unless told otherwise, and always loses the last
observation of an episode (mujoco_playground/_src/wrapper.py).
"""

import os
import re
import subprocess
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from sqt_jax import trees
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.one_line import one_line, with_place
from sqt_jax.suggestions import did_you_mean
from sqt_jax.types import Array, Environment

PREFIX = "playground:"
NAME = re.compile(r"playground:[A-Za-z]\w*", re.ASCII)
IMPLEMENTATIONS = {"mjx": "jax", "warp": "warp"}  # MJX's, by this repository's name of the physics
PHYSICS = tuple(IMPLEMENTATIONS)
OBSERVED = "state"  # the actor's part of an observation that is a dictionary
ROBOTS = "https://github.com/google-deepmind/mujoco_menagerie.git"
SECONDS_TO_ANSWER = 10.0


class Task(NamedTuple):
    """An environment of Playground's, and the settings that its wrappers would get."""

    env: Any  # a mujoco_playground.MjxEnv
    steps: int  # of ours until the time limit
    action_repeat: int  # Playground's steps in one of ours
    terminates: bool  # whether its episodes can end before the time limit

    @property
    def period(self) -> float:
        """Seconds in one of our steps."""
        return float(self.env.dt) * self.action_repeat


def check_name(name: str) -> None:
    """Raises ValueError if `name` has another form than `playground:NAME`.

    Whether there is such an environment only the package knows, which is not needed to read a run.
    """
    if NAME.fullmatch(name) is None:
        raise ValueError(f"expects playground:NAME, as in playground:CartpoleBalance, not {name!r}")


def make_playground(
    name: str, physics: str, arguments: Mapping[str, Any] | None = None, max_episode_steps: int = 0
) -> Environment:
    """The environment of a name with its prefix. It has no `set_physics` and no `speed`.

    One of its steps is `action_repeat` of Playground's, fewer if one of them ends the episode, with the sum of their
    rewards. Its time limit is Playground's `episode_length` in these steps.

    Args:
      physics, arguments, max_episode_steps: as in `load`.

    Raises:
      ValueError: as `load`; or its observations are neither vectors nor dictionaries with the vector "state".
    """
    task = load(name, physics, arguments, max_episode_steps)
    try:
        obs = jax.eval_shape(task.env.reset, _raw(jax.random.key(0))).obs
        action_size = task.env.action_size
    except Exception as error:  # of any type: the arguments are the user's
        raise ValueError(with_place(error, __file__)) from error
    observed = _observed(obs)
    if getattr(observed, "ndim", None) != 1:
        shapes = jax.tree.map(lambda part: part.shape, obs)
        raise ValueError(f"expects a vector as observation, or a dictionary with the vector {OBSERVED!r}, not {shapes}")

    def start(key: Array) -> tuple[Any, Array]:
        with jax.default_matmul_precision("highest"):  # GPUs would use TF32
            state = trees.strong(task.env.reset(_raw(key)))
        return state, _observed(state.obs)

    def once(state: Any, action: Array) -> Any:
        # A copy, because Playground writes into the dictionaries `info` and `metrics` that it is given.
        return trees.strong(task.env.step(jax.tree.map(lambda leaf: leaf, state), action))

    def repeated(state: Any, action: Array) -> tuple[Any, Array]:
        """The state after `action_repeat` steps or the first that is done, and the sum of their rewards."""

        def body(carry: tuple[Any, Array, Array], _: None) -> tuple[tuple[Any, Array, Array], None]:
            before, total, done = carry
            after = once(before, action)
            following = (after, total + after.reward, after.done > 0)
            return trees.where(done, carry, following), None

        carry = (state, jnp.zeros((), jnp.float32), jnp.zeros((), bool))
        (state, total, _), _ = jax.lax.scan(body, carry, length=task.action_repeat)
        return state, total

    def advance(state: Any, action: Array) -> tuple[Any, Array, Array, Array]:
        with jax.default_matmul_precision("highest"):
            if task.action_repeat == 1:
                state = once(state, action)
                total = state.reward
            else:
                state, total = repeated(state, action)
        return state, _observed(state.obs), total, state.done > 0

    made = make_environment(
        name,
        observed.shape[0],
        action_size,
        task.steps,
        start,
        advance,
        min_mean_episode_length=1 if task.terminates else task.steps,
    )
    return made._replace(version=f"playground {metadata.version('playground')}")


def load(name: str, physics: str, arguments: Mapping[str, Any] | None = None, max_episode_steps: int = 0) -> Task:
    """Playground's own environment of a name with our prefix. It may download the models of robots, with git.

    Args:
      physics: one of `PHYSICS`.
      arguments: entries of its configuration, nested ones with dots (`reward_config.scales.energy`).
      max_episode_steps: its `episode_length`; 0: that of its configuration.

    Raises:
      ValueError: Playground is not installed, there is no such environment, it cannot be made, it has no such physics,
        or its robot's model is missing and cannot be downloaded. The text is one line.
    """
    check_name(name)
    if find_spec("mujoco_playground") is None:
        raise ValueError("needs the extra: pip install -e '.[playground]'")
    with _quiet():
        try:
            from mujoco_playground import dm_control_suite, registry
        except Exception as error:
            raise ValueError(with_place(error, __file__)) from error
        own_name = name.removeprefix(PREFIX)
        if own_name not in registry.ALL_ENVS:
            known = [PREFIX + known for known in registry.ALL_ENVS]
            raise ValueError(f"Playground has no such environment{did_you_mean(name, known)}")
        config = registry.get_default_config(own_name)
        overrides = _overrides(config, physics, dict(arguments or {}), max_episode_steps)
        in_suite = own_name in dm_control_suite.ALL_ENVS
        if not in_suite:
            _check_robots()
        try:
            config.update_from_flattened_dict(overrides)
        except Exception as error:
            raise ValueError(f"env_args: {one_line(error)}") from error
        try:
            env = registry.load(own_name, config=config)
            substeps, implementation = env.n_substeps, env.mjx_model.impl.value
        except Exception as error:  # of any type: the arguments are the user's
            raise ValueError(with_place(error, __file__)) from error
    if substeps < 1:
        raise ValueError(f"expects a ctrl_dt of at least sim_dt, not {config.ctrl_dt} and {config.sim_dt}")
    if implementation != IMPLEMENTATIONS[physics]:
        raise ValueError(f"computes with MJX's implementation {implementation} only: expects another --physics")
    for key in ("episode_length", "action_repeat"):
        if type(config[key]) is not int or config[key] < 1:
            raise ValueError(f"expects a positive whole number as {key}, not {config[key]!r}")
    return Task(
        env=env,
        steps=-(-config.episode_length // config.action_repeat),
        action_repeat=config.action_repeat,
        terminates=not in_suite,  # the suite's end only where the physics diverges
    )


def _overrides(config: Any, physics: str, arguments: dict[str, Any], max_episode_steps: int) -> dict[str, Any]:
    """The entries of a configuration to change, by name. Raises ValueError if it has no such entry."""
    known = list(_entries(config.to_dict()))
    if "impl" in arguments:
        raise ValueError("env_args: expects --physics instead of impl")
    if max_episode_steps and "episode_length" in arguments:
        raise ValueError("env_args: expects no episode_length with --max_episode_steps, which sets it")
    for key in arguments:
        if key not in known:
            raise ValueError(f"env_args: its configuration has no entry {key}{did_you_mean(key, known)}")
    chosen = {"impl": IMPLEMENTATIONS[physics]} if "impl" in known else {}
    return {**chosen, **arguments, **({"episode_length": max_episode_steps} if max_episode_steps else {})}


def _entries(tree: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The names of the values in nested dictionaries, with dots."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _entries(value, f"{prefix}{key}.")
        else:
            yield prefix + key


def _check_robots() -> None:
    """Raises ValueError if the models of robots are neither here nor can be downloaded.

    Playground clones them when it loads an environment. Git is asked first whether it could: it knows proxies and
    mirrors, and a clone without a network may wait for minutes.
    """
    from mujoco_playground._src import mjx_env

    folder = Path(mjx_env.MENAGERIE_PATH)
    if folder.exists():
        return
    command = ["git", "ls-remote", "--exit-code", ROBOTS, "HEAD"]
    silent = {**os.environ, "GIT_TERMINAL_PROMPT": "0"}
    try:
        subprocess.run(
            command, check=True, capture_output=True, stdin=subprocess.DEVNULL, timeout=SECONDS_TO_ANSWER, env=silent
        )
    except (OSError, subprocess.SubprocessError):
        raise ValueError(
            f"needs the robots' models, which git cannot download here: clone {ROBOTS} elsewhere, check out "
            f"{mjx_env.MENAGERIE_COMMIT_SHA}, and copy it to {folder}"
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """While Playground is imported and loads a model: without its warnings, and with a name that it still calls."""
    handler = mujoco.get_mju_user_warning()
    # About the XML of its models. MuJoCo would write them to MUJOCO_LOG.TXT in the current folder, too.
    mujoco.set_mju_user_warning(lambda message: None)
    # Its reacher compares versions as text, takes "3.17.0" for older than "3.3.0", and calls what MuJoCo has renamed.
    renamed = not hasattr(mujoco.MjSpec, "find_body")
    if renamed:
        mujoco.MjSpec.find_body = mujoco.MjSpec.body
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(handler)
        if renamed:
            del mujoco.MjSpec.find_body


def _observed(obs: Any) -> Any:
    """What the agent sees of an observation; None: it is a dictionary of other things."""
    return obs.get(OBSERVED) if isinstance(obs, Mapping) else obs


def _raw(key: Array) -> Array:
    """A key as Playground expects it: the array of `jax.random.PRNGKey`."""
    return jax.random.key_data(key)
