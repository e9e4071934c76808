"""Evaluation: each episode to its own end, from fresh starts, under the given policy."""

import functools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from host_tasks import Counter
from probe_envs import constant_reward, countdown, one_step

from sqt_jax import envs, rollout
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.envs.gym_ids import from_gymnasium
from sqt_jax.evaluate import evaluate, evaluate_policy, evaluate_with_bias

KEY = jax.random.key(0)


def zeros(obs):
    return jnp.zeros((obs.shape[0], 1))


def run(env, policy=zeros, episodes=4, key=KEY):
    return jax.jit(lambda key: evaluate(env, policy, key, episodes))(key)


def random_lengths():
    """Episodes of 1 to 6 steps, drawn at the start; reward and speed are the number of the step, 1, 2, ..."""

    def start(key):
        length = jax.random.randint(key, (), 1, 7)
        return (jnp.zeros((), jnp.int32), length), length[None].astype(jnp.float32)

    def advance(state, action):
        step, length = state[0] + 1, state[1]
        return (step, length), length[None].astype(jnp.float32), step.astype(jnp.float32), step >= length

    def speed(state):
        return state[0].astype(jnp.float32)

    return make_environment("random_lengths", 1, 1, 100, start, advance, speed=speed)


def test_terminated_episodes():
    result = run(countdown(3))
    np.testing.assert_array_equal(result.returns, [3, 3, 3, 3])
    np.testing.assert_array_equal(result.lengths, [3, 3, 3, 3])


def test_truncated_episodes():
    result = run(constant_reward(5))
    np.testing.assert_array_equal(result.returns, [5, 5, 5, 5])
    np.testing.assert_array_equal(result.lengths, [5, 5, 5, 5])


def test_each_episode_counts_up_to_its_own_end():
    env = random_lengths()
    lengths = np.asarray(rollout.reset(env, KEY, 16).obs)[:, 0]
    assert len(set(lengths)) > 3
    result = run(env, episodes=16)
    np.testing.assert_array_equal(result.lengths, lengths)
    np.testing.assert_array_equal(result.returns, lengths * (lengths + 1) / 2)


def assert_speeds_by_hand(evaluation):
    """An episode of n steps has the mean of 1, ..., n - 1, which is n / 2; of one step, none: the last is left out."""
    lengths = np.asarray(evaluation.lengths)
    assert (lengths == 1).any() and (lengths == 6).any()
    np.testing.assert_allclose(evaluation.speeds, np.where(lengths > 1, lengths / 2, np.nan), rtol=1e-6)


def test_the_speed_of_an_episode_is_the_mean_over_its_steps_without_the_last():
    assert_speeds_by_hand(run(random_lengths(), episodes=16))


def test_speeds_are_measured_next_to_the_bias():
    def evaluation(key):
        policy, critics = lambda obs, key: (zeros(obs), jnp.zeros(len(obs))), lambda obs, action: obs.T
        return evaluate_with_bias(random_lengths(), policy, critics, jnp.float32(0.9), key, 16, num_bias_episodes=2)[0]

    found, plain = jax.jit(evaluation)(KEY), run(random_lengths(), episodes=16)
    assert_speeds_by_hand(found)
    for name, a, b in zip(found._fields, found, plain, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_speeds_are_nan_if_the_environment_has_no_speed():
    result = run(constant_reward(5))
    assert result.speeds.shape == (4,) and np.isnan(result.speeds).all()


def test_the_policy_decides():
    env = one_step()
    starts = np.asarray(rollout.reset(env, KEY, 8).obs)[:, 0]
    assert len(np.unique(starts)) == 8
    best = run(env, policy=lambda obs: obs, episodes=8)
    np.testing.assert_allclose(best.returns, starts, rtol=1e-6)
    np.testing.assert_allclose(run(env, episodes=8).returns, starts - starts**2, rtol=1e-5)


def test_a_key_repeats_an_evaluation_and_another_gives_other_starts():
    env = one_step()
    evaluation = jax.jit(lambda key: evaluate(env, zeros, key, 4))
    first, again, other = (evaluation(jax.random.key(seed)).returns for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.any(first == other)


def test_members_evaluate_in_a_sweep_as_they_do_alone():
    keys = jax.random.split(KEY, 3)
    env = random_lengths()
    together = jax.jit(jax.vmap(lambda key: evaluate(env, zeros, key, 4)))(keys)
    alone = jax.jit(lambda key: evaluate(env, zeros, key, 4))
    for i in range(3):
        np.testing.assert_array_equal(together.lengths[i], alone(keys[i]).lengths)
        np.testing.assert_array_equal(together.returns[i], alone(keys[i]).returns)


def test_a_policy_has_the_same_return_in_gymnasiums_environment_and_in_ours():
    """A policy under which the hopper falls at once, from any start: lengths and returns hardly vary."""
    import gymnasium

    weights = 0.3 * jax.random.normal(jax.random.key(1), (11, 3))

    def policy(obs):
        return jnp.tanh(obs @ weights)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = evaluate_policy(policy, gymnasium.make("Hopper-v4"), num_episodes=10)
    ours = evaluate_policy(policy, envs.make("hopper", "mujoco"), num_episodes=10)
    assert min(theirs[1].min(), ours[1].min()) > 5
    for their, our in zip(theirs, ours, strict=True):
        assert their.shape == our.shape == (10,)
        error = np.hypot(their.std(), our.std()) / np.sqrt(10)  # of the difference of the means
        assert 0 < error < 0.2 * their.mean() and abs(their.mean() - our.mean()) < 4 * error


class Ladder:
    """With Gymnasium's interface: the reward is the action that the environment gets, 3 steps, actions from 0 to 10."""

    observation_space, action_space = spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(0, 10, (1,))

    def reset(self, seed):
        self.steps = 0
        return np.array([float(seed)]), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        return np.zeros(1), float(action.ravel()[0]), False, self.steps == 3, {}


def test_actions_are_scaled_to_gymnasiums_action_space():
    returns, lengths = evaluate_policy(lambda obs: 2 * obs[:, :1], Ladder(), num_episodes=2, seed=0)
    np.testing.assert_allclose(returns, [15, 20])  # obs 0, then 0 and 0: 5 each; obs 1: 10 and no more, then 5 and 5
    np.testing.assert_array_equal(lengths, [3, 3])


class Tower(Ladder):
    """The same with observations of two parts, and a matrix of integers as its action."""

    observation_space = spaces.Dict({"level": spaces.Discrete(3), "image": spaces.Box(0, 255, (2, 2), np.uint8)})
    action_space = spaces.Box(0, 10, (2, 1), np.int64)

    def observed(self):
        return {"image": np.full((2, 2), 100, np.uint8), "level": self.steps % 3}

    def reset(self, seed):
        super().reset(seed)
        return self.observed(), {}

    def step(self, action):
        _, *others = super().step(action)
        return self.observed(), *others


def test_observations_are_flattened_and_integer_actions_rounded():
    seen = []

    def policy(obs):
        seen.append(obs)
        return np.array([[0.29, -1.0]])  # 6.45

    returns, _ = evaluate_policy(policy, Tower(), num_episodes=1)
    assert returns.tolist() == [18]
    assert [obs.tolist() for obs in seen] == [[[100] * 4 + one_hot] for one_hot in ([1, 0, 0], [0, 1, 0], [0, 0, 1])]


@pytest.mark.parametrize("side", ["observation_space", "action_space"])
def test_spaces_that_no_policy_here_can_have_are_rejected(side):
    env = Ladder()
    setattr(env, side, spaces.Text(5))
    with pytest.raises(ValueError, match=rf"^{side.replace('_', ' ')}: expects .*Box.*, not Text\("):
        evaluate_policy(lambda obs: obs[:, :1], env)


@pytest.mark.parametrize("env", [Ladder(), countdown(3)], ids=["gymnasium", "jax"])
@pytest.mark.parametrize("shape", [(1, 2), (1,), ()])
def test_a_policy_with_actions_of_another_size_is_rejected(env, shape):
    message = re.escape(f"policy: expects actions [1, 1] for observations [1, 1], not {list(shape)}")
    with pytest.raises(ValueError, match=message):
        evaluate_policy(lambda obs: jnp.zeros(shape), env, num_episodes=1)


def test_a_policy_with_actions_that_are_nan_is_rejected():
    with pytest.raises(ValueError, match="^action: expects numbers in .*, not "):
        evaluate_policy(lambda obs: obs * np.nan, Ladder())


def test_an_exception_in_an_environment_on_the_host_is_raised():
    env = from_gymnasium("counter", functools.partial(Counter, fails_at=4), max_episode_steps=6)
    with pytest.raises(RuntimeError, match="counter: RuntimeError: the simulator is gone"):
        evaluate_policy(lambda obs: jnp.zeros((len(obs), 3)), env, num_episodes=2)


def test_episodes_on_the_host_are_those_of_gymnasium():
    env = from_gymnasium("counter", Counter, max_episode_steps=6)
    returns, lengths = evaluate_policy(lambda obs: jnp.zeros((len(obs), 3)), env, num_episodes=3)
    assert returns.tolist() == [21, 21, 21] and lengths.tolist() == [6, 6, 6]


def test_members_on_the_host_end_their_evaluations_at_different_steps():
    env = from_gymnasium("counter", Counter, max_episode_steps=6)

    def policy(obs):  # ends the episode at once where its start is above 0.5
        return jnp.stack([obs[:, 0], jnp.where(obs[:, 0] > 0.5, 1.0, 0.0), obs[:, 0]], axis=1) * jnp.array([0, 1, 0])

    keys = jax.random.split(jax.random.key(5), 8)
    found = jax.jit(jax.vmap(lambda key: evaluate(env, policy, key, 1)))(keys)
    assert env.host.error() is None
    assert set(zip(found.lengths[:, 0].tolist(), found.returns[:, 0].tolist(), strict=True)) == {(1, 1.0), (6, 21.0)}
