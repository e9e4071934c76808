"""`make_environment`: the example in its docstring, and its contract, a test per sentence."""

import doctest

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gym_reference import COUNT

from sqt_jax import envs
from sqt_jax.envs.autoreset import make_environment

LENGTH = 5


def test_the_docstrings_example_is_an_environment():
    parser, runner = doctest.DocTestParser(), doctest.DocTestRunner()
    names = {"jax": jax, "jnp": jnp, "make_environment": make_environment}
    example = parser.get_doctest(make_environment.__doc__, names, "make_environment", None, None)
    assert len(example.examples) == 3 and runner.run(example, clear_globs=False).failed == 0
    env = example.globs["env"]
    step = jax.jit(env.step)
    first = timestep = env.reset(jax.random.key(0))
    for number in range(1, 201):  # standing still, to the time limit
        timestep = step(timestep, jnp.zeros(1))
        assert timestep.reward == -abs(first.obs[0])
        assert not timestep.terminated and timestep.truncated == (number == 200)
    timestep, steps = first, 0
    while not timestep.terminated:  # as fast as possible away from 0, to the edge at 2
        timestep, steps = step(timestep, jnp.sign(first.obs)), steps + 1
    assert 10 <= steps <= 21 and abs(timestep.final_obs[0]) > 2.0 and abs(timestep.obs[0]) <= 1.0


def counter(episode_length=LENGTH):
    """obs = (random start, steps made, last action); the reward is the number of steps made.

    The second entry of an action above 0.5 terminates; a third entry makes numbers that are not finite: below -0.5 the
    observation, above 0.5 the reward.
    """

    def observe(state, action):
        return jnp.stack([state[0], state[1], action])

    def start(key):
        state = (jax.random.uniform(key), jnp.zeros(()))
        return state, observe(state, jnp.zeros(()))

    def advance(state, action):
        state = (state[0], state[1] + 1)
        obs = jnp.where(action[2] < -0.5, jnp.nan, observe(state, action[0]))
        reward = jnp.where(action[2] > 0.5, jnp.inf, state[1])
        return state, obs, reward, action[1] > 0.5

    return make_environment("counter", 3, 3, episode_length, start, advance)


ENV = counter()
GO, END = jnp.array([0.5, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.0])


def play(actions, key=0, env=ENV):
    """The time steps of a run: the reset's, then one for each action."""
    timesteps = [env.reset(jax.random.key(key))]
    for action in actions:
        timesteps.append(env.step(timesteps[-1], jnp.asarray(action)))
    return timesteps


def leaves(timestep):
    def is_key(x):
        return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)

    return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in jax.tree.leaves(timestep)]


def test_same_key_and_actions_give_the_same_episode():
    first, again = play([GO, END, GO]), play([GO, END, GO])
    for a, b in zip(leaves(first), leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_other_keys_give_other_starts():
    starts = {float(play([], key)[0].obs[0]) for key in range(20)}
    assert len(starts) == 20


def test_actions_are_clipped():
    assert play([[7.0, 0.0, 0.0]])[-1].obs[2] == 1
    assert play([[-7.0, 0.0, 0.0]])[-1].obs[2] == -1


def test_a_reset_does_not_end_an_episode():
    timestep = play([])[0]
    assert not timestep.terminated
    assert not timestep.truncated
    assert timestep.reward == 0
    np.testing.assert_array_equal(timestep.final_obs, timestep.obs)


def test_reward_and_flags_belong_to_the_step_that_ended_the_episode():
    timestep = play([GO, END])[-1]
    assert timestep.reward == 2
    assert timestep.terminated
    assert not timestep.truncated


def test_truncated_at_episode_length_and_at_no_other_step():
    timesteps = play([GO] * (3 * LENGTH))
    assert [i for i, t in enumerate(timesteps) if t.truncated] == [LENGTH, 2 * LENGTH, 3 * LENGTH]
    assert not any(t.terminated for t in timesteps)


def test_the_time_limit_counts_from_the_start_of_the_episode():
    timesteps = play([GO, END] + [GO] * LENGTH)
    assert [i for i, t in enumerate(timesteps) if t.truncated] == [2 + LENGTH]


def test_terminated_at_the_last_step_is_also_truncated():
    timestep = play([GO] * (LENGTH - 1) + [END])[-1]
    assert timestep.terminated
    assert timestep.truncated


@pytest.mark.parametrize("actions", [[GO, END], [GO] * LENGTH], ids=["terminated", "truncated"])
def test_after_an_end_obs_and_state_are_a_new_episodes_and_final_obs_the_old_ones(actions):
    timesteps = play(actions)
    start, end = timesteps[0], timesteps[-1]
    np.testing.assert_array_equal(end.final_obs, [start.obs[0], len(actions), 0.5])
    assert end.obs[0] != start.obs[0]
    np.testing.assert_array_equal(end.obs[1:], [0, 0])
    assert end.state.steps == 0
    np.testing.assert_array_equal(end.state.task[0], end.obs[0])


def test_every_episode_has_a_new_start():
    starts = {float(t.obs[0]) for t in play([END] * 20)}
    assert len(starts) == 21


def test_elsewhere_final_obs_equals_obs():
    for timestep in play([GO] * (LENGTH - 1)):
        np.testing.assert_array_equal(timestep.final_obs, timestep.obs)


@pytest.mark.parametrize("third", [-1.0, 1.0], ids=["observation", "reward"])
def test_a_step_that_is_not_finite_terminates_with_reward_0_and_the_observation_before(third):
    before, after = play([GO, [0.1, 0.0, third]])[-2:]
    assert after.terminated
    assert after.reward == 0
    np.testing.assert_array_equal(after.final_obs, before.obs)
    assert after.state.steps == 0
    assert all(np.isfinite(x).all() for x in leaves(after))
    assert ENV.step(after, GO).reward == 1  # the next episode is unaffected


def test_steps_beyond_all_numbers_are_counted_over_all_episodes():
    bad = jnp.array([0.5, 0.0, 1.0])
    timesteps = play([GO, bad, GO, END, GO, bad, bad, GO])
    counts = [int(ENV.status(timestep)["unstable_steps"]) for timestep in timesteps]
    assert counts == [0, 0, 1, 1, 1, 1, 2, 3, 3]


def test_numbers_beyond_mujocos_own_limit_are_diverged():
    def advance(state, action):
        return state, jnp.full(1, 1e9) * action, jnp.zeros(()), jnp.zeros((), bool)

    env = make_environment("large", 1, 1, LENGTH, lambda key: (jnp.zeros(()), jnp.zeros(1)), advance)
    fine, beyond = env.step(env.reset(jax.random.key(0)), jnp.ones(1)), None
    assert not fine.terminated and fine.final_obs == 1e9
    env = make_environment(
        "larger", 1, 1, LENGTH, lambda key: (jnp.zeros(()), jnp.zeros(1)), lambda s, a: (s, 2e10 * a, 0.0, False)
    )
    beyond = env.step(env.reset(jax.random.key(0)), jnp.ones(1))
    assert beyond.terminated and beyond.final_obs == 0


def unreliable(fault=jnp.nan):
    """Starts x in [0, 1): above 0.5 the state is `fault`. obs = (x, state); an action above 0.5 ends the episode."""

    def start(key):
        x = jax.random.uniform(key)
        state = jnp.where(x > 0.5, fault, x)
        return state, jnp.stack([x, state])

    def advance(state, action):
        return state, jnp.stack([state, state]), jnp.ones(()), action[0] > 0.5

    def place(qpos, qvel):
        return qpos[0], jnp.concatenate([qpos, qvel])

    env = make_environment("unreliable", 2, 1, LENGTH, start, advance, place)
    return env._replace(step=jax.jit(env.step))


def starts_of(seed, count):
    """The first `count` starts x of `unreliable` from the key of this seed."""
    key, found = jax.random.key(seed), []
    for _ in range(count):
        start_key, key = jax.random.split(key)
        found.append(float(jax.random.uniform(start_key)))
    return found


STOP, RUN = jnp.ones(1), jnp.zeros(1)
GOOD_BAD_BAD_GOOD_BAD, BAD_BAD_GOOD_BAD = 99, 0  # seeds of such starts


@pytest.mark.parametrize("fault", [np.nan, np.inf, -2e10])
def test_a_start_that_is_not_finite_is_replaced_by_the_last_one_that_was(fault):
    a, *bad, b, also_bad = starts_of(GOOD_BAD_BAD_GOOD_BAD, 5)
    assert max(a, b) <= 0.5 < min(*bad, also_bad)
    timesteps = play([STOP] * 4, GOOD_BAD_BAD_GOOD_BAD, unreliable(fault))
    for timestep, x in zip(timesteps, [a, a, a, b, b], strict=True):
        assert timestep.obs.tolist() == [x, x] and timestep.state.task == x  # of one start


def test_before_a_finite_start_the_numbers_that_are_not_finite_become_0():
    env, starts = unreliable(), starts_of(BAD_BAD_GOOD_BAD, 4)
    assert [x > 0.5 for x in starts] == [True, True, False, True]
    first, *after = play([RUN] * 2 + [STOP], BAD_BAD_GOOD_BAD, env)
    assert first.obs.tolist() == first.final_obs.tolist() == [starts[0], 0]
    # The state is broken: the step ends the episode, and the second start is the first one again.
    assert after[0].terminated and after[0].reward == 0 and after[0].obs.tolist() == [starts[0], 0]
    assert after[1].terminated and after[1].obs.tolist() == [starts[2]] * 2
    assert after[2].terminated and after[2].reward == 1 and after[2].obs.tolist() == [starts[2]] * 2
    for timestep in (first, *after):
        assert all(np.isfinite(x).all() for x in (timestep.obs, timestep.reward, timestep.final_obs))


def test_a_placed_state_that_is_not_finite_is_observed_as_0():
    placed = unreliable().set_physics(jnp.array([0.25]), jnp.array([jnp.nan]))
    assert placed.obs.tolist() == [0.25, 0] and placed.state.unstable_starts == 1


def test_starts_that_are_not_finite_are_counted_over_all_episodes():
    env = unreliable()
    counts = [
        [int(env.status(timestep)[name]) for timestep in play([STOP] * 3 + [RUN], seed, env)]
        for name in ("unstable_starts", "unstable_steps")
        for seed in (GOOD_BAD_BAD_GOOD_BAD, BAD_BAD_GOOD_BAD)
    ]
    assert counts == [[0, 1, 2, 2, 2], [1, 2, 2, 3, 3], [0, 0, 0, 0, 0], [0, 1, 2, 2, 2]]


def test_under_vmap_only_the_environment_with_a_bad_start_repeats_its_last_one():
    seeds, env = jnp.array([GOOD_BAD_BAD_GOOD_BAD, BAD_BAD_GOOD_BAD]), unreliable()
    together = jax.vmap(env.reset)(jax.vmap(jax.random.key)(seeds))
    alone = [play([STOP] * 4, int(seed), env) for seed in seeds]
    for step in range(1, 5):
        together = jax.vmap(env.step)(together, jnp.ones((2, 1)))
        for index in range(2):
            for a, b in zip(leaves(together), leaves(alone[index][step]), strict=True):
                np.testing.assert_array_equal(a[index], b)


def test_under_vmap_only_the_environment_that_ended_restarts():
    timesteps = jax.vmap(ENV.reset)(jax.random.split(jax.random.key(0), 3))
    after = jax.vmap(ENV.step)(timesteps, jnp.stack([GO, END, GO]))
    np.testing.assert_array_equal(after.terminated, [False, True, False])
    np.testing.assert_array_equal(after.state.steps, [1, 0, 1])
    np.testing.assert_array_equal(after.obs[:, 0] == timesteps.obs[:, 0], [True, False, True])


def test_one_compilation_for_all_steps_and_episodes():
    step = jax.jit(ENV.step)
    timestep = jax.jit(ENV.reset)(jax.random.key(0))
    for action in [GO, END, GO, GO]:
        timestep = step(timestep, action)
    assert step._cache_size() == 1


def test_jit_changes_nothing():
    for eager, compiled in zip(play([GO, END]), play([GO, END], env=ENV._replace(step=jax.jit(ENV.step))), strict=True):
        for a, b in zip(leaves(eager), leaves(compiled), strict=True):
            np.testing.assert_array_equal(a, b)


def test_optional_functions_are_none_if_they_are_not_given():
    assert ENV.set_physics is None and ENV.speed is None


def test_speed_is_that_of_the_step_just_made():
    """Positions 0, 1, 3, 6, 0, ...: the state is (position, last displacement), a step is 0.5 s; the fourth ends."""

    def advance(state, action):
        step = state[1] + 1
        return jnp.stack([state[0] + step, step]), state[:1], 0.0, False

    def start(key):
        return jnp.zeros(2), jnp.zeros(1)

    env = make_environment("faster", 1, 1, 4, start, advance, speed=lambda state: state[1] / 0.5)
    timestep, speeds = env.reset(jax.random.key(0)), []
    for _ in range(5):
        timestep = env.step(timestep, jnp.zeros(1))
        speeds.append(float(env.speed(timestep)))
    assert speeds == [2.0, 4.0, 6.0, 0.0, 2.0]


# The same contract on a real task.


def test_the_cheetahs_time_limit_is_1000_steps_and_its_starts_are_new():
    env = envs.make("cheetah", "mujoco")
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    start = reset(jax.random.split(jax.random.key(0), COUNT))
    assert len(np.unique(start.obs, axis=0)) == COUNT
    late = start._replace(state=start.state._replace(steps=jnp.full(COUNT, 998, jnp.int32)))
    action = jnp.zeros((COUNT, 6))
    penultimate = step(late, action)
    assert not penultimate.truncated.any()
    last = step(penultimate, action)
    assert last.truncated.all()
    assert not last.terminated.any()
    assert len(np.unique(np.concatenate([start.obs, last.obs]), axis=0)) == 2 * COUNT
    # the same step earlier in the episode continues from the observation that was the last one here
    earlier = penultimate._replace(state=penultimate.state._replace(steps=jnp.full(COUNT, 9, jnp.int32)))
    continued = step(earlier, action)
    np.testing.assert_array_equal(last.final_obs, continued.obs)
    np.testing.assert_array_equal(last.reward, continued.reward)
    assert (np.abs(last.obs[:, :8]) <= 0.1 + 1e-6).all()
    assert step._cache_size() == 1
