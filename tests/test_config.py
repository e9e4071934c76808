"""Defaults, limits and their messages, and a configuration written to a file and read back."""

import json
import pickle

import probe_envs
import pytest
from algorithm_rows import has_effect

from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.config import FEATURES, SETTINGS, AgentConfig, TrainConfig
from sqt_jax.experiment import make_config
from sqt_jax.settings import ConfigError
from sqt_jax.types import Scalars


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_defaults_are_the_papers_protocol(algo):
    config = make_config(algo, "ant")
    train, agent = config.train, config.agent
    assert (config.algo, config.env, config.physics) == (algo, "ant", "mjx")
    assert (train.steps, train.warmup_steps, train.eval_every, train.eval_episodes) == (1_000_000, 25_000, 5_000, 10)
    assert (train.batch_size, train.replay_capacity, train.num_envs) == (256, 1_000_000, 1)
    assert (agent.lr, agent.gamma, agent.hidden) == (3e-4, 0.99, (256, 256))
    assert (agent.ddof, agent.penalty_inside_gamma, agent.actor_reduce) == (1, True, "mean")
    assert agent.tau == 0.005
    baseline = ALGORITHMS[algo].baseline or algo
    ensemble = {"maxmin": (4, "min", 1), "redq": (10, "subset_min", 5)}.get(baseline, (2, "min", 1))
    assert (agent.ensemble_size, agent.reduce, train.updates_per_step) == ensemble


@pytest.mark.parametrize(("algo", "policy_delay"), [("td3", 2), ("sac", 1), ("td7", 2), ("maxmin", 2), ("redq", 5)])
def test_defaults_of_the_noises_the_temperature_and_the_delay(algo, policy_delay):
    agent = make_config(algo, "ant").agent
    assert agent.policy_delay == policy_delay
    assert (agent.exploration_noise, agent.target_noise, agent.target_noise_clip) == (0.1, 0.2, 0.5)
    assert (agent.temperature, agent.learn_temperature) == (0.2, False)


def test_defaults_of_td7_are_its_papers():
    agent = make_config("td7", "ant").agent
    assert (agent.embedding_size, agent.target_update_period) == (256, 250)
    assert (agent.priority_exponent, agent.min_priority) == (0.4, 1.0)
    assert (agent.policy_checkpoint_switch, agent.assessment_episodes, agent.policy_checkpoint_reset_weight) == (
        750_000,
        20,
        0.9,
    )


def user(settings):
    """An algorithm on which these settings have an effect."""
    return next(a for a in ("sac_sqt", "td7_sqt", "redq_sqt", "sac") if all(has_effect(a, name) for name in settings))


REJECTED = [
    ("penalty_coef", {"penalty_coef": -0.1}),
    ("penalty_coef", {"penalty_coef": float("nan")}),
    ("penalty_coef", {"penalty_coef": float("inf")}),
    ("penalty_coef", {"penalty_coef": "0.5"}),
    ("penalty_coef", {"penalty_coef": True}),
    ("penalty", {"penalty": "std"}),
    ("reduce", {"reduce": "max"}),
    ("actor_reduce", {"actor_reduce": "second"}),
    ("ddof", {"ddof": -1}),
    ("ddof", {"ddof": 0.5}),
    ("ddof", {"ddof": 2}),
    ("ddof", {"ddof": 5, "ensemble_size": 5}),
    ("ensemble_size", {"ensemble_size": 0}),
    ("ensemble_size", {"ensemble_size": 2.0}),
    ("ensemble_size", {"ensemble_size": 1}),
    ("ensemble_size", {"ensemble_size": 1, "ddof": 0}),
    ("ensemble_size", {"ensemble_size": 1001}),
    ("subset_size", {"subset_size": 0}),
    ("subset_size", {"subset_size": 11}),
    ("networks", {"networks": "cnn"}),
    ("sampled_actor", {"sampled_actor": 1}),
    ("train_encoder", {"train_encoder": 0}),
    ("value_clipping", {"value_clipping": None}),
    ("hidden", {"hidden": ()}),
    ("hidden", {"hidden": (256, 0)}),
    ("hidden", {"hidden": (256, 70_000)}),
    ("hidden", {"hidden": (256.0,)}),
    ("lr", {"lr": -1e-4}),
    ("lr", {"lr": 3}),
    ("gamma", {"gamma": 1.01}),
    ("gamma", {"gamma": -0.1}),
    ("gamma", {"gamma": None}),
    ("tau", {"tau": 2.0}),
    ("policy_delay", {"policy_delay": 0}),
    ("exploration_noise", {"exploration_noise": -0.1}),
    ("target_noise", {"target_noise": -0.2}),
    ("target_noise_clip", {"target_noise_clip": -0.5}),
    ("temperature", {"temperature": -0.2}),
    ("temperature", {"temperature": 0.0, "learn_temperature": True}),
    ("embedding_size", {"embedding_size": 0}),
    ("embedding_size", {"embedding_size": 256.0}),
    ("target_update_period", {"target_update_period": 0}),
    ("priority_exponent", {"priority_exponent": -0.4}),
    ("min_priority", {"min_priority": -1.0}),
    ("min_priority", {"min_priority": 0.0}),
    ("policy_checkpoint_switch", {"policy_checkpoint_switch": -1}),
    ("policy_checkpoint_switch", {"policy_checkpoint_switch": 7.5e5}),
    ("assessment_episodes", {"assessment_episodes": 0}),
    ("policy_checkpoint_reset_weight", {"policy_checkpoint_reset_weight": 1.1}),
    ("steps", {"steps": 0}),
    ("steps", {"steps": 2**31}),
    ("physics", {"physics": "bullet"}),
    ("penalty_inside_gamma", {"penalty_inside_gamma": "no"}),
    ("temperature", {"learn_temperature": "no"}),
    ("hidden", {"hidden": 256}),
    ("hidden", {"hidden": (True,)}),
    ("warmup_steps", {"warmup_steps": -1}),
    ("warmup_steps", {"warmup_steps": 1_000_000}),
    ("warmup_steps", {"steps": 25_000}),
    ("batch_size", {"batch_size": 0}),
    ("batch_size", {"replay_capacity": 255}),
    ("batch_size", {"steps": 100, "warmup_steps": 10, "eval_every": 10}),
    ("replay_capacity", {"replay_capacity": 0}),
    ("num_envs", {"num_envs": 0}),
    ("steps", {"num_envs": 3, "warmup_steps": 0, "eval_every": 3}),
    ("warmup_steps", {"num_envs": 4, "warmup_steps": 1001}),
    ("eval_every", {"num_envs": 4, "eval_every": 1002}),
    ("updates_per_step", {"updates_per_step": 0}),
    ("eval_every", {"eval_every": 0}),
    ("eval_episodes", {"eval_episodes": 0}),
]


@pytest.mark.parametrize(("setting", "settings"), REJECTED, ids=str)
def test_invalid_settings_are_rejected_by_name(setting, settings):
    with pytest.raises(ConfigError) as error:
        make_config(user(settings), "ant", **settings)
    assert error.value.setting == setting
    message = str(error.value)
    assert message.startswith((f"--{setting}: expects ", f"--{setting}: expected ")) and "\n" not in message


def invalid_values(about):
    """Values that a setting must reject, from its declaration: a new setting is tested without a line here."""
    if about.choices:
        return ["none of these", 1]
    if about.type is bool:
        return ["no", 1, None]
    if about.type in (int, float):
        outside = [about.low - 1, about.high + 1, float("nan")] if about.type is float else [about.low - 1, 2**31]
        return [*(value for value in outside if abs(value) != float("inf")), "1", True, None]
    return [256, (), (0,), "256"] if about.type is not str else []


@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_rejects_what_its_declaration_excludes(name):
    about = SETTINGS[name]
    for value in invalid_values(about):
        with pytest.raises(ConfigError) as error:
            about.check(value)
        assert error.value.setting == (about.flag or name) and about.expects() in str(error.value)


def test_every_setting_has_help_and_says_what_it_expects():
    for name, about in SETTINGS.items():
        assert about.help and about.expects(), name
        assert set(about.features) <= set(FEATURES), name
        if about.default is not None:
            about.check(about.default)


@pytest.mark.parametrize(
    "settings",
    [
        {"penalty_coef": 0},  # an int where a number is expected
        {"gamma": 1.0, "tau": 1.0, "temperature": 0.0, "warmup_steps": 0},
        {"ddof": 0},
        {"ensemble_size": 10, "reduce": "subset_min", "updates_per_step": 5},
        {"num_envs": 8, "replay_capacity": 1_001},
        {
            "policy_checkpoint_switch": 0,
            "assessment_episodes": 1,
            "priority_exponent": 0.0,
            "policy_checkpoint_reset_weight": 1.0,
        },
        {"steps": 256, "warmup_steps": 255, "eval_every": 1000},
    ],
    ids=str,
)
def test_the_edges_of_the_limits_are_accepted(settings):
    flat = make_config(user(settings), "ant", **settings).flat()
    assert {name: flat[name] for name in settings} == settings


def test_a_baseline_accepts_no_penalty():
    with pytest.raises(ConfigError, match="--penalty_coef: has no effect with td3$"):
        make_config("td3", "ant", penalty_coef=0.5)
    assert make_config("td3", "ant", penalty_coef=0).agent.penalty_coef == 0


def test_a_baselines_ddof_is_that_of_the_disagreement_it_reports():
    with pytest.raises(ConfigError, match="--ddof: expects a number below the ensemble_size .2."):
        make_config("td3", "ant", ddof=2)


def test_a_baseline_may_have_one_critic():
    assert make_config("td3", "ant", ensemble_size=1).agent.ensemble_size == 1


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("td3", {"temperature": 0.1}),
        ("td3_sqt", {"priority_exponent": 0.5}),
        ("sac", {"exploration_noise": 0.2}),
        ("maxmin", {"policy_checkpoint_switch": 5}),
        ("sac", {"penalty_inside_gamma": False}),
        ("td7", {"tau": 0.01}),
        ("td7_sqt", {"temperature": 0.1}),
    ],
)
def test_a_setting_without_effect_is_rejected_and_its_default_accepted(algo, settings):
    (name,) = settings
    with pytest.raises(ConfigError, match=f"--{name}: has no effect with {algo}$"):
        make_config(algo, "ant", **settings)
    assert make_config(algo, "ant", **{name: getattr(AgentConfig, name)}) == make_config(algo, "ant")


@pytest.mark.parametrize(
    ("networks", "settings"),
    [
        ("mlp", {"target_update_period": 100}),
        ("mlp", {"min_priority": 2.0}),
        ("mlp", {"train_encoder": False}),
        ("mlp", {"squashed_log_prob": False}),
        ("sale", {"tau": 0.01}),
    ],
)
def test_a_setting_without_effect_on_these_networks_is_rejected(networks, settings):
    (name,) = settings
    with pytest.raises(ConfigError, match=f"--{name}: has no effect with --networks={networks}$"):
        make_config("sac_sqt", "ant", networks=networks, **settings)


def test_a_switch_of_the_released_code_expects_true_or_false():
    with pytest.raises(ConfigError, match="--squashed_log_prob: expects true or false, not 'no'$"):
        make_config("sac", "ant", networks="sale", squashed_log_prob="no")


def test_redqs_actor_is_updated_once_per_environment_step():
    """Unless its delay is given: https://arxiv.org/abs/2101.05982, algorithm 1."""
    assert make_config("redq_sqt", "ant", updates_per_step=20).agent.policy_delay == 20
    assert make_config("redq", "ant", updates_per_step=20, policy_delay=1).agent.policy_delay == 1
    assert make_config("sac", "ant", updates_per_step=20).agent.policy_delay == 1


def test_a_custom_environment_is_recorded_under_its_name():
    env = probe_envs.one_step()
    config = make_config("td3", env)
    assert (config.env, config.physics, config.eval_physics) == (env.name, "own", "own")
    assert make_config(**config.flat()) == config  # read back without the environment
    with pytest.raises(ConfigError, match="--physics: has no effect with an environment of your own$"):
        make_config("td3", env, physics="mjx")
    with pytest.raises(ConfigError, match="--env: expects one of cheetah"):
        make_config("td3", env.name)


def test_the_temperature_is_fixed_with_sale_networks():
    with pytest.raises(ConfigError, match="--temperature: expects a number with --networks=sale, not auto$"):
        make_config("sac", "ant", networks="sale", learn_temperature=True)


def test_a_learned_temperature_is_rejected_by_the_flags_name():
    with pytest.raises(ConfigError, match="--temperature: has no effect with td3"):
        make_config("td3", "ant", learn_temperature=True)


@pytest.mark.parametrize(
    ("settings", "setting", "hint"),
    [
        ({"penalty_coeff": 0.5}, "penalty_coeff", "did you mean penalty_coef?"),
        ({"warmup": 0}, "warmup", "did you mean warmup_steps?"),
        ({"Gamma": 0.9}, "Gamma", "did you mean gamma?"),
        ({"zzz": 1}, "zzz", "is not a setting"),
        ({"algo": "sac_sqtt"}, "algo", "did you mean sac_sqt?"),
        ({"algo": "ppo"}, "algo", "expects one of td3, td3_sqt, "),
        ({"env": "humanoidd"}, "env", "did you mean humanoid?"),
    ],
    ids=str,
)
def test_unknown_names_get_a_suggestion(settings, setting, hint):
    with pytest.raises(ConfigError) as error:
        make_config(**({"algo": "sac_sqt", "env": "ant"} | settings))
    assert error.value.setting == setting
    assert hint in str(error.value)


@pytest.mark.parametrize(
    ("alias", "name"),
    [("half_cheetah", "cheetah"), ("halfcheetah", "cheetah"), ("walker2d", "walker"), ("humanoid", "humanoid")],
)
def test_aliases_are_resolved(alias, name):
    assert make_config("td3", alias) == make_config("td3", name)
    assert make_config("td3", alias).env == name


CONFIGS = [
    make_config("td3", "walker2d"),
    make_config("sac_sqt_tuple", "humanoid", penalty_coef=0.3, hidden=(64,), num_envs=4, ensemble_size=5, ddof=0),
    make_config("sac", "cheetah", learn_temperature=True, reduce="subset_min", steps=50_000),
    make_config("redq_sqt", "ant", updates_per_step=3),
    make_config("td7_sqt_tuple", "cheetah", target_update_period=100, policy_checkpoint_switch=5_000),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.algo)
def test_flat_settings_make_the_same_configuration(config):
    assert make_config(**config.flat()) == config


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.algo)
def test_flat_settings_survive_json(config):
    assert make_config(**json.loads(json.dumps(config.flat()))) == config


def test_no_setting_has_two_owners():
    config = CONFIGS[0]
    assert len(config.flat()) == 6 + len(AgentConfig.__dataclass_fields__) + len(TrainConfig.__dataclass_fields__)


@pytest.mark.parametrize(
    ("settings", "capacity"),
    [
        ({}, 1_000_000),
        ({"steps": 30_000}, 30_000),
        ({"replay_capacity": 2_000}, 2_000),
        ({"replay_capacity": 2_001, "num_envs": 8}, 2_000),
    ],
    ids=str,
)
def test_the_replay_is_no_larger_than_the_run_and_a_multiple_of_an_insert(settings, capacity):
    assert make_config("td3", "ant", **settings).train.capacity == capacity


def test_a_file_with_a_settings_former_name_is_read():
    config = make_config("td7", "ant", checkpoint_switch=5, checkpoint_reset_weight=0.5)
    assert config == make_config("td7", "ant", policy_checkpoint_switch=5, policy_checkpoint_reset_weight=0.5)


def test_scalars_are_the_settings_of_their_names():
    agent = make_config("sac_sqt", "ant", penalty_coef=0.25, lr=1e-3, gamma=0.9, tau=0.1, temperature=0.3).agent
    expected = Scalars(penalty_coef=0.25, lr=1e-3, gamma=0.9, tau=0.1, temperature=0.3)
    assert agent.scalars() == expected
    arrays = agent.scalars().as_arrays()
    assert all(value.shape == () and value.dtype == "float32" for value in arrays)
    assert [round(float(value), 6) for value in arrays] == list(expected)


def test_an_error_reaches_another_process_complete():
    error = pickle.loads(pickle.dumps(ConfigError("steps", "expects a whole number")))
    assert (type(error), error.setting, str(error)) == (ConfigError, "steps", "--steps: expects a whole number")
