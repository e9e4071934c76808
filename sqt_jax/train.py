"""The training program: one train loop for all algorithms, and its vmap over the members of a sweep.

A `Trainer` holds pure functions of one member. A `Sweep` is the same over S members, compiled: parameters, replay
storage, environments and keys get a member axis. The counters do not, so conditions on them stay real branches under
`vmap`; with a batched condition both branches would be computed.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax import rollout
from sqt_jax.conditional import any_in_batch, apply_if
from sqt_jax.config import TrainConfig
from sqt_jax.evaluate import Evaluation, evaluate_with_bias
from sqt_jax.members import Layout, every_leaf
from sqt_jax.types import Agent, Array, Environment, Metrics, Replay, Scalars, State, TimeStep, Transition

TRAINING, EVALUATION = 0, 1  # folded into a member's key, so that the two streams of numbers differ


class Means(NamedTuple):
    """Running means of metrics; a NaN was not measured and does not count."""

    mean: Metrics
    measured: Metrics  # how many values

    @classmethod
    def start(cls, like: Metrics) -> "Means":
        """Means of no values, for metrics of these names and shapes."""
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape), like)
        return cls(zeros, zeros)

    def add(self, metrics: Metrics) -> "Means":
        """The means with one more value of each metric."""
        count = jax.tree.map(lambda n, x: n + ~jnp.isnan(x), self.measured, metrics)
        # The running mean stays near the values: a long interval does not lose digits, as a sum would.
        mean = jax.tree.map(
            lambda m, n, x: m + jnp.where(jnp.isnan(x), 0.0, (x - m) / jnp.maximum(n, 1)), self.mean, count, metrics
        )
        return Means(mean, count)

    def result(self) -> Metrics:
        """The means; NaN where nothing was measured."""
        return jax.tree.map(lambda m, n: jnp.where(n > 0, m, jnp.nan), self.mean, self.measured)


class TrainState(NamedTuple):
    """All that changes while one member trains."""

    agent: State
    timestep: TimeStep  # [E, ...]
    episodes: rollout.Episodes
    replay: State
    key: Array  # the member's own; every draw folds a counter into it
    env_steps: Array  # [] int32: transitions so far; members share it
    gradient_steps: Array  # [] int32: updates so far; members share it
    diverged_at: Array  # [] int32: the env_steps at which the agent diverged and was frozen; -1: it has not
    means: Means  # of the updates' metrics, since `new_interval`


class Trainer(NamedTuple):
    """Training of one member."""

    init: Callable[..., TrainState]  # (key, scalars=None) -> state
    advance: Callable[..., TrainState]  # (state, num_steps, learn: bool)
    evaluate: Callable[[TrainState], tuple[Evaluation, Metrics]]  # with the bias of the critics' values
    measure: Callable[[TrainState], Metrics]  # means over the interval, and the status at its end
    restart: Callable[[TrainState], TrainState]  # a restored state -> the state to continue with
    member_axes: TrainState  # prefix tree of `vmap` axes of a state


class Sweep(NamedTuple):
    """Training of S members in lockstep: the functions of `Trainer` with a leading [S], jit-compiled.

    With several devices S is padded to a multiple of their number (`members.Layout`): ignore entries after the first S.
    """

    init: Callable[[Array, Scalars], TrainState]  # (keys [S], scalars of [S] each)
    advance: Callable[[TrainState, int, bool], TrainState]  # donates the state
    evaluate: Callable[[TrainState], tuple[Evaluation, Metrics]]
    measure: Callable[[TrainState], Metrics]
    restart: Callable[[TrainState], TrainState]


def new_interval(state: TrainState) -> TrainState:
    """The state with the averages of `measure` reset."""
    means = jax.tree.map(jnp.zeros_like, state.means)
    return state._replace(episodes=state.episodes.forget_ended(), means=means)


def make_trainer(
    agent: Agent, env: Environment, replay: Replay, config: TrainConfig, eval_env: Environment | None = None
) -> Trainer:
    """Joins an agent, an environment and a replay buffer into the training of one member.

    Args:
      eval_env: the environment of evaluation, usually the same task on other physics; None: `env`.
    """
    num_envs = config.num_envs
    updates = num_envs * config.updates_per_step  # per lockstep step, so that UTD is per transition

    def init(key: Array, scalars: Scalars | None = None) -> TrainState:
        agent_key, env_key, own_key = jax.random.split(key, 3)
        agent_state, replay_state = agent.init(agent_key, scalars), replay.init()
        batch, _ = jax.eval_shape(replay.sample, replay_state, own_key)
        _, _, metrics = jax.eval_shape(agent.update, agent_state, batch, own_key, jnp.int32(0))
        return TrainState(
            agent=agent_state,
            timestep=rollout.reset(env, env_key, num_envs),
            episodes=rollout.Episodes.start(num_envs),
            replay=replay_state,
            key=own_key,
            env_steps=jnp.zeros((), jnp.int32),
            gradient_steps=jnp.zeros((), jnp.int32),
            diverged_at=jnp.full((), -1, jnp.int32),
            means=Means.start(metrics),
        )

    def key_for(purpose: int, state: TrainState) -> Array:
        """A key for this purpose at this step of this member only."""
        return jax.random.fold_in(jax.random.fold_in(state.key, purpose), state.env_steps)

    def step(state: TrainState, learn: bool) -> TrainState:
        act_key, warmup_key, update_key = jax.random.split(key_for(TRAINING, state), 3)

        def behaviour(obs):
            if not learn:
                return rollout.uniform_actions(warmup_key, num_envs, env.action_size)
            return agent.act(agent.see(state.agent, obs), obs, act_key)  # `learn_from` keeps it: the step may fail

        timestep, transition = rollout.step(env, state.timestep, behaviour)

        if env.host is None:
            return learn_from(state, timestep, transition, learn, update_key)
        # Nothing of a step that failed is stored or learned.
        return apply_if(
            ~failed(timestep),
            lambda state: learn_from(state, timestep, transition, learn, update_key),
            state._replace(timestep=timestep),
        )

    def failed(timestep: TimeStep) -> Array:
        """Whether an environment of any member has failed: [] bool, one answer for all."""
        assert env.host is not None
        return any_in_batch(jnp.any(jax.vmap(env.host.failed)(timestep)))

    def learn_from(
        state: TrainState, timestep: TimeStep, transition: Transition, learn: bool, update_key: Array
    ) -> TrainState:
        """The state after a step of the environments: the transitions stored, the updates done."""
        over = timestep.terminated | timestep.truncated
        episodes, episode_return = state.episodes.add(transition.reward, over)
        # An episode that began in the warm-up has random actions in it: its return is not the policy's.
        begun = state.env_steps - num_envs * state.episodes.running_length.astype(jnp.int32)
        ended = over & learn & (begun >= config.warmup_steps)
        with jax.named_scope("observe"):
            agent_state = agent.see(state.agent, transition.obs)
            agent_state = agent.observe(agent_state, episode_return, ended, state.gradient_steps)
        with jax.named_scope("insert"):
            replay_state = replay.insert(state.replay, transition)

        def update(i, carry):
            agent_state, replay_state, means = carry
            step = state.gradient_steps + i
            sample_key, noise_key = jax.random.split(jax.random.fold_in(update_key, i))
            with jax.named_scope("sample"):
                batch, rows = replay.sample(replay_state, sample_key)
            with jax.named_scope("update"):
                agent_state, td_error, metrics = agent.update(agent_state, batch, noise_key, step)
            with jax.named_scope("feedback"):
                replay_state = replay.feedback(replay_state, rows, td_error, step + 1)
            with jax.named_scope("metrics"):
                return agent_state, replay_state, means.add(metrics)

        count = updates if learn else 0
        carry = (agent_state, replay_state, state.means)
        agent_state, replay_state, means = jax.lax.fori_loop(0, count, update, carry)
        env_steps = state.env_steps + num_envs
        diverges_now = agent_state.diverged & (state.diverged_at < 0)
        return TrainState(
            agent=agent_state,
            timestep=timestep,
            episodes=episodes,
            replay=replay_state,
            key=state.key,
            env_steps=env_steps,
            gradient_steps=state.gradient_steps + count,
            diverged_at=jnp.where(diverges_now, env_steps, state.diverged_at),
            means=means,
        )

    def advance(state: TrainState, num_steps: Array | int, learn: bool) -> TrainState:
        """`num_steps` lockstep steps, each of E transitions; without `learn`, random actions and no updates.

        `num_steps` may be traced. One call of n + m steps gives the same bits as calls of n and m steps. It returns
        earlier if an environment on the host fails.
        """
        if env.host is None:
            return jax.lax.fori_loop(0, num_steps, lambda _, state: step(state, learn), state)
        return jax.lax.while_loop(
            lambda carry: (carry[0] < num_steps) & ~failed(carry[1].timestep),
            lambda carry: (carry[0] + 1, step(carry[1], learn)),
            (jnp.zeros((), jnp.int32), state),
        )[1]

    def restart(state: TrainState) -> TrainState:
        """A restored state, with new episodes where the environment's cannot be restored (`Environment.host`)."""
        if env.host is None:
            return state
        episodes = state.episodes.forget_running()
        return state._replace(timestep=jax.vmap(env.host.restart)(state.timestep), episodes=episodes)

    def evaluate_policy(state: TrainState) -> tuple[Evaluation, Metrics]:
        """Deterministic episodes from starts that training never saw, new ones at each evaluation.

        The bias of the critics is measured on them. If the critics estimate the values of a stochastic policy, it is
        measured on as many further episodes of that policy.
        """
        key, count, views = key_for(EVALUATION, state), config.eval_episodes, agent.views

        def policy(obs, key):
            action = agent.act(state.agent, obs[:count], key, deterministic=True)
            if not views.sample:
                return action, jnp.zeros(count)
            sampled, bonus = views.sample(state.agent, obs[count:], key)
            return jnp.concatenate([action, sampled]), jnp.concatenate([jnp.zeros(count), bonus])

        def critics(obs, action):
            return views.q_values(state.agent, obs, action)

        episodes = 2 * count if views.sample else count
        gamma = state.agent.scalars.gamma
        played, bias = evaluate_with_bias(
            eval_env or env, policy, critics, gamma, key, episodes, num_bias_episodes=count
        )
        return jax.tree.map(lambda x: x[:count], played), bias

    def measure(state: TrainState) -> Metrics:
        """Means since `new_interval` (NaN where nothing was measured), and the status of agent and environments."""
        status = agent.views.status(state.agent) | jax.tree.map(jnp.sum, jax.vmap(env.status)(state.timestep))
        episodes = state.episodes
        return (
            state.means.result()
            | status
            | {
                "train_return": episodes.ended_return / episodes.ended,  # 0 / 0 = NaN: no episode ended
                "train_length": episodes.ended_length / episodes.ended,
                "train_episodes": episodes.ended,
                "replay_rows": replay.size(state.replay),
            }
        )

    return Trainer(
        init=init,
        advance=advance,
        evaluate=evaluate_policy,
        measure=measure,
        restart=restart,
        member_axes=member_axes(replay),
    )


def member_axes(replay: Replay) -> TrainState:
    """`vmap` axes of a training state: every member has its own, except the counters."""
    axes = dict.fromkeys(TrainState._fields, 0) | {"replay": replay.member_axes}
    return TrainState(**axes | {"env_steps": None, "gradient_steps": None})


def make_sweep(trainer: Trainer, layout: Layout | None = None) -> Sweep:
    """Compiles a trainer over members: two programs for `advance` (warm-up, training), one for each other function.

    Args:
      layout: the members and their devices; None is any number of members on the default device.
    """
    axes = every_leaf(trainer.member_axes, jax.eval_shape(trainer.init, jax.random.key(0)))
    layout = layout or Layout(1)

    init = layout.over_members(trainer.init, (0, 0), axes)

    def advance(state: TrainState, num_steps: Array | int, learn: bool) -> TrainState:
        advance_member = functools.partial(trainer.advance, learn=learn)
        return layout.over_members(advance_member, (axes, None), axes)(state, num_steps)

    return Sweep(
        init=jax.jit(lambda *arguments: init(*jax.tree.map(layout.padded, arguments))),
        advance=jax.jit(advance, donate_argnums=0, static_argnums=2),
        evaluate=jax.jit(layout.over_members(trainer.evaluate, (axes,), 0)),
        measure=jax.jit(layout.over_members(trainer.measure, (axes,), 0)),
        restart=jax.jit(layout.over_members(trainer.restart, (axes,), axes), donate_argnums=0),
    )


def evaluation_steps(config: TrainConfig) -> list[int]:
    """Environment steps at which a run evaluates: 0, every `eval_every`, and the end."""
    return [*range(0, config.steps, config.eval_every), config.steps]


def segments(start: int, stop: int, config: TrainConfig) -> list[tuple[int, bool]]:
    """The phases between two environment steps, as (lockstep steps, learn): warm-up first, then training."""
    boundary = min(max(start, config.warmup_steps), stop)
    parts = [((boundary - start) // config.num_envs, False), ((stop - boundary) // config.num_envs, True)]
    return [(count, learn) for count, learn in parts if count]


class History(NamedTuple):
    """The results of a training run, a row per evaluation."""

    env_steps: Array  # [evaluations]
    returns: Array  # [evaluations, episodes]
    lengths: Array  # [evaluations, episodes]
    metrics: Metrics  # [evaluations] each, from `Trainer.measure` and the bias


def make_train(trainer: Trainer, config: TrainConfig) -> Callable[..., tuple[TrainState, History]]:
    """One member's run as one pure function `train(key, scalars=None)`, for `jax.jit(jax.vmap(train))`."""
    stops = evaluation_steps(config)
    # Each row has two phases (warm-up, training), either of which may be empty.
    counts = [[0, 0]]  # the evaluation before the first step
    for start, stop in zip(stops, stops[1:], strict=False):
        parts = {learn: count for count, learn in segments(start, stop, config)}
        counts.append([parts.get(False, 0), parts.get(True, 0)])

    def train(key: Array, scalars: Scalars | None = None) -> tuple[TrainState, History]:
        def interval(state, count):
            warmup, training = count
            state = trainer.advance(new_interval(state), warmup, learn=False)
            state = trainer.advance(state, training, learn=True)
            evaluation, bias = trainer.evaluate(state)
            return state, (state.env_steps, evaluation, trainer.measure(state) | bias)

        start = trainer.init(key, scalars)
        state, (env_steps, evaluations, metrics) = jax.lax.scan(interval, start, jnp.array(counts))
        return state, History(
            env_steps=env_steps, returns=evaluations.returns, lengths=evaluations.lengths, metrics=metrics
        )

    return train
