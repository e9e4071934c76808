"""Gymnasium environments of the tests. Importing this module registers `Counter-v0` and `Mixed-v0`."""

import os
import time

import gymnasium
import numpy as np
from gymnasium import spaces


class Counter(gymnasium.Env):
    """obs = (random start, steps made, first entry of the last action); the reward is the number of steps made.

    The second entry of an action above 0.5 terminates, below -0.5 truncates; the third makes numbers that are not
    finite: below -0.5 the observation, above 0.5 the reward. Starts above `bad_above` are observed as NaN.

    Args:
      fails_at: raises an exception at this step, counted over all episodes; 0: never.
      exits_at: the same, but ends its process.
      seconds: how long a step takes.
      unruly: each step changes the current folder, and `close` fails.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, bad_above=2.0, fails_at=0, exits_at=0, seconds=0.0, unruly=False, render_mode=None):
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = spaces.Box(-1, 1, (3,), np.float64)
        self.bad_above, self.fails_at, self.exits_at, self.seconds = bad_above, fails_at, exits_at, seconds
        self.render_mode, self.unruly = render_mode, unruly
        self.made = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed, self.steps = seed, 0
        self.start = self.np_random.uniform()
        return self._obs(0.0, self.start > self.bad_above), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.made, self.steps = self.made + 1, self.steps + 1
        if self.made == self.exits_at:
            os._exit(7)
        if self.made == self.fails_at:
            raise RuntimeError("the simulator\nis gone") from OSError("a file's name that is not UTF-8: \udcff")
        if self.unruly:
            os.chdir("/")
        time.sleep(self.seconds)
        reward = np.inf if action[2] > 0.5 else self.steps
        return self._obs(action[0], action[2] < -0.5), reward, action[1] > 0.5, action[1] < -0.5, {"seed": self.seed}

    def render(self):
        return np.full((15, 21, 3), min(self.steps, 255), np.uint8)

    def close(self):
        if self.unruly and self.made:
            raise RuntimeError("it is still\nin use")

    def _obs(self, action, broken):
        return np.array([np.nan if broken else self.start, self.steps, action])


class Mixed(gymnasium.Env):
    """Observations of several kinds, and actions of an asymmetric box of two rows."""

    observation_space = spaces.Dict({"image": spaces.Box(0, 255, (2, 2), np.uint8), "mode": spaces.Discrete(3)})
    action_space = spaces.Box(np.array([[-1], [0]], np.float32), np.array([[1], [10]], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.observation_space.seed(0)
        return self.observation_space.sample(), float(action.sum()), False, False, {}


SAME = Counter()


def counter(**arguments):
    """For `--env=host_tasks:counter`."""
    return Counter(**arguments)


def same():
    """The same environment at each call, which is an error."""
    return SAME


gymnasium.register("Counter-v0", "host_tasks:Counter", max_episode_steps=5)
gymnasium.register("Mixed-v0", "host_tasks:Mixed", max_episode_steps=10)
gymnasium.register("Endless-v0", "host_tasks:Counter")
