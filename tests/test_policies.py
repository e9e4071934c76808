"""The member of a run that is chosen, and its policy."""

import json
import math
import shutil

import numpy as np
import probe_envs
import pytest
from made_runs import add_policies, write_run

from experiments.commandline.arguments import UsageError
from experiments.playing import policies
from sqt_jax import envs
from sqt_jax.policy import load_policy

NAN = math.nan


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Seeds 3 and 5 times two coefficients: members 0 to 3 are (3, 0.1), (5, 0.1), (3, 0.5), (5, 0.5)."""
    folder = tmp_path_factory.mktemp("runs")
    swept = {"penalty_coef": (0.1, 0.5)}
    path = write_run(folder, "td3_sqt", "hopper", [[0, 1]] * 4, seeds=(3, 5), swept=swept, hidden=(8, 8))
    add_policies(path, envs.make("hopper", "mujoco"), [10, 40, 30, 20])
    return path


@pytest.mark.parametrize(
    ("returns", "asked", "member", "why"),
    [
        ([10, 40, 30, 20], {}, 1, "the best of 4 at the last evaluation"),
        ([10, NAN, 30, 20], {}, 2, "the best of 4 at the last evaluation"),
        ([NAN] * 4, {}, 0, "the first of 4: none has an evaluation"),
        ([10, 40, 30, 20], {"seed": 3}, 2, "the best of 2 with this seed at the last evaluation"),
        ([NAN] * 4, {"seed": 5}, 1, "the first of 2 with this seed: none has an evaluation"),
        ([10, 40, 30, 20], {"number": 0}, 0, "of 4"),
        ([10, 40, 30, 20], {"number": 3, "seed": 5}, 3, "of 4"),
    ],
)
def test_the_best_of_the_requested_members_is_chosen(run, returns, asked, member, why):
    chosen = policies.choose(policies.read(run), returns, **asked)
    assert (chosen.number, chosen.why) == (member, why)
    assert chosen.member.seed == (3, 5)[member % 2]
    assert chosen.member.config.agent.penalty_coef == (0.1, 0.5)[member // 2]


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"seed": 4}, "--seed=4: expects a seed of the run, one of 3, 5"),
        ({"number": 4}, "--member=4: expects one of the run's members, 0 to 3"),
        ({"number": 1, "seed": 3}, "--seed=3: member 1 has seed 5; expects only one of --seed and --member"),
    ],
)
def test_members_that_the_run_does_not_have(run, asked, says):
    with pytest.raises(UsageError) as error:
        policies.choose(policies.read(run), [NAN] * 4, **asked)
    assert str(error.value) == says


def test_the_caption(run):
    described = policies.read(run)
    chosen = policies.choose(described, policies.member_returns(run, 4))
    says = "td3_sqt on hopper: member 1, seed 5, penalty_coef 0.1 (the best of 4 at the last evaluation)"
    assert policies.caption(described, chosen) == says


@pytest.mark.parametrize(
    ("content", "returns"),
    [
        ({"members": [{"member": 1, "final_return": 5}, {"member": 0, "final_return": None}]}, [NAN, 5.0]),
        ({"members": [{"member": 7, "final_return": 5}, {"member": True, "final_return": 5}]}, [NAN, NAN]),
        ({"members": [{"member": 0, "final_return": "many"}]}, [NAN, NAN]),
        ({"members": [3]}, [NAN, NAN]),
        ([], [NAN, NAN]),
        (None, [NAN, NAN]),
    ],
)
def test_returns_of_a_summary_that_may_be_damaged(tmp_path, content, returns):
    if content is not None:
        (tmp_path / "summary.json").write_text(json.dumps(content))
    found = policies.member_returns(tmp_path, 2)
    assert [math.isnan(value) for value in found] == [math.isnan(value) for value in returns]
    assert [value for value in found if value == value] == [value for value in returns if value == value]


def test_returns_of_a_run_that_was_killed_are_those_of_its_table(tmp_path):
    path = write_run(tmp_path, curves=[[1, 7, 5], [2, 3, NAN], [4, 3, 6]])
    assert policies.member_returns(path, 3)[::2] == [5, 6] and math.isnan(policies.member_returns(path, 3)[1])
    assert policies.member_returns(path, 3, best=True) == [7, 3, 6]
    with (path / "evaluations.csv").open("a") as file:
        file.write("0,150,1")  # killed within a row
    assert policies.member_returns(path, 3, best=True)[1:] == [3, 6]


def killed(run, path):
    """A copy of the run as it is before training ends: its policies are in checkpoints, the best ones too."""
    shutil.copytree(run, path)
    for step in (40, 50_000):
        for kind in ("policy", "policy_best"):
            shutil.copytree(run / "policy", path / "checkpoint" / f"step_{step:010}" / kind)
    for folder in path.glob("checkpoint/*/policy_best"):
        best = [{"return_mean": 4321.5, "env_steps": 30_000}, *[None] * 3]
        (folder / "best.json").write_text(json.dumps(best))
    shutil.rmtree(path / "policy")
    return path


def test_a_run_that_was_killed_plays_its_newest_checkpoint(run, tmp_path, monkeypatch):
    path, env, described = killed(run, tmp_path / "run"), envs.make("hopper", "mujoco"), policies.read(run)
    first, second = (policies.choose(described, [NAN] * 4, number=number) for number in (0, 1))
    loaded = policies.load(path, first, env)
    assert loaded.origin == "the last one, from the checkpoint at step 50,000"
    np.testing.assert_array_equal(loaded.policy([[0.5] * 11]), policies.load(run, first, env).policy([[0.5] * 11]))
    assert policies.load(path, first, env, best=True).origin == (
        "the best evaluated one, of step 30,000 with return 4,321.5 (the best of many evaluations: new starts usually "
        "return less), from the checkpoint at step 50,000"
    )
    origin = policies.load(path, second, env, best=True).origin
    assert origin == "the initial one (the member has no evaluation), from the checkpoint at step 50,000"

    def removed(folder, member):
        """Training removes the checkpoint when some of its files have been read."""
        policy = load_policy(folder, member)
        shutil.rmtree(path / "checkpoint" / "step_0000050000", ignore_errors=True)
        return policy

    monkeypatch.setattr(policies, "load_policy", removed)
    assert policies.load(path, first, env).origin == "the last one, from the checkpoint at step 40"


def test_a_run_of_an_earlier_version_has_no_best_policies(run):
    chosen = policies.choose(policies.read(run), [NAN] * 4, number=0)
    with pytest.raises(UsageError, match=r"expects a run with policy_best/, .*; it has none$"):
        policies.load(run, chosen, envs.make("hopper", "mujoco"), best=True)


def test_the_policy_of_the_member_is_loaded(run):
    env = envs.make("hopper", "mujoco")
    described = policies.read(run)
    actions = []
    for number in (0, 1):
        loaded = policies.load(run, policies.choose(described, [NAN] * 4, number=number), env)
        assert loaded.origin == "the last one"
        actions.append(loaded.policy([[0.5] * 11]))
    assert actions[0].shape == (1, 3) and not (actions[0] == actions[1]).any()


def no_policy(path):
    shutil.rmtree(path / "policy")


def no_member(path):
    (path / "policy" / "member_1.npz").unlink()


def damaged(path):
    (path / "policy" / "member_1.npz").write_bytes(b"PK")


def other_sizes(path):
    shutil.rmtree(path / "policy")
    add_policies(path, probe_envs.constant_reward())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            no_policy,
            "expects a run with policy/, which is saved with each checkpoint and when training ends; it has none",
        ),
        (no_member, "member_1.npz: there is no such file"),
        (damaged, "member_1.npz: not the parameters of a policy"),
        (other_sizes, "policy: is not a policy for hopper: its sizes are 2 and 1"),
    ],
)
def test_a_policy_that_cannot_be_played_is_rejected_in_one_line(run, tmp_path, change, says):
    path = tmp_path / "run"
    shutil.copytree(run, path)
    change(path)
    chosen = policies.choose(policies.read(path), policies.member_returns(path, 4))
    with pytest.raises(UsageError) as error:
        policies.load(path, chosen, envs.make("hopper", "mujoco"))
    assert says in str(error.value) and str(error.value).startswith(str(path)) and str(error.value).isprintable()


def test_a_folder_without_a_run_is_rejected(tmp_path):
    with pytest.raises(UsageError, match="expects the folder of a run; it has no config.json that can be read"):
        policies.read(tmp_path)
