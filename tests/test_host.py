"""Environments on the host: their contract, a test per sentence, in this process and in others."""

import functools
import gc
import multiprocessing
import os
import signal
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_tasks import Counter

from sqt_jax.envs.host import host_environment
from sqt_jax.envs.host_episodes import PlayingThread

GO, END, CUT = [0.5, 0.0, 0.0], [0.5, 1.0, 0.0], [0.5, -1.0, 0.0]
BAD_OBS, BAD_REWARD = [0.1, 0.0, -1.0], [0.1, 0.0, 1.0]


def counter(processes=0, **arguments):
    env = host_environment("counter", functools.partial(Counter, **arguments), 5, processes)
    return env._replace(reset=jax.jit(env.reset), step=jax.jit(env.step))


@functools.cache
def plain():
    return counter()


def play(actions, key=0, env=None):
    """The time steps of a run: the reset's, then one for each action."""
    env = env or plain()
    timesteps = [env.reset(jax.random.key(key))]
    for action in actions:
        timesteps.append(env.step(timesteps[-1], jnp.array(action)))
    return timesteps


def observed(timestep):
    return np.asarray(timestep.obs).tolist()


def test_same_key_and_actions_give_the_same_episodes():
    first, again = play([GO, END, GO]), play([GO, END, GO])
    assert [observed(t) for t in first] == [observed(t) for t in again]


def test_other_keys_give_other_starts():
    assert len({observed(play([], key)[0])[0] for key in range(20)}) == 20


def test_actions_are_clipped_and_elements_of_the_space():
    assert [observed(play([[x, 0.0, 0.0]])[-1])[2] for x in (7.0, -7.0, 0.25)] == [1, -1, 0.25]


def test_a_reset_does_not_end_an_episode():
    timestep = play([])[0]
    assert not timestep.terminated and not timestep.truncated and timestep.reward == 0
    np.testing.assert_array_equal(timestep.final_obs, timestep.obs)


@pytest.mark.parametrize(("action", "terminated"), [(END, True), (CUT, False)])
def test_terminated_and_truncated_are_the_environments_own(action, terminated):
    timestep = play([GO, action])[-1]
    assert (bool(timestep.terminated), bool(timestep.truncated)) == (terminated, not terminated)
    assert timestep.reward == 2


@pytest.mark.parametrize("action", [END, CUT])
def test_after_an_end_obs_is_a_new_starts_and_final_obs_the_true_last_one(action):
    start, *_, last = play([GO, action])
    np.testing.assert_array_equal(last.final_obs, [start.obs[0], 2, 0.5])
    assert last.obs[0] != start.obs[0] and observed(last)[1:] == [0, 0]


def test_every_episode_has_a_new_start():
    assert len({observed(t)[0] for t in play([END] * 20)}) == 21


def test_elsewhere_final_obs_equals_obs():
    for timestep in play([GO] * 4):
        np.testing.assert_array_equal(timestep.final_obs, timestep.obs)


@pytest.mark.parametrize("action", [BAD_OBS, BAD_REWARD, [np.nan, 0.0, 0.0]], ids=["observation", "reward", "action"])
def test_a_step_that_is_not_finite_terminates_with_reward_0_and_the_observation_before(action):
    start, before, after, following = play([GO, action, GO])
    assert after.terminated and after.reward == 0 and after.obs[0] != start.obs[0]
    np.testing.assert_array_equal(after.final_obs, before.obs)
    assert following.reward == 1  # the next episode is unaffected


def test_steps_that_are_not_finite_are_counted_over_all_episodes():
    counts = [int(plain().status(t)["unstable_steps"]) for t in play([GO, BAD_OBS, GO, END, BAD_REWARD, BAD_OBS])]
    assert counts == [0, 0, 1, 1, 1, 2, 3]


def test_a_start_that_is_not_finite_is_replaced_by_the_last_one_that_was():
    all_starts = [observed(t)[0] for t in play([END] * 30)]
    expected, last = [], 0.0  # before a finite start its numbers become 0
    for start in all_starts:
        last = start if start <= 0.6 else last
        expected.append(last)
    env = counter(bad_above=0.6)
    timesteps = play([END] * 30, env=env)
    assert [observed(t)[0] for t in timesteps] == expected
    bad = [start > 0.6 for start in all_starts]
    assert [int(env.status(t)["unstable_starts"]) for t in timesteps] == np.cumsum(bad).tolist()
    assert 5 < sum(bad) < 25


def test_under_vmap_each_environment_has_its_own_episode():
    env = plain()
    keys = jax.random.split(jax.random.key(0), 6).reshape(2, 3)
    timesteps = jax.jit(jax.vmap(jax.vmap(env.reset)))(keys)
    after = jax.jit(jax.vmap(jax.vmap(env.step)))(timesteps, jnp.array([[GO, END, GO], [CUT, GO, GO]]))
    np.testing.assert_array_equal(after.terminated, [[False, True, False], [False] * 3])
    np.testing.assert_array_equal(after.truncated, [[False] * 3, [True, False, False]])
    same = after.obs[..., 0] == timesteps.obs[..., 0]
    np.testing.assert_array_equal(same, [[True, False, True], [False, True, True]])
    assert len(np.unique(timesteps.obs[..., 0])) == 6


def test_restart_begins_new_episodes_whose_starts_belong_to_the_key_and_the_steps():
    env, other = plain(), counter()
    played = play([GO, GO, END, GO])
    saved = jax.device_get(played[3]), jax.device_get(played[4])
    after_two_more = [jax.jit(env.host.restart)(saved[1]) for _ in range(2)]
    assert observed(after_two_more[0]) == observed(after_two_more[1]) != observed(played[0])
    # The episode that began with the saved step begins again, also in another process.
    assert observed(jax.jit(other.host.restart)(saved[0])) == observed(played[3])


def test_separate_environments_do_not_disturb_each_other():
    env = plain()
    apart = env.host.separate()
    first = env.reset(jax.random.key(0))
    apart.reset(jax.random.key(1))
    assert env.step(first, jnp.array(GO)).reward == 1 and env.host.error() is None


def test_a_step_that_does_not_follow_the_newest_one_is_an_error():
    env = counter()
    first = env.reset(jax.random.key(0))
    second = env.step(first, jnp.array(GO))
    assert observed(env.step(first, jnp.array(GO))) == observed(second)  # the same call again is not played again
    assert env.host.error() is None
    env.step(second, jnp.array(GO))
    assert bool(env.host.failed(env.step(second, jnp.array(END))))
    assert "an environment on the host cannot go back" in env.host.error().text


@pytest.mark.parametrize("processes", [0, 1])
def test_an_exception_fails_this_and_all_later_steps_until_the_next_reset(processes):
    env = counter(processes, fails_at=3)
    *fine, failed, later = play([GO] * 4, env=env)
    assert not any(bool(env.host.failed(t)) for t in fine) and [float(t.reward) for t in fine] == [0, 1, 2]
    for timestep in (failed, later):
        assert bool(env.host.failed(timestep)) and timestep.terminated and timestep.reward == 0
        assert observed(timestep) == np.asarray(timestep.final_obs).tolist() == [0, 0, 0]
    error = env.host.error()
    assert error.text == "RuntimeError: the simulator is gone" and 'raise RuntimeError("the sim' in error.traceback
    again = env.reset(jax.random.key(0))
    assert observed(again) == observed(fine[0]) and env.host.error() is None
    env.host.close()


def test_processes_play_the_same_episodes():
    """Three environments in two processes, of two and one."""
    actions = jnp.array([[GO, END, BAD_OBS], [CUT, GO, GO], [GO, GO, END]])

    def episodes(env):
        timestep = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 3))
        found = [timestep]
        for action in actions:
            found.append(timestep := jax.jit(jax.vmap(env.step))(timestep, action))
        return [(t.obs, t.final_obs, t.reward, t.terminated, t.truncated, env.status(t)) for t in found]

    env = counter(2)
    found = jax.tree.leaves(episodes(env))
    for a, b in zip(found, jax.tree.leaves(episodes(plain())), strict=True):
        np.testing.assert_array_equal(a, b)
    env.host.close()
    env.host.close()  # does nothing


def test_a_process_that_ends_is_an_error_until_the_next_reset():
    env = counter(1, exits_at=2)
    assert bool(env.host.failed(play([GO] * 3, env=env)[-1]))
    assert "a worker process ended by itself (exit codes: [7])" in env.host.error().text
    assert play([GO], env=env)[-1].reward == 1 and env.host.error() is None
    env.host.close()


def test_a_wait_that_ctrl_c_ends_does_not_give_its_result_to_the_next_call():
    thread, release = PlayingThread(), threading.Event()

    def late():
        time.sleep(0.2)  # until the other thread waits: a signal just before would be seen after the wait
        os.kill(os.getpid(), signal.SIGINT)
        return release.wait(60)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            thread.run(late)
    finally:
        signal.signal(signal.SIGINT, before)
        release.set()
    assert thread.run(lambda: "next") == "next"


def test_an_environment_that_nobody_has_any_more_leaves_no_thread_and_no_process():
    def used(processes):
        env = counter(processes)
        play([GO], env=env)

    def here():
        gc.collect()
        return {*threading.enumerate(), *multiprocessing.active_children()}

    before = here()
    used(0)
    used(1)
    deadline = time.monotonic() + 20
    while here() - before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not here() - before


def test_on_an_accelerator_the_call_is_pure_and_plays_the_same(monkeypatch):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    env = counter()
    for ours, theirs in zip(play([GO, END, GO], env=env), play([GO, END, GO]), strict=True):
        assert observed(ours) == observed(theirs) and ours.reward == theirs.reward
