"""config.json of a run records its settings, and is read back as the same run."""

import json
from datetime import UTC, datetime
from itertools import product

import pytest

from experiments.running import run_config
from experiments.running.run_config import default_name
from sqt_jax.experiment import make_config

OUTPUT = {"tensorboard": True, "checkpoint_every": 20, "keep_checkpoints": 2}


def test_default_name_has_the_changed_settings():
    now = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert default_name({}, now) == "20250102T030405Z"
    name = default_name({"preset": "quick", "hidden": (64, 32), "lr": 0.001, "seeds": (0, 1)}, now)
    assert name == "preset=quick_hidden=64+32_lr=0.001_seeds=0+1_20250102T030405Z"
    assert len(default_name({"seeds": tuple(range(1000))}, now)) < 200


def members_of(algo="sac_sqt", seeds=(3, 1), sweep=None, **settings):
    """Members and the names of the swept settings."""
    sweep = sweep or {}
    small = {"hidden": (8, 4), "steps": 60, "warmup_steps": 20, "batch_size": 8}
    configs = [
        make_config(algo, "ant", **small | settings | dict(zip(sweep, values, strict=True)))
        for values in product(*sweep.values())
    ]
    return run_config.make_members(seeds, configs), list(sweep)


RUNS = {
    "plain": {},
    "one seed": {"seeds": (2**32 - 1,)},
    "swept": {"sweep": {"penalty_coef": (0.0, 0.5), "lr": (1e-3, 3e-4, 1e-4)}},
    "td7": {"algo": "td7_sqt", "embedding_size": 8, "sweep": {"gamma": (0.9, 0.99)}},
    "several environments": {"num_envs": 4, "eval_every": 20, "replay_capacity": 30},
    "learned temperature": {"learn_temperature": True, "penalty_inside_gamma": False},
}


def written(path, run):
    members, swept = members_of(**RUNS[run])
    content = run_config.new_content(members, swept, ["run", "--x"], "paper", OUTPUT)
    run_config.write(path, content)
    return members, swept, content


@pytest.mark.parametrize("run", RUNS)
def test_a_run_is_read_back_as_it_was_described(tmp_path, run):
    members, swept, content = written(tmp_path, run)
    assert run_config.read(tmp_path) == run_config.RunConfig(members, swept, json.loads(json.dumps(content)))
    assert [item.name for item in tmp_path.iterdir()] == ["config.json"]


def test_seeds_vary_fastest():
    members, swept = members_of(seeds=(3, 1), sweep={"lr": (0.1, 0.2)})
    assert [(member.seed, member.config.agent.lr) for member in members] == [(3, 0.1), (1, 0.1), (3, 0.2), (1, 0.2)]
    assert swept == ["lr"]


def test_settings_of_a_run_have_the_swept_values_as_tuples():
    members, swept = members_of(seeds=(3, 1), sweep={"lr": (0.1, 0.2), "tau": (0.5, 0.25)})
    settings = run_config.all_settings(members, swept)
    assert (settings["seeds"], settings["lr"], settings["tau"]) == ((3, 1), (0.1, 0.2), (0.5, 0.25))
    assert settings.keys() == members[0].config.flat().keys() | {"seeds", "paired"}
    assert not settings["paired"]
    assert (settings["steps"], settings["hidden"], settings["gamma"]) == (60, (8, 4), 0.99)


@pytest.mark.parametrize(
    ("pairs", "lists"),
    [
        ([(1, 2), (1, 3), (4, 2), (4, 3)], {"lr": (1, 4), "tau": (2, 3), "paired": False}),
        ([(1, 2), (4, 3)], {"lr": (1, 4), "tau": (2, 3), "paired": True}),
        ([(1, 2), (1, 2), (4, 3), (1, 3)], {"lr": (1, 4, 1), "tau": (2, 3, 3), "paired": True}),
        ([(1, 3), (1, 2), (4, 2), (4, 3)], {"lr": (1, 1, 4, 4), "tau": (3, 2, 2, 3), "paired": True}),
    ],
    ids=["a product", "pairs", "a repetition", "all pairs in another order"],
)
def test_lists_that_are_no_product_have_a_value_per_configuration(pairs, lists):
    assert run_config.swept_lists(["lr", "tau"], pairs) == lists


def test_every_process_that_resumed_a_run_is_recorded(tmp_path):
    members, swept, content = written(tmp_path, "plain")
    output = content["output"] | {"keep_checkpoints": 5}
    again = run_config.resumed_content(content, 100, content["output"], 40, ["run", "--resume=x"])
    again = run_config.resumed_content(again, 100, output, 60, ["run", "--resume=y"])
    assert again["settings"] == content["settings"] | {"steps": 100} and content["resumed"] == []
    assert [(entry["env_steps"], entry["command"][1]) for entry in again["resumed"]] == [
        (40, "--resume=x"),
        (60, "--resume=y"),
    ]
    assert all(entry["versions"] == run_config.versions() and entry["at"] for entry in again["resumed"])
    assert again["output"] == output
    for unchanged in content.keys() - {"settings", "resumed", "output"}:
        assert again[unchanged] == content[unchanged]
    run_config.write(tmp_path, again)
    read = run_config.read(tmp_path)
    assert {member.config.train.steps for member in read.members} == {100} and read.content["replay_rows"] == 60


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"swept": ["steps"]}, "does not describe a run"),
        ({"swept": ["penalty_coef", "penalty_coef"]}, "does not describe a run"),
        ({"swept": 5}, "does not describe a run"),
        ({"members": []}, "does not describe a run"),
        ({"members": [{"seed": 1}] * 10_001}, "does not describe a run"),
        ({"members": [{"seed": -1, "penalty_coef": 0, "lr": 0.1}]}, "does not describe a run"),
        ({"members": [{"seed": 1.0, "penalty_coef": 0, "lr": 0.1}]}, "does not describe a run"),
        ({"members": [{"seed": 1, "penalty_coef": 0, "lr": 7}]}, "an invalid setting: --lr: expects a number"),
        ({"members": [{"seed": 1, "penalty_coef": 0, "lr": "x" * 5000}]}, "an invalid setting: --lr: expects"),
        ({"settings": {}}, "does not describe a run"),
        ({"replay_rows": 61}, "an invalid replay capacity"),
        ({"replay_rows": 7}, "an invalid replay capacity"),
        ({"replay_rows": "60"}, "does not describe a run"),
        ({"output": None}, "does not describe a run"),
        ({"versions": []}, "does not describe a run"),
        ({"resumed": {}}, "does not describe a run"),
        ({"preset": 5}, "does not describe a run"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_an_invalid_config_json_is_rejected(tmp_path, change, message):
    _, _, content = written(tmp_path, "swept")
    run_config.write(tmp_path, content | change)
    with pytest.raises(run_config.InvalidRunConfig, match=message) as error:
        run_config.read(tmp_path)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    ("settings", "own_env"),
    [
        ({}, {"observation_size": 3, "action_size": 2}),  # of a named task
        ({"physics": "own"}, []),
        ({"physics": "own"}, {"observation_size": 3}),
        ({"physics": "own"}, {"observation_size": 3.0, "action_size": 2}),
        ({"physics": "own"}, {"observation_size": 3, "action_size": 0}),
        ({"physics": "own", "env": "\x1b[0m"}, {"observation_size": 3, "action_size": 2}),
        ({"physics": "own", "env": "\x1b[0m"}, {}),
    ],
)
def test_a_damaged_environment_of_ones_own_is_rejected(tmp_path, settings, own_env):
    _, _, content = written(tmp_path, "plain")
    content |= {"settings": content["settings"] | {"eval_physics": "auto"} | settings, "evaluated_on": None}
    run_config.write(tmp_path, content | {"own_env": own_env})
    with pytest.raises(run_config.InvalidRunConfig, match="does not describe a run"):
        run_config.read(tmp_path)


def test_nan_and_infinity_are_not_written(tmp_path):
    _, _, content = written(tmp_path, "plain")
    with pytest.raises(ValueError):
        run_config.write(tmp_path, content | {"lr": float("nan")})
    assert run_config.read(tmp_path).content["preset"] == "paper"
