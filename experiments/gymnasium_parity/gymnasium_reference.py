"""Reference data of Gymnasium's own environments: single steps from recorded states, and complete episodes."""

import warnings
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np

from sqt_jax.envs import TASKS


class Recorded(NamedTuple):
    """One control step of MuJoCo C in float64 from N states of random rollouts, solver not warm-started."""

    qpos: np.ndarray  # [N, nq]
    qvel: np.ndarray  # [N, nv]
    action: np.ndarray  # [N, A] in [-1, 1]
    first_obs: np.ndarray  # [N, O], before the step
    obs: np.ndarray  # [N, O], after the step
    reward: np.ndarray  # [N]
    terminated: np.ndarray  # [N]
    next_qvel: np.ndarray  # [N, nv]


def gymnasium_environment(name: str) -> Any:
    """Gymnasium's environment of a task, without wrappers."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make(TASKS[name].gymnasium_id).unwrapped
    mujoco.set_mju_user_warning(handler)
    return env


def recorded(name: str, count: int) -> Recorded:
    """`count` states of a task: evenly spaced ones of a random rollout, up to eight of which end their episode."""
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
        rows.append(
            Recorded(
                qpos=qpos,
                qvel=qvel,
                action=action,
                first_obs=first_obs,
                obs=obs,
                reward=reward,
                terminated=terminated,
                next_qvel=env.data.qvel.copy(),
            )
        )
    return Recorded(*map(np.array, zip(*rows, strict=True)))


class RecordedEpisode(NamedTuple):
    """A complete episode in Gymnasium of T steps, from an initial state of float32 numbers."""

    qpos: np.ndarray  # [nq], initial
    qvel: np.ndarray  # [nv], initial
    first_obs: np.ndarray  # [O]
    actions: np.ndarray  # [T, A] in [-1, 1]
    obs: np.ndarray  # [T, O]
    reward: np.ndarray  # [T]
    terminated: np.ndarray  # [T]


def record_episode(name: str, seed: int, scale: float, steps: int = 1000) -> RecordedEpisode:
    """An episode of random actions in [-scale, scale] until it terminates, of at most `steps` steps."""
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
        step = env.step(actions[-1] * limit)[:3]
        rows.append(step)
        if step[2]:
            break
    obs, reward, terminated = (np.array(column) for column in zip(*rows, strict=True))
    return RecordedEpisode(
        qpos=qpos,
        qvel=qvel,
        first_obs=first_obs,
        actions=np.array(actions),
        obs=obs,
        reward=reward,
        terminated=terminated,
    )
