"""A saved policy acts as the agent that it was saved from, and loading refuses what does not fit."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import probe_envs
import pytest

from experiments.presets import preset_settings
from sqt_jax import algorithms, policy
from sqt_jax.algorithms import ALGORITHMS


def saved(algo, directory, members=2, **settings):
    env = probe_envs.constant_reward()
    config = algorithms.make_config(algo, "cheetah", hidden=(8, 8), **settings)
    agent = algorithms.agent_of(config, env)
    state = jax.vmap(agent.init)(jax.random.split(jax.random.key(1), members))
    policy.save_policy(directory, config, env, state)
    return agent, state


RELEASED = {f"{algo} released": preset_settings("released", algo, "cheetah") for algo in ("td3", "sac", "td7")}


@pytest.mark.parametrize("algo", [*ALGORITHMS, *RELEASED])
def test_a_loaded_policy_gives_the_members_actions(algo, tmp_path):
    agent, state = saved(algo.split()[0], tmp_path / "policy", **RELEASED.get(algo, {}))
    obs = jnp.linspace(-1, 1, 6).reshape(3, 2)
    for member in range(2):
        own = jax.tree.map(lambda leaf, member=member: leaf[member], state)
        expected = agent.act(own, obs, jax.random.key(0), deterministic=True)
        np.testing.assert_allclose(policy.load_policy(tmp_path / "policy", member)(obs), expected, rtol=1e-5)


def test_an_existing_policy_is_not_overwritten(tmp_path):
    saved("td3", tmp_path / "policy")
    with pytest.raises(FileExistsError):
        saved("td3", tmp_path / "policy")


def test_parameters_of_other_sizes_are_refused(tmp_path):
    saved("td3", tmp_path / "policy")
    path = tmp_path / "policy" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"action_size": 3}))
    with pytest.raises(ValueError, match="does not hold a policy"):
        policy.load_policy(tmp_path / "policy")


def test_pickled_content_is_refused(tmp_path):
    saved("td3", tmp_path / "policy")
    np.savez(tmp_path / "policy" / "member_0.npz", x=np.array([{"code": 1}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        policy.load_policy(tmp_path / "policy")


def test_a_missing_member_is_named(tmp_path):
    saved("td3", tmp_path / "policy")
    with pytest.raises(FileNotFoundError, match="member_7"):
        policy.load_policy(tmp_path / "policy", member=7)


ELSEWHERE = """
import pathlib, sys
import jax, jax.export
import numpy as np
act = jax.export.deserialize(pathlib.Path("policy/act.stablehlo").read_bytes())
obs = np.linspace(-1, 1, 6, dtype=np.float32).reshape(3, 2)
np.save("action.npy", act.call(dict(np.load("policy/member_1.npz")), obs))
assert "sqt_jax" not in sys.modules and "flax" not in sys.modules
"""


@pytest.mark.parametrize("algo", ["td3", "sac_sqt", "td7"])
def test_the_exported_policy_runs_without_this_package(algo, tmp_path):
    saved(algo, tmp_path / "policy")
    subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=tmp_path, check=True, timeout=120)
    obs = jnp.linspace(-1, 1, 6).reshape(3, 2)
    expected = policy.load_policy(tmp_path / "policy", 1)(obs)
    np.testing.assert_allclose(np.load(tmp_path / "action.npy"), expected, rtol=1e-5, atol=1e-6)
