"""Episodes of several Gymnasium environments on the host, in lockstep. NumPy only: JAX must not be used in a callback.

The numbers of a step are packed in one row per environment, because they cross to the compiled program in one array.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np

from sqt_jax.envs import gym_spaces
from sqt_jax.envs.autoreset import LARGEST
from sqt_jax.one_line import one_line

KEY_WORDS = 3  # of a start: two of the key, and the steps made before it
Make = Callable[[], gymnasium.Env]


class Steps(NamedTuple):
    """The results of one step, or of a start, in K environments; the terms are those of `types.TimeStep`."""

    obs: Any  # [K, O]; all are arrays of NumPy, or of JAX in the program
    final_obs: Any  # [K, O]
    reward: Any  # [K]
    terminated: Any  # [K]
    truncated: Any  # [K]
    unstable: Any  # [K]: 1 where reward, observation or action was not finite
    unstable_starts: Any  # [K]: 1 where the observation of a start was not finite

    @classmethod
    def packed_size(cls, observation_size: int) -> int:
        """Numbers in a packed row."""
        return 2 * observation_size + len(cls._fields) - 2

    @classmethod
    def of(cls, packed: Any, observation_size: int) -> "Steps":
        """The views of packed rows [..., P], of NumPy or JAX."""
        o = observation_size
        columns = (packed[..., 2 * o + i] for i in range(len(cls._fields) - 2))
        return cls(packed[..., :o], packed[..., o : 2 * o], *columns)


class Rows(Protocol):
    """K environments that are stepped together. Errors of the environments pass through."""

    def start(self, keys: np.ndarray) -> np.ndarray:
        """New episodes in all environments: keys [K, 3] uint32 -> packed rows [K, P] float32."""

    def step(self, actions: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """One step: actions [K, A], keys [K, 3] of the starts of episodes that follow -> packed rows [K, P] float32."""

    def close(self) -> None:
        """Closes the environments, as `close`."""


class LocalRows:
    """`Rows` in this process, stepped one after another.

    Args:
      make: makes one environment. It is called when the first episodes start.
      count: K.

    `start` raises ValueError if `make` gives the same environment again.
    """

    def __init__(self, make: Make, count: int):
        self.make, self.count = make, count
        self.envs: list[gymnasium.Env] = []

    def start(self, keys: np.ndarray) -> np.ndarray:
        """As in `Rows`."""
        while len(self.envs) < self.count:
            made = self.make()
            if any(made.unwrapped is env.unwrapped for env in self.envs):
                raise ValueError(f"expects a new environment from each call, not the same {made} again")
            self.envs.append(made)
        space = self.envs[0].observation_space
        self.observations = gym_spaces.observations(space)
        self.actions = gym_spaces.actions(self.envs[0].action_space)
        self.start_seeds: list[int | None] = [None] * self.count  # of the last finite start of each environment
        packed, steps = self._rows()
        for i in range(self.count):
            self._begin(i, keys[i], steps)
        steps.final_obs[:] = steps.obs
        self.obs = steps.obs.copy()
        return packed

    def step(self, actions: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """As in `Rows`."""
        packed, steps = self._rows()
        given = ~np.isnan(actions).any(axis=1)
        elements = self.actions.scale(np.where(given[:, None], actions, 0))
        for i, env in enumerate(self.envs):
            stable = given[i]
            if stable:  # an action that is not a number is not shown to the environment
                obs, reward, terminated, truncated, _ = env.step(elements[i])
                vector, number = self._vector(obs), _float32(reward)
                stable = _in_range(vector) and _in_range(number)
            if stable:
                steps.final_obs[i], steps.reward[i] = vector, number.item()
                steps.terminated[i], steps.truncated[i] = bool(terminated), bool(truncated)
            else:
                steps.final_obs[i], steps.terminated[i], steps.unstable[i] = self.obs[i], 1, 1
            steps.obs[i] = steps.final_obs[i]
            if steps.terminated[i] or steps.truncated[i]:
                self._begin(i, keys[i], steps)
        self.obs = steps.obs.copy()
        return packed

    def close(self) -> None:
        """As in `Rows`."""
        envs, self.envs = self.envs, []
        for env in envs:
            close(env)

    def _begin(self, i: int, key: np.ndarray, steps: Steps) -> None:
        """Starts an episode in environment `i`."""
        seed = start_seed(key)
        obs = self._reset(i, seed)
        if _in_range(obs):
            self.start_seeds[i] = seed
        else:
            steps.unstable_starts[i] = 1
            before = self.start_seeds[i]
            obs = obs if before is None else self._reset(i, before)
            obs = np.where(np.abs(obs) < LARGEST, obs, 0)
        steps.obs[i] = obs

    def _reset(self, i: int, seed: int) -> np.ndarray:
        return self._vector(self.envs[i].reset(seed=seed)[0])

    def _vector(self, obs: Any) -> np.ndarray:
        with np.errstate(over="ignore"):  # beyond float32: infinite, which is not stable
            return self.observations.flatten(obs)

    def _rows(self) -> tuple[np.ndarray, Steps]:
        size = self.observations.size
        packed = np.zeros((self.count, Steps.packed_size(size)), np.float32)
        return packed, Steps.of(packed, size)


def close(env: gymnasium.Env) -> None:
    """Closes an environment. Its error is a warning: no result depends on it any more."""
    try:
        env.close()
    except (Exception, SystemExit) as error:
        warnings.warn(f"an environment could not be closed: {one_line(error)}", stacklevel=2)


def start_seed(key: np.ndarray) -> int:
    """The seed of `reset` for a start with this key [3] uint32: 31 bits, which every random generator accepts."""
    return int(np.random.SeedSequence(key.tolist()).generate_state(1)[0] >> 1)


def _float32(number: Any) -> np.ndarray:
    if number is None:  # NumPy would make it NaN
        raise ValueError("reward: expects a number, not None")
    with np.errstate(over="ignore"):
        return np.asarray(number, np.float32)


def _in_range(x: np.ndarray) -> bool:
    return bool(np.all(np.abs(x) < LARGEST))  # false for NaN too
