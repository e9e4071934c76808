"""Tabular Q-learning and the algorithms built on it, as a table of algorithms.

An algorithm has `N` tables of values [S, A]. Algorithms differ in the target of a transition (s, a, r, s') and in which
tables learn from it. The step size of a pair is 1 / n^power, where n counts the visits from which its table has
learned. For powers above 1/2 and up to 1 the sum of step sizes diverges and that of their squares converges (Robbins
and Monro's conditions).

Sources (U and V are the two tables; U learns, chosen by a fair coin each step):

- `q_learning`: Watkins, 1989. r + gamma * max_a Q(s', a).
- `double_q`: van Hasselt, 2010. r + gamma * V(s', a*) with a* = argmax_a U(s', a).
- `weighted_double_q`: Zhang, Pan and Kochenderfer, 2017, the SQT paper's eqs. 1 and 2.
  r + gamma * (beta * U(s', a*) + (1 - beta) * V(s', a*)) with beta = |V(s', a*) - V(s', a_low)| / (c + |...|) and
  a_low = argmin_a U(s', a).
- `maxmin`: Lan et al., 2020. r + gamma * max_a min_i Q_i(s', a); one table at random learns from each transition.
- `sqt`: the SQT paper's eq. 13. r + gamma * (min_i Q_i(s', a') - coef * std_i Q_i(s', a')).
- `sqt_shared`: the same target, and all tables learn from each transition, as the critics of a deep SQT agent do.

Assumed for `sqt`, because the text of the paper does not say:

- a' is greedy with respect to the minimum over the tables, so that coef 0 is exactly MaxMin; `greedy` offers the mean
  and the penalised value instead;
- one table at random learns from each transition, as in MaxMin;
- the std has `ddof` 1, as everywhere in this repository;
- the penalty is multiplied by gamma, and is 0 where the episode ended. A "batch" is one transition here, so that
  eqs. 19 and 20 agree.

Behaviour is uniform, or epsilon-greedy on the mean of the tables.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.theorem.mdps import Mdp
from sqt_jax import q_targets
from sqt_jax.types import Array

GREEDY = ("min", "mean", "penalised")


class Target(NamedTuple):
    """The inputs of a target: one transition, and the values of the next state in all tables."""

    reward: Array  # []
    discount: Array  # [], 0 where the episode ended, else 1
    next_q: Array  # [N, A]
    learner: Array  # [], the table that learns
    coef: Array  # [], of the penalty
    gamma: float


def value_inputs(next_q: Array, learner: Array, coef: Array) -> Target:
    """The inputs for which a rule returns the value that it gives to next_q [N, A]: reward 0, gamma 1."""
    return Target(reward=jnp.zeros(()), discount=jnp.ones(()), next_q=next_q, learner=learner, coef=coef, gamma=1.0)


Rule = Callable[[Target], Array]


class TabularAlgorithm(NamedTuple):
    """A row of the table of algorithms."""

    rule: Rule
    num_tables: int
    all_learn: bool = False  # from each transition; else one table at random
    has_coef: bool = False


def single(t: Target) -> Array:
    """Q-learning's target, []."""
    return t.reward + t.gamma * t.discount * jnp.max(t.next_q[t.learner])


def double(t: Target) -> Array:
    """Double Q-learning's target, []."""
    best = jnp.argmax(t.next_q[t.learner])
    return t.reward + t.gamma * t.discount * t.next_q[1 - t.learner, best]


def weighted_double(t: Target, *, c: float) -> Array:
    """Weighted Double Q-learning's target, []; eqs. 1 and 2."""
    u, v = t.next_q[t.learner], t.next_q[1 - t.learner]
    best, lowest = jnp.argmax(u), jnp.argmin(u)
    spread = jnp.abs(v[best] - v[lowest])
    beta = spread / (c + spread)
    return t.reward + t.gamma * t.discount * (beta * u[best] + (1 - beta) * v[best])


def _of_all(t: Target, score: Array, penalty: q_targets.Formula) -> Array:
    """The library's target at the action of the highest `score [A]`, as a batch of one transition."""
    chosen = t.next_q[:, jnp.argmax(score)][:, None]
    return q_targets.td_target(t.reward[None], t.discount[None], chosen, gamma=t.gamma, penalty=penalty)[0]


def maxmin(t: Target) -> Array:
    """MaxMin's target, []."""
    return _of_all(t, q_targets.min_over_critics(t.next_q), q_targets.no_penalty)


def sqt(t: Target, *, ddof: int, greedy: str) -> Array:
    """SQT's target, []; eq. 13."""
    penalty = functools.partial(q_targets.transition_std, coef=t.coef, ddof=ddof)
    lowest = q_targets.min_over_critics(t.next_q)
    score = {
        "min": lambda: lowest,
        "mean": lambda: q_targets.mean_over_critics(t.next_q),
        "penalised": lambda: lowest - penalty(t.next_q),
    }[greedy]()
    return _of_all(t, score, penalty)


def algorithms(num_tables: int = 4, ddof: int = 1, greedy: str = "min", c: float = 1.0) -> dict[str, TabularAlgorithm]:
    """The algorithms by name.

    Args:
      num_tables: N of MaxMin and SQT.
      ddof: the std over tables divides by N - ddof.
      greedy: the value whose maximum is SQT's next action, one of `GREEDY`.
      c: Weighted Double Q-learning's constant; 0 is Q-learning's target on U, infinity Double Q-learning's.
    """
    penalised = functools.partial(sqt, ddof=ddof, greedy=greedy)
    return {
        "q_learning": TabularAlgorithm(single, 1),
        "double_q": TabularAlgorithm(double, 2),
        "weighted_double_q": TabularAlgorithm(functools.partial(weighted_double, c=c), 2),
        "maxmin": TabularAlgorithm(maxmin, num_tables),
        "sqt": TabularAlgorithm(penalised, num_tables, has_coef=True),
        "sqt_shared": TabularAlgorithm(penalised, num_tables, all_learn=True, has_coef=True),
    }


class Model(NamedTuple):
    """An MDP as arrays on the device, with its optimal values."""

    transition: Array  # [S, A, S]
    cumulative: Array  # [S, A, S], of the transition's probabilities
    reward: Array  # [S, A]
    noise: Array  # [S, A]
    start: Array  # [S], cumulative
    optimal: Array  # [S, A], Q*


def model_of(mdp: Mdp, optimal: np.ndarray) -> Model:
    """Also of several MDPs stacked along leading axes."""

    def cumulative(probabilities: np.ndarray) -> np.ndarray:
        total = np.cumsum(probabilities, axis=-1)
        return np.where(total > 1 - 1e-12, 1.0, total)  # a row that sums to 1 up to rounding never ends an episode

    arrays = (mdp.transition, cumulative(mdp.transition), mdp.reward, mdp.noise, cumulative(mdp.start), optimal)
    return Model(*(jnp.asarray(array, jnp.float32) for array in arrays))


class Learner(NamedTuple):
    """An algorithm's tables, and its place in the MDP."""

    tables: Array  # [N, S, A]
    visits: Array  # [N, S, A], float32
    state: Array  # [], the current state of the episode
    steps: Array  # []


class TabularTransition(NamedTuple):
    """One step in the MDP; all []."""

    state: Array
    action: Array
    reward: Array
    next_state: Array
    discount: Array


def learn(
    learner: Learner,
    seen: TabularTransition,
    chosen: Array,
    coef: Array,
    *,
    algorithm: TabularAlgorithm,
    gamma: float,
    power: float,
) -> Learner:
    """One update. `chosen []` is the table that learns, for algorithms in which not all do."""
    target = algorithm.rule(
        Target(
            reward=seen.reward,
            discount=seen.discount,
            next_q=learner.tables[:, seen.next_state],
            learner=chosen,
            coef=coef,
            gamma=gamma,
        )
    )
    learns = jnp.ones(algorithm.num_tables) if algorithm.all_learn else jnp.arange(algorithm.num_tables) == chosen
    learns = learns.astype(jnp.float32)
    at = (slice(None), seen.state, seen.action)
    visits = learner.visits[at] + learns
    rate = learns * jnp.maximum(visits, 1.0) ** -power
    old = learner.tables[at]
    return learner._replace(
        tables=learner.tables.at[at].set(old + rate * (target - old)), visits=learner.visits.at[at].set(visits)
    )


def act(model: Model, learner: Learner, key: Array, epsilon: float) -> tuple[TabularTransition, Array]:
    """One step in the MDP: the transition, and the state of the next step, which is a start state after an end."""
    uniform_key, normal_key = jax.random.split(key)
    explore, action, where, restart = jax.random.uniform(uniform_key, (4,))
    noise = jax.random.normal(normal_key)
    num_states, num_actions = model.reward.shape
    chosen = jnp.minimum((action * num_actions).astype(jnp.int32), num_actions - 1)
    if epsilon < 1:
        best = jnp.argmax(jnp.mean(learner.tables[:, learner.state], axis=0)).astype(jnp.int32)
        chosen = jnp.where(explore < epsilon, chosen, best)
    at = (learner.state, chosen)
    next_state = jnp.sum(where >= model.cumulative[at])
    ended = next_state == num_states
    reward = model.reward[at] + model.noise[at] * noise
    next_state = jnp.minimum(next_state, num_states - 1)
    begin = jnp.where(ended, jnp.sum(restart >= model.start), next_state)
    transition = TabularTransition(
        state=learner.state,
        action=chosen,
        reward=reward,
        next_state=next_state,
        discount=1.0 - ended.astype(jnp.float32),
    )
    return transition, begin


class Measurements(NamedTuple):
    """Measurements of the tables after some step, []; means and maxima are over all N tables."""

    error_max: Array  # max |Q_i - Q*|
    error_mean: Array  # mean |Q_i - Q*|
    bias: Array  # mean (Q_i - Q*)
    std: Array  # mean over pairs (s, a) of std_i Q_i with the penalty's ddof; 0 for a single table
    ratio: Array  # max |T Q - Q*| / (gamma * max |Q_i - Q*|), T the algorithm's expected target; at most 1 by eq. 16


def expected_target(model: Model, tables: Array, coef: Array, algorithm: TabularAlgorithm, gamma: float) -> Array:
    """The algorithm's operator T on its tables, [N, S, A] -> [L, S, A], for each of L tables that may be learning."""

    def value(next_q: Array, learner: Array) -> Array:
        return algorithm.rule(value_inputs(next_q, learner, coef))

    learners = jnp.arange(algorithm.num_tables if algorithm.num_tables == 2 else 1)
    values = jax.vmap(lambda learner: jax.vmap(value, in_axes=(1, None))(tables, learner))(learners)
    return model.reward + gamma * jnp.einsum("sat,lt->lsa", model.transition, values)


def measure(
    model: Model, tables: Array, coef: Array, *, algorithm: TabularAlgorithm, gamma: float, ddof: int
) -> Measurements:
    """Measures `tables` [N, S, A] against the model's optimal values."""
    error = tables - model.optimal
    largest = jnp.max(jnp.abs(error))
    after = jnp.max(jnp.abs(expected_target(model, tables, coef, algorithm, gamma) - model.optimal))
    several = len(tables) > 1
    return Measurements(
        error_max=largest,
        error_mean=jnp.mean(jnp.abs(error)),
        bias=jnp.mean(error),
        std=jnp.mean(q_targets.std_over_critics(tables, min(ddof, len(tables) - 1))) if several else jnp.zeros(()),
        ratio=after / (gamma * largest),
    )


def train(
    model: Model,
    key: Array,
    coef: Array,
    lengths: Array,
    *,
    algorithm: TabularAlgorithm,
    gamma: float = 0.9,
    power: float = 0.8,
    epsilon: float = 1.0,
    ddof: int = 1,
    init_std: float = 0.0,
) -> tuple[Learner, Measurements]:
    """Learns from one stream of experience and measures after each of `lengths [C]` further steps.

    The MDP's random numbers depend on the key only: with uniform behaviour all algorithms see the same stream.

    Returns:
      the learner, and measurements [C].
    """
    num_states, num_actions = model.reward.shape
    shape = (algorithm.num_tables, num_states, num_actions)
    stream, choices, tables_key, begin_key = jax.random.split(key, 4)
    begin = jnp.sum(jax.random.uniform(begin_key) >= model.start)
    tables = init_std * jax.random.normal(tables_key, shape)
    first = Learner(tables=tables, visits=jnp.zeros(shape), state=begin, steps=jnp.zeros((), jnp.int32))

    def step(_: Array, learner: Learner) -> Learner:
        seen, begin = act(model, learner, jax.random.fold_in(stream, learner.steps), epsilon)
        chosen = jax.random.randint(jax.random.fold_in(choices, learner.steps), (), 0, algorithm.num_tables)
        learner = learn(learner, seen, chosen, coef, algorithm=algorithm, gamma=gamma, power=power)
        return learner._replace(state=begin, steps=learner.steps + 1)

    def stretch(learner: Learner, length: Array) -> tuple[Learner, Measurements]:
        learner = jax.lax.fori_loop(0, length, step, learner)
        return learner, measure(model, learner.tables, coef, algorithm=algorithm, gamma=gamma, ddof=ddof)

    return jax.lax.scan(stretch, first, lengths)


def sweep(model: Model, seeds: Array, coefs: Array, lengths: Array, **settings) -> tuple[Learner, Measurements]:
    """`train` for all seeds and coefficients in one program: leaves [seeds, coefs, ...]; the model's [seeds, ...]."""

    def one(model: Model, key: Array, coef: Array) -> tuple[Learner, Measurements]:
        return train(model, key, coef, lengths, **settings)

    over_coefs = jax.vmap(one, in_axes=(None, None, 0))
    return jax.vmap(over_coefs, in_axes=(0, 0, None))(model, jax.vmap(jax.random.key)(seeds), coefs)
