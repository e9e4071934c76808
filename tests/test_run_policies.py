"""The members' best policies: which evaluation is the best, and what a checkpoint and a run's end hold of them."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import probe_envs
import pytest

from experiments.running import run_policies
from experiments.running.manifests import CannotResume
from experiments.running.run_policies import Best, Evaluated, RunPolicies, improved
from sqt_jax import experiment
from sqt_jax.policy import load_policy

NAN = np.nan


def policies_of(value, members=2):
    """Made-up parameters [S, 3]: member m's are `value` + 100 m."""
    return {"w": np.float32(value + 100 * np.arange(members))[:, None] * np.ones(3, np.float32)}


def after(*returns):
    """The best ones after evaluations with these mean returns of two members, at steps 0, 10, 20, ..."""
    best = Best(policies_of(-1), (None, None))
    for index, means in enumerate(returns):
        episodes = np.array(means, np.float32)[:, None] + np.float32([[-1, 1]])
        best = improved(best, episodes, 10 * index, lambda index=index: policies_of(index))
    return best


@pytest.mark.parametrize(
    ("returns", "entries", "values"),
    [
        ([], (None, None), (-1, 99)),
        ([(1, 5)], (Evaluated(1, 0), Evaluated(5, 0)), (0, 100)),
        # each member has its own, and of equal ones the first
        ([(1, 5), (3, 4), (2, 5)], (Evaluated(3, 10), Evaluated(5, 0)), (1, 100)),
        ([(-9, 5), (-8, 6), (-7, 7)], (Evaluated(-7, 20), Evaluated(7, 20)), (2, 102)),
        # a member that has diverged
        ([(1, 5), (2, NAN), (3, NAN)], (Evaluated(3, 20), Evaluated(5, 0)), (2, 100)),
        ([(NAN, 5), (NAN, 4)], (None, Evaluated(5, 0)), (-1, 100)),
    ],
)
def test_the_best_evaluation_of_each_member(returns, entries, values):
    best = after(*returns)
    assert best.evaluations == entries
    assert best.arrays["w"].tolist() == [[value] * 3 for value in values] and best.arrays["w"].dtype == np.float32


def test_policies_are_copied_only_if_a_member_has_improved():
    best = after((1, 5))

    def never():
        raise AssertionError

    assert improved(best, np.float32([[1], [4]]), 10, never) is best


def test_the_mean_is_the_one_of_evaluations_csv():
    """The mean over an axis of an array is rounded in another way: equal returns would be better or worse ones."""
    returns = np.random.default_rng(0).normal(3_000, 800, (50, 10)).astype(np.float32)
    best = improved(Best({}, (None,) * 50), returns, 0, lambda: {})
    assert [entry.return_mean for entry in best.evaluations] == [float(row.mean()) for row in returns]


@pytest.fixture(scope="module")
def made():
    """A run's config, its environment, and agents' states of two members and one of padding."""
    env = probe_envs.constant_reward()
    config = experiment.make_config("td3", "cheetah", hidden=(8, 8))
    agent, generator = experiment.agent_of(config, env), np.random.default_rng(1)
    shapes = jax.eval_shape(lambda key: jax.vmap(agent.init)(jax.random.split(key, 3)), jax.random.key(1))

    def state():
        return jax.tree.map(lambda leaf: generator.normal(0, 0.5, leaf.shape).astype(leaf.dtype), shapes)

    return SimpleNamespace(config=config, env=env, first=state(), second=state(), last=state())


OBS = np.linspace(-1, 1, 6, dtype=np.float32).reshape(3, 2)


def trained(made):
    """Member 0 is best at step 10, member 1 at the start."""
    policies = RunPolicies(made.config, made.env, 2)
    policies.start(made.first)
    policies.evaluated(made.first, 0, np.float32([[1], [5]]))
    policies.evaluated(made.second, 10, np.float32([[3], [4]]))
    return policies


def test_the_files_of_a_checkpoint_and_of_the_end(made, tmp_path):
    policies = trained(made)
    write = policies.writer(made.last)
    policies.evaluated(made.last, 20, np.float32([[9], [9]]))  # training goes on while it is written
    (tmp_path / "checkpoint" / "step_0000000010").mkdir(parents=True)
    write(tmp_path / "checkpoint" / "step_0000000010")
    names = {"config.json", "member_0.npz", "member_1.npz"}
    folder = tmp_path / "checkpoint" / "step_0000000010"
    assert {item.name for item in (folder / "policy").iterdir()} == names
    assert {item.name for item in (folder / "policy_best").iterdir()} == names | {"best.json"}
    assert sum(item.stat().st_size for item in folder.rglob("*.npz")) > policies.bytes_in_checkpoint(made.last) / 3
    expected = {"last": made.last, "best 0": made.second, "best 1": made.first}
    actor = experiment.agent_of(made.config, made.env).views
    for name, member in (("last", 1), ("best 0", 0), ("best 1", 1)):
        params = jax.tree.map(lambda leaf, member=member: leaf[member], actor.policy(expected[name]))
        loaded = load_policy(tmp_path, member, best=name != "last")(OBS)
        np.testing.assert_allclose(loaded, actor.policy_action(params, OBS), rtol=1e-6)
    policies.write_results(tmp_path, made.last)
    policies.write_results(tmp_path, made.last)  # in place of the first ones
    assert {item.name for item in (tmp_path / "policy_best").iterdir()} == names | {"best.json", "act.stablehlo"}
    assert {item.name for item in tmp_path.iterdir()} == {"checkpoint", "policy", "policy_best"}
    assert run_policies.read_evaluations(tmp_path / "policy_best") == {0: Evaluated(9.0, 20), 1: Evaluated(9.0, 20)}


def test_the_best_ones_are_restored_bit_for_bit(made, tmp_path):
    policies = trained(made)
    policies.writer(made.last)(tmp_path)
    restored = RunPolicies(made.config, made.env, 2)
    restored.restore(tmp_path)
    assert restored.best.evaluations == policies.best.evaluations == (Evaluated(3.0, 10), Evaluated(5.0, 0))
    assert restored.best.arrays.keys() == policies.best.arrays.keys()
    for name, array in policies.best.arrays.items():
        assert restored.best.arrays[name].tobytes() == array.tobytes()


def best_is(content):
    return lambda folder: (folder / "best.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda folder: (folder / "member_1.npz").unlink(), "member_1.npz: there is no such file"),
        (lambda folder: (folder / "member_1.npz").write_bytes(b"PK"), "not the parameters of a policy"),
        (lambda folder: (folder / "best.json").unlink(), "No such file"),
        (best_is([None]), "is of 1 members"),
        (best_is(3), "not the best evaluations"),
        (best_is([3, None]), "not the best evaluations"),
        (best_is([{"return_mean": 1.0}, None]), "not the best evaluations"),
        (best_is([{"return_mean": 1.0, "env_steps": -1}, None]), "not the best evaluations"),
        (best_is([{"return_mean": "1.0", "env_steps": 1}, None]), "not the best evaluations"),
    ],
)
def test_damaged_best_policies_are_not_restored(made, tmp_path, damage, says):
    trained(made).writer(made.last)(tmp_path)
    damage(tmp_path / "policy_best")
    with pytest.raises(CannotResume, match=f"its best policies cannot be read: .*{says}"):
        RunPolicies(made.config, made.env, 2).restore(tmp_path)
    other = experiment.make_config("td3", "cheetah", hidden=(8, 9))
    with pytest.raises(CannotResume):
        RunPolicies(other, made.env, 2).restore(tmp_path)
