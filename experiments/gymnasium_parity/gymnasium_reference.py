"""What Gymnasium's own environments do: single steps from recorded states, and whole episodes."""

import warnings
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sqt_jax.envs import TASKS


class Recorded(NamedTuple):
    """One control step of MuJoCo C in float64 from some states of random rollouts, solver not warm-started."""

    qpos: np.ndarray
    qvel: np.ndarray
    action: np.ndarray  # in [-1, 1]
    first_obs: np.ndarray
    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    next_qvel: np.ndarray


def gymnasium_environment(name: str) -> Any:
    import gymnasium

    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make(TASKS[name].gymnasium_id).unwrapped
    mujoco.set_mju_user_warning(handler)
    return env


def recorded(name: str, count: int) -> Recorded:
    """Evenly spaced states of a random rollout, and up to eight whose next step terminates the episode."""
    env = gymnasium_environment(name)
    generator = np.random.default_rng(0)
    scale = env.model.actuator_ctrlrange[:, 1]
    states, last = [], []
    env.reset(seed=0)
    for _ in range(6 * count):
        action = generator.uniform(-1, 1, env.model.nu).astype(np.float32)
        state = (env.data.qpos.copy(), env.data.qvel.copy(), action)
        if env.step(action * scale)[2]:
            last.append(state)
            env.reset()
        else:
            states.append(state)
    last = last[:8]
    spread = np.linspace(0, len(states) - 1, count - len(last)).astype(int)
    rows = []
    for qpos, qvel, action in last + [states[i] for i in spread]:
        mujoco.mj_resetData(env.model, env.data)
        env.set_state(qpos, qvel)
        first_obs = env._get_obs()
        obs, reward, terminated, *_ = env.step(action * scale)
        rows.append((qpos, qvel, action, first_obs, obs, reward, terminated, env.data.qvel.copy()))
    return Recorded(*(np.array(column) for column in zip(*rows, strict=True)))


class Episode(NamedTuple):
    """A whole episode in Gymnasium from given (qpos, qvel), float32 numbers: what each of its steps gave."""

    qpos: np.ndarray
    qvel: np.ndarray
    first_obs: np.ndarray
    actions: np.ndarray  # [T, A] in [-1, 1]
    obs: np.ndarray  # [T, O]
    reward: np.ndarray  # [T]
    terminated: np.ndarray  # [T]


def episode(name: str, seed: int, scale: float, steps: int = 1000) -> Episode:
    """Random actions of a size in [-scale, scale] until the episode terminates."""
    env = gymnasium_environment(name)
    env.reset(seed=seed)
    qpos, qvel = env.data.qpos.astype(np.float32), env.data.qvel.astype(np.float32)
    mujoco.mj_resetData(env.model, env.data)
    env.set_state(qpos.astype(np.float64), qvel.astype(np.float64))
    first_obs = env._get_obs()
    generator = np.random.default_rng(seed)
    limit = env.model.actuator_ctrlrange[:, 1].astype(np.float32)
    actions, rows = [], []
    for _ in range(steps):
        actions.append(generator.uniform(-scale, scale, env.model.nu).astype(np.float32))
        obs, reward, terminated, *_ = env.step(actions[-1] * limit)
        rows.append((obs, reward, terminated))
        if terminated:
            break
    return Episode(qpos, qvel, first_obs, np.array(actions), *(np.array(column) for column in zip(*rows, strict=True)))
