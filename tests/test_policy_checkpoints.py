"""TD7's policy checkpoints by hand: snapshot, checkpoint and counters after the end of an episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax.agents import policy_checkpoints
from sqt_jax.agents.td7 import PolicyParams
from sqt_jax.config import AgentConfig

SWITCH = 4
CONFIG = AgentConfig(policy_checkpoint_switch=SWITCH, assessment_episodes=3)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def labelled(label):
    return PolicyParams(jnp.float32(label), jnp.float32(label))


def assess(state, learner, gradient_steps, episode_return, ended=True):
    return jax.jit(policy_checkpoints.assess, static_argnums=0)(
        CONFIG, state, labelled(learner), jnp.int32(gradient_steps), jnp.float32(episode_return), jnp.asarray(ended)
    )


def story(state, *episodes, gradient_steps=0, learners=range(1, 100)):
    """(snapshot, checkpoint, best, min, episodes, assessments, refreshes) after each of the episodes."""
    rows = []
    for learner, episode_return in zip(learners, episodes, strict=False):
        state = assess(state, learner, gradient_steps, episode_return)
        assert same(state.snapshot.actor, state.snapshot.encoder)
        assert same(state.checkpoint.actor, state.checkpoint.encoder)
        rows.append((float(state.snapshot.actor), float(state.checkpoint.actor), *map(float, state[2:])))
    return state, rows


START = policy_checkpoints.PolicyCheckpoints(labelled(0), labelled(0), *map(jnp.float32, (-1e8, 1e8, 0, 0, 0)))


def test_before_the_switch_each_episode_is_an_assessment():
    _, rows = story(START, 5.0, 3.0, 7.0, 7.0, -2.0)
    assert rows == [
        # snapshot, checkpoint, best, min, episodes, assessments, refreshes
        (1, 0, 5, 1e8, 0, 1, 1),  # the checkpoint is the assessed policy, not the current learner
        (2, 0, 5, 1e8, 0, 2, 1),  # worse: policy 1 is dropped
        (3, 2, 7, 1e8, 0, 3, 2),
        (4, 3, 7, 1e8, 0, 4, 3),  # an equal return suffices
        (5, 3, 7, 1e8, 0, 5, 3),
    ]


def test_after_the_switch_an_assessment_has_several_episodes_and_ends_early_below_the_best():
    state = START._replace(snapshot=labelled(50), best_min_return=jnp.float32(6))
    _, rows = story(state, 8.0, 9.0, 7.0, 9.0, 6.5, 7.0, 8.0, 7.5, gradient_steps=SWITCH)
    assert rows == [
        (50, 0, 6, 8, 1, 0, 0),
        (50, 0, 6, 8, 2, 0, 0),  # the minimum, not the last
        (3, 50, 7, 1e8, 0, 1, 1),
        (3, 50, 7, 9, 1, 1, 1),
        (5, 50, 7, 1e8, 0, 2, 1),  # below the best: over after two episodes
        (5, 50, 7, 7, 1, 2, 1),
        (5, 50, 7, 7, 2, 2, 1),
        (8, 5, 7, 1e8, 0, 3, 2),
    ]


def test_the_switch_is_a_number_of_gradient_steps():
    for gradient_steps, assessments in [(SWITCH - 1, 1), (SWITCH, 0), (SWITCH + 1, 0)]:
        assert assess(START, 1, gradient_steps, 5.0).assessments == assessments


def test_an_assessment_in_progress_continues_over_the_switch():
    state = assess(START, 1, SWITCH, 5.0)
    assert (state.episodes, state.assessments) == (1, 0)
    _, rows = story(state, 6.0, 4.0, gradient_steps=SWITCH + 100, learners=[2, 3])
    assert rows == [(0, 0, -1e8, 5, 2, 0, 0), (3, 0, 4, 1e8, 0, 1, 1)]


@pytest.mark.parametrize("episode_return", [-1e9, 5.0, 1e9])
def test_a_running_episode_changes_nothing(episode_return):
    for gradient_steps in (0, SWITCH):
        state, _ = story(START, 5.0, 6.0, gradient_steps=gradient_steps)
        assert same(assess(state, 9, gradient_steps, episode_return, ended=False), state)


def test_at_the_start_snapshot_and_checkpoint_are_the_policy():
    assert same(policy_checkpoints.start(labelled(0)), START)


@pytest.mark.parametrize(("best", "reset"), [(100.0, 90.0), (-100.0, -90.0)])
def test_the_best_is_multiplied_by_the_reset_weight_only_at_the_switch(best, reset):
    """A negative one too, as in TD7's code, although it is then harder to reach."""
    state = START._replace(best_min_return=jnp.float32(best))
    found = [policy_checkpoints.weight_best(CONFIG, state, jnp.int32(k)) for k in range(SWITCH - 1, SWITCH + 2)]
    np.testing.assert_allclose([float(state.best_min_return) for state in found], [best, reset, best], rtol=1e-6)
