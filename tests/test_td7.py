"""TD7's own parts by hand: value bounds, the order of an update, copies, policy checkpoints, and its train loop."""

import re
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import sale
from sqt_jax.agents import td3, td7
from sqt_jax.config import AgentConfig
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.experiment import agent_of, make_config, make_trainer
from sqt_jax.train import Sweep, TrainState, make_sweep, new_interval
from sqt_jax.types import Agent, Transition

O, A, B, N, Z = 3, 2, 8, 2, 6
KEY = jax.random.key(0)
PERIOD, SWITCH = 3, 4
CONFIG = AgentConfig(
    hidden=(8, 7),
    embedding_size=Z,
    penalty="batch_std",
    penalty_coef=0.5,
    policy_delay=1,
    target_update_period=PERIOD,
    policy_checkpoint_switch=SWITCH,
    assessment_episodes=3,
    exploration_noise=0.0,
)
PARTS = td7.build(CONFIG, O, A)
AGENT = PARTS.agent
VIEWS = AGENT.views
NO_NOISE = td3.TD3Draws(jnp.zeros((B, A)), jnp.arange(N))
ENCODER, ACTOR, CRITICS = sale.encoder(Z, (8, 7)), sale.sale_actor(A, (8, 7)), sale.sale_critics(N, (8, 7))

LEARNER = td7.build_learner(CONFIG, O, A, td7.deterministic(CONFIG))

update = jax.jit(PARTS.update)
update_learner = jax.jit(LEARNER.update)
td_target = jax.jit(LEARNER.td_target)


@cache
def checkpointed(seed=0):
    return jax.jit(AGENT.init)(jax.random.key(seed))


def init(seed=0):
    """The learner's first state."""
    return checkpointed(seed).learner


def make_batch(seed) -> Transition:
    generator = np.random.default_rng(seed)
    obs, next_obs = generator.normal(size=(2, B, O))
    action, reward = generator.uniform(-1, 1, size=(B, A)), generator.normal(size=B)
    fields = (obs, action, reward, next_obs, generator.random(B) < 0.8)
    return Transition(*(jnp.asarray(field, jnp.float32) for field in fields))


def run(state, steps):
    """The states after each of a few updates, of the learner or of all, and before them `state`."""
    states, function = [state], update if hasattr(state, "learner") else update_learner
    for k in range(steps):
        states.append(function(states[-1], make_batch(k), NO_NOISE, k)[0])
    return states


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def open_bounds(state, low=-1e8, high=1e8):
    return state._replace(value_bounds=state.value_bounds._replace(low=jnp.float32(low), high=jnp.float32(high)))


# The start


def test_everything_starts_as_the_learner():
    state, checkpoints = init(), checkpointed().checkpoints
    assert same(state.target_actor, state.actor) and same(state.target_critic, state.critic)
    assert same(state.fixed_encoder, state.encoder) and same(state.fixed_encoder_target, state.encoder)
    assert same(checkpoints.snapshot, td7.PolicyParams(state.actor, state.encoder))
    assert same(checkpoints.checkpoint, checkpoints.snapshot)
    assert same(state.value_bounds, td7.ValueBounds(1e8, -1e8, 0.0, 0.0))
    assert same(checkpoints[2:], (-1e8, 1e8, 0, 0, 0))
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves((state.actor_opt, state.critic_opt, state.encoder_opt)))


# Value bounds


def test_before_the_first_copy_the_bootstrapped_value_is_zero():
    batch = make_batch(0)
    target, terms = td_target(init(), batch, NO_NOISE)
    np.testing.assert_allclose(target, batch.reward - 0.99 * batch.discount * terms["penalty"], rtol=1e-5, atol=1e-6)
    assert terms["penalty"] > 0  # the disagreement does not depend on the bounds


def test_the_bounds_clip_the_reduced_value_before_the_penalty():
    batch = make_batch(0)
    free, terms = td_target(open_bounds(init()), batch, NO_NOISE)
    alive = np.asarray(batch.discount) == 1
    value = (np.asarray(free) - np.asarray(batch.reward))[alive] / 0.99 + float(terms["penalty"])
    low, high = np.quantile(value, [0.3, 0.7])
    clipped, _ = td_target(open_bounds(init(), low, high), batch, NO_NOISE)
    expected = np.asarray(batch.reward)[alive] + 0.99 * (np.clip(value, low, high) - float(terms["penalty"]))
    np.testing.assert_allclose(np.asarray(clipped)[alive], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(clipped)[~alive], np.asarray(batch.reward)[~alive])


def test_the_running_bounds_are_those_of_all_targets_and_come_into_use_at_copies():
    state, lowest, highest, in_use = init(), 1e8, -1e8, (0.0, 0.0)
    for k in range(1, 2 * PERIOD + 1):
        target, _ = td_target(state, make_batch(k), NO_NOISE)
        state, _, _ = update_learner(state, make_batch(k), NO_NOISE, k - 1)
        lowest, highest = min(lowest, float(target.min())), max(highest, float(target.max()))
        if k % PERIOD == 0:
            in_use = (lowest, highest)
        np.testing.assert_allclose(state.value_bounds, (lowest, highest, *in_use), rtol=1e-5)
    assert state.value_bounds.low < state.value_bounds.high


# An update


def test_copies_are_hard_follow_the_update_and_lag_in_the_encoders():
    states = run(open_bounds(init()), 2 * PERIOD + 1)
    for k, (before, after) in enumerate(zip(states, states[1:], strict=False), start=1):
        assert not same(before.encoder, after.encoder)
        assert not same(before.critic, after.critic) and not same(before.actor, after.actor)
        if k % PERIOD:
            for name in ("target_actor", "target_critic", "fixed_encoder", "fixed_encoder_target"):
                assert same(getattr(before, name), getattr(after, name)), name
        else:
            assert same(after.target_actor, after.actor) and same(after.target_critic, after.critic)
            assert same(after.fixed_encoder, after.encoder)
            assert same(after.fixed_encoder_target, before.fixed_encoder)
    assert not same(states[-1].fixed_encoder_target, states[-1].fixed_encoder)


def changed(states, other):
    """For each network the update at which it first differs between two runs; 0 where it starts different."""
    names = ("encoder", "fixed_encoder", "fixed_encoder_target", "critic", "actor")
    pairs = list(zip(states, other, strict=True))
    return {
        name: next((k for k, (a, b) in enumerate(pairs) if not same(getattr(a, name), getattr(b, name))), None)
        for name in names
    }


def test_the_encoders_learning_reaches_the_critics_one_copy_later_and_the_target_two():
    start = open_bounds(init())
    other = start._replace(encoder=init(1).encoder)
    first = changed(run(start, 2 * PERIOD + 1), run(other, 2 * PERIOD + 1))
    assert first == {
        "encoder": 0,
        "fixed_encoder": PERIOD,
        "fixed_encoder_target": 2 * PERIOD,
        "critic": PERIOD + 1,
        "actor": PERIOD + 1,
    }


def test_the_actor_climbs_the_mean_of_the_critics_that_the_update_has_made():
    """Adam's first step has the sign of the gradient; a large rate distinguishes the new critics from the old ones."""
    batch, before = make_batch(0), open_bounds(init())
    before = before._replace(scalars=before.scalars._replace(lr=jnp.float32(0.3)), fixed_encoder=init(1).encoder)
    after, _, _ = update_learner(before, batch, NO_NOISE, 0)

    @jax.jit
    @jax.grad
    def climb(actor, critic):
        zs = ENCODER.zs(before.fixed_encoder, batch.obs)
        action = ACTOR.apply(actor, batch.obs, zs)
        return CRITICS.apply(critic, batch.obs, action, ENCODER.zsa(before.fixed_encoder, zs, action), zs).mean()

    moved = np.concatenate(
        [np.ravel(a - b) for a, b in zip(*map(jax.tree.leaves, (after.actor, before.actor)), strict=True)]
    )
    agreement = {}
    for name, critic in (("new", after.critic), ("old", before.critic)):
        slope = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(climb(before.actor, critic))])
        clear = np.abs(slope) > 1e-5
        agreement[name] = np.mean(np.sign(moved[clear]) == np.sign(slope[clear]))
    assert agreement["new"] == 1 and agreement["old"] < 0.95


def test_the_encoder_learns_to_predict_the_next_embedding_which_does_not_move_to_meet_it():
    """Again by the sign of Adam's first step."""
    batch, before = make_batch(0), init()
    after, _, metrics = update_learner(before, batch, NO_NOISE, 0)
    target = ENCODER.zs(before.encoder, batch.next_obs)

    @jax.jit
    @jax.value_and_grad
    def loss(encoder):
        zsa = ENCODER.zsa(encoder, ENCODER.zs(encoder, batch.obs), batch.action)
        return jnp.mean((zsa - target) ** 2)

    value, grads = loss(before.encoder)
    np.testing.assert_allclose(metrics["encoder_loss"], value, rtol=1e-5)
    for new, old, slope in zip(*map(jax.tree.leaves, (after.encoder, before.encoder, grads)), strict=True):
        clear = np.abs(slope) > 1e-5
        assert clear.any()
        np.testing.assert_array_equal(np.sign((new - old)[clear]), -np.sign(slope[clear]))


# Losses

Q = jnp.array([[1.0, 2.0], [3.0, 5.0]])


def test_lap_huber_is_quadratic_below_the_minimum_priority_and_linear_above(maybe_jit):
    target = jnp.array([0.5, 2.0])  # errors 0.5 and 0; 2.5 and 3
    loss = maybe_jit(lambda q, target: td7.lap_huber(q, target, 1.0))(Q, target)
    assert loss.shape == ()
    np.testing.assert_allclose(loss, (0.125 + 0) / 2 + (2.5 + 3) / 2)  # summed over critics, averaged over the batch
    np.testing.assert_allclose(td7.lap_huber(Q, target, 2.75), (0.125 + 0) / 2 + (3.125 + 2.75 * 3) / 2)


def test_lap_hubers_slope_is_bounded():
    grad = jax.grad(lambda q: td7.lap_huber(q, jnp.array([0.5, 2.0]), 1.0))(Q)
    np.testing.assert_allclose(grad, [[0.25, 0], [0.5, 0.5]])  # the error up to 1, per row of the batch
    below = jax.grad(lambda q: td7.lap_huber(q, jnp.array([10.0, -10.0]), 1.0))(Q)
    np.testing.assert_allclose(below, [[-0.5, 0.5], [-0.5, 0.5]])


# Policy checkpoints


@pytest.mark.parametrize(("best", "reset"), [(100.0, 90.0), (-100.0, -90.0)])
def test_the_best_is_lowered_once_at_the_switch(best, reset):
    checkpoints = checkpointed().checkpoints._replace(best_min_return=jnp.float32(best))
    state = checkpointed()._replace(checkpoints=checkpoints)
    seen = [float(state.checkpoints.best_min_return) for state in run(state, SWITCH + 3)]
    np.testing.assert_allclose(seen, [best] * SWITCH + [reset] * 4, rtol=1e-6)


@pytest.fixture(scope="module")
def three_policies():
    """A state whose learner, snapshot and checkpoint differ, and so do its three encoders."""
    first, second, third = init(0), init(1), init(2)
    checkpoints = checkpointed().checkpoints._replace(
        snapshot=td7.PolicyParams(second.actor, second.encoder), checkpoint=td7.PolicyParams(third.actor, third.encoder)
    )
    learner = open_bounds(first._replace(encoder=third.encoder, fixed_encoder_target=second.encoder))
    return checkpointed()._replace(learner=learner, checkpoints=checkpoints)


def by_hand(policy, obs):
    return ACTOR.apply(policy.actor, obs, ENCODER.zs(policy.encoder, obs))


def test_the_snapshot_acts_and_the_checkpoint_is_evaluated(three_policies):
    state, obs = three_policies, make_batch(0).obs
    behaviour, evaluation = (AGENT.act(state, obs, KEY, deterministic=flag) for flag in (False, True))
    np.testing.assert_allclose(behaviour, by_hand(state.checkpoints.snapshot, obs), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(evaluation, by_hand(state.checkpoints.checkpoint, obs), rtol=1e-5, atol=1e-6)
    assert not np.any(np.isclose(behaviour, evaluation, rtol=1e-3))
    assert same(VIEWS.policy(state), state.checkpoints.checkpoint)
    np.testing.assert_array_equal(VIEWS.policy_action(VIEWS.policy(state), obs), evaluation)


def test_the_exploration_noise_is_added_to_the_snapshots_action():
    agent = td7.build(AgentConfig(hidden=(8, 7), embedding_size=Z), O, A).agent
    obs, state = jnp.zeros((4096, O)), checkpointed()
    noise = agent.act(state, obs, KEY) - by_hand(state.checkpoints.snapshot, obs)
    assert abs(float(noise.mean())) < 0.005 and abs(float(noise.std()) - 0.1) < 0.005


def test_learning_does_not_change_snapshot_and_checkpoint(three_policies):
    before, after = three_policies, run(three_policies, PERIOD + 1)[-1]
    assert same(after.checkpoints.snapshot, before.checkpoints.snapshot)
    assert same(after.checkpoints.checkpoint, before.checkpoints.checkpoint)
    before, after = before.learner, after.learner
    assert not same(after.actor, before.actor) and not same(after.fixed_encoder, before.fixed_encoder)


def test_an_episodes_end_refreshes_the_snapshot_from_actor_and_fixed_encoder(three_policies):
    before = three_policies
    running = AGENT.observe(before, jnp.array([5.0]), jnp.array([False]), 0)
    assert same(running, before)
    after = AGENT.observe(before, jnp.array([5.0]), jnp.array([True]), 0)
    assert same(after.checkpoints.snapshot, td7.PolicyParams(before.learner.actor, before.learner.fixed_encoder))
    assert same(after.checkpoints.checkpoint, before.checkpoints.snapshot)
    assert same(after._replace(checkpoints=None), before._replace(checkpoints=None))


def test_past_the_switch_of_gradient_steps_one_episode_does_not_end_an_assessment(three_policies):
    late = three_policies
    after = AGENT.observe(late, jnp.array([5.0]), jnp.array([True]), SWITCH).checkpoints
    assert after.episodes == 1 and after.assessments == 0
    assert same(after.snapshot, late.checkpoints.snapshot)
    for _ in range(CONFIG.assessment_episodes):
        late = AGENT.observe(late, jnp.array([5.0]), jnp.array([True]), SWITCH)
    assert late.checkpoints.assessments == 1


def test_episodes_of_several_environments_are_rejected(three_policies):
    with pytest.raises(ValueError, match=r"td7 expects one environment: .* not \(2,\)"):
        AGENT.observe(three_policies, jnp.array([5.0, 6.0]), jnp.array([True, False]), 0)


def test_the_status_has_policy_checkpoints_and_bounds(three_policies):
    status = VIEWS.status(three_policies)
    assert status["assessments"] == status["policy_checkpoint_refreshes"] == 0 and np.isnan(status["best_min_return"])
    state = checkpointed()._replace(learner=open_bounds(init(), -3.0, 4.0))
    status = VIEWS.status(AGENT.observe(state, jnp.array([5.0]), jnp.array([True]), 0))
    named = ("assessments", "policy_checkpoint_refreshes", "best_min_return", "value_low", "value_high")
    assert [float(status[name]) for name in named] == [1, 1, 5, -3, 4]


# The train loop

MEMBERS, EPISODE = 3, 5


def reward_is_the_action():
    """Always the same observation and reward for the first action: a return identifies the policy."""

    def start(key):
        return jnp.zeros(()), jnp.array([0.3, -0.2])

    def advance(state, action):
        return state, jnp.array([0.3, -0.2]), action[0], jnp.zeros((), bool)

    return make_environment("reward_is_the_action", 2, 1, EPISODE, start, advance)


class Trained(NamedTuple):
    """A sweep of a short run, and its states after the warm-up and after each training episode."""

    agent: Agent
    sweep: Sweep
    warm: TrainState
    warm_metrics: dict
    states: list  # of the agent, before the first episode of the training and after each
    metrics: list
    final: TrainState


@pytest.fixture(scope="module")
def trained():
    settings = {"steps": 54_321, "warmup_steps": 20, "hidden": (8, 8), "batch_size": 16, "embedding_size": 4}
    config = make_config("td7", "cheetah", lr=0.01, target_update_period=4, eval_episodes=2, **settings)
    env = reward_is_the_action()
    sweep = make_sweep(make_trainer(config, env))
    scalars = jax.tree.map(lambda value: jnp.full(MEMBERS, value), config.agent.scalars())
    state = sweep.advance(sweep.init(jax.random.split(KEY, MEMBERS), scalars), 20, False)
    warm_metrics = sweep.measure(state)
    warm, metrics = jax.device_get(state._replace(key=None, timestep=None)), []
    states = [warm.agent]
    for _ in range(12):
        state = sweep.advance(new_interval(state), EPISODE, True)
        states.append(jax.device_get(state.agent))
        metrics.append(jax.device_get(sweep.measure(state)))
    return Trained(agent_of(config, env), sweep, warm, jax.device_get(warm_metrics), states, metrics, state)


def test_the_warm_ups_episodes_are_not_assessed(trained):
    """Their returns are of random actions; they would set the minimum that the first policies have to reach."""
    assert np.all(trained.warm_metrics["train_episodes"] == 4)
    checkpoints = trained.warm.agent.checkpoints
    assert np.all(checkpoints.assessments == 0) and np.all(checkpoints.refreshes == 0)
    assert np.all(checkpoints.best_min_return == np.float32(-1e8)) and np.all(checkpoints.min_return == 1e8)


def test_an_episode_that_the_warm_up_began_is_not_assessed(trained):
    """The warm-up's 20 steps, the last two of them with updates: the fourth episode is still one of the warm-up."""
    scalars = jax.tree.map(lambda value: jnp.full(MEMBERS, value), CONFIG.scalars())
    state = trained.sweep.advance(trained.sweep.init(jax.random.split(KEY, MEMBERS), scalars), 18, False)
    state = trained.sweep.advance(state, 2, True)
    np.testing.assert_array_equal(trained.sweep.measure(state)["assessments"], np.zeros(MEMBERS))
    state = trained.sweep.advance(state, EPISODE, True)
    np.testing.assert_array_equal(trained.sweep.measure(state)["assessments"], np.ones(MEMBERS))


def test_each_training_episode_is_assessed_by_the_rule(trained):
    """In plain Python, from the returns that the training reports."""
    refreshes = np.zeros(MEMBERS)
    best = np.full(MEMBERS, -1e8, np.float32)
    for k, (before, after, metrics) in enumerate(
        zip(trained.states, trained.states[1:], trained.metrics, strict=False), start=1
    ):
        assert np.all(metrics["train_episodes"] == 1) and np.all(metrics["assessments"] == k)
        for i in range(MEMBERS):
            old, new = (jax.tree.map(lambda leaf, i=i: leaf[i], agent.checkpoints) for agent in (before, after))
            better = metrics["train_return"][i] >= best[i]
            best[i] = metrics["train_return"][i] if better else best[i]
            refreshes[i] += better
            assert same(new.checkpoint, old.snapshot if better else old.checkpoint)
            assert not same(new.snapshot, old.snapshot)  # refreshed from a learner that continues to learn
        np.testing.assert_array_equal(metrics["policy_checkpoint_refreshes"], refreshes)
        np.testing.assert_array_equal(metrics["best_min_return"], best)
    assert np.any(refreshes < 12) and np.all(refreshes >= 2)  # both cases were seen


def test_evaluation_plays_the_checkpoint(trained):
    obs = jnp.array([[0.3, -0.2]])
    state = trained.states[-1]
    act = jax.jit(jax.vmap(lambda policy: trained.agent.views.policy_action(policy, obs)[0, 0]))
    assert same(trained.agent.views.policy(state), state.checkpoints.checkpoint)  # and it is the policy that is saved
    worth = np.asarray(act(state.checkpoints.checkpoint))
    returns = np.asarray(trained.sweep.evaluate(trained.final)[0].returns)
    np.testing.assert_allclose(returns, EPISODE * worth[:, None].repeat(2, axis=1), rtol=1e-5, atol=1e-6)
    learner = td7.PolicyParams(state.learner.actor, state.learner.fixed_encoder)
    for other in (state.checkpoints.snapshot, learner):
        assert not np.all(np.isclose(act(other), worth, atol=1e-5))


def test_the_replay_learns_its_priorities(trained):
    assert np.all(trained.warm.replay.max_priority == 1)
    filled, levels = 20 + 12 * EPISODE, trained.final.replay.levels
    priorities = np.asarray(levels[0]).reshape(MEMBERS, -1)
    assert np.all(priorities[:, :filled] >= 1) and np.all(priorities[:, filled:] == 0)
    np.testing.assert_allclose(np.sum(levels[-1], axis=(1, 2)), priorities.sum(axis=1), rtol=1e-5)


@pytest.mark.slow
def test_training_refreshes_the_largest_priority_with_the_copies_of_the_targets(trained):
    """A largest priority that no row has any more: rows that got it are drawn at once and get their own."""
    state = jax.jit(lambda state: jax.tree.map(jnp.copy, state))(trained.final)  # training donates its state
    steps = int(state.gradient_steps)
    assert steps % 4 == 0
    state = state._replace(replay=state.replay._replace(max_priority=jnp.full(MEMBERS, 1000.0)))
    state = trained.sweep.advance(state, 3, True)
    assert np.all(state.replay.max_priority == 1000)
    state = trained.sweep.advance(state, 5, True)
    assert int(state.gradient_steps) == steps + 8
    assert np.all(state.replay.max_priority < 10)


def test_the_train_loop_copies_neither_storage_nor_priorities(trained):
    state = trained.final
    text = trained.sweep.advance.lower(state, 1, True).compile().as_text()
    for leaf in (state.replay.rows.storage, *state.replay.levels[:-1]):
        shape = re.escape("f32[" + ",".join(map(str, leaf.shape)) + "]")
        kinds = set(re.findall(rf"= {shape}\S* ([\w-]+)\(", text))
        assert kinds & {"scatter", "dynamic-update-slice"}
        assert kinds <= {"scatter", "dynamic-update-slice", "fusion", "get-tuple-element", "parameter", "bitcast"}, (
            kinds
        )
