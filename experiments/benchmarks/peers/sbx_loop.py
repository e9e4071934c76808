"""SBX (https://github.com/araffin/sbx) training end to end: `python sbx_loop.py td3 Ant-v4 SEED`."""

import sys
import warnings

import gymnasium
import numpy as np
import sbx
from stable_baselines3.common.noise import NormalActionNoise

LEARNING_STARTS = 300
COMMON = {
    "batch_size": 256,
    "buffer_size": 100_000,
    "gamma": 0.99,
    "gradient_steps": 1,
    "learning_rate": 3e-4,
    "learning_starts": LEARNING_STARTS,
    "policy_kwargs": {"net_arch": [256, 256]},
    "tau": 0.005,
    "train_freq": 1,
}


def make(algo: str, task: str, seed: int) -> sbx.TD3 | sbx.SAC:
    """SBX's agent with the settings of ours: `algo` is td3 or sac, `task` a Gymnasium id."""
    env = gymnasium.make(task)
    if algo == "sac":
        return sbx.SAC("MlpPolicy", env, seed=seed, ent_coef=0.2, **COMMON)
    size = gymnasium.spaces.flatdim(env.action_space)
    noise = NormalActionNoise(np.zeros(size), np.full(size, 0.1))
    return sbx.TD3("MlpPolicy", env, seed=seed, action_noise=noise, policy_delay=2, **COMMON)


def main(algo: str, task: str, seed: str) -> None:
    """Trains as many steps as each line of stdin says."""
    warnings.simplefilter("ignore")
    model = make(algo, task, int(seed))
    model.learn(LEARNING_STARTS + 50)
    print("ready", flush=True)
    for line in sys.stdin:
        model.learn(int(line), reset_num_timesteps=False)
        print("done", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
