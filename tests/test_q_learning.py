"""One step of each rule by hand, what the rules have in common, and their results on small MDPs."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.theorem import contraction, mdps
from experiments.theorem import q_learning as ta

GAMMA = 0.5
# Two tables' values of the next state: U prefers action 0, V action 1.
NEXT = jnp.array([[3.0, 1.0, 0.0], [2.0, 4.0, -2.0]])


def target(rule, next_q=NEXT, learner=0, coef=0.0, reward=1.0, discount=1.0):
    arrays = (jnp.float32(reward), jnp.float32(discount), next_q, jnp.int32(learner), jnp.float32(coef))
    return float(rule(ta.Target(*arrays, GAMMA)))


@pytest.mark.parametrize(
    ("name", "learner", "expected"),
    [
        ("q_learning", 0, 1 + 0.5 * 3),
        ("double_q", 0, 1 + 0.5 * 2),  # V at U's best, action 0
        ("double_q", 1, 1 + 0.5 * 1),  # U at V's best, action 1
        # a* = 0 and a_low = 2 by U; |V(0) - V(2)| = 4, beta = 4 / 5
        ("weighted_double_q", 0, 1 + 0.5 * (0.8 * 3 + 0.2 * 2)),
        # a* = 1 and a_low = 2 by V; |U(1) - U(2)| = 1, beta = 1 / 2
        ("weighted_double_q", 1, 1 + 0.5 * (0.5 * 4 + 0.5 * 1)),
        ("maxmin", 0, 1 + 0.5 * 2),  # minima 2, 1, -2
    ],
)
def test_targets_by_hand(name, learner, expected):
    rule = ta.algorithms(num_tables=2)[name].rule
    assert target(rule, learner=learner) == pytest.approx(expected)
    assert target(rule, learner=learner, discount=0.0) == 1.0


@pytest.mark.parametrize(
    ("greedy", "ddof", "value"),
    [
        # action 0: min 2, deviations of 1/2: std sqrt(1/2) or 1/2; action 1: min 1, deviations of 3/2
        ("min", 1, 2 - 0.5 * 0.5**0.5),
        ("min", 0, 2 - 0.5 * 0.5),
        ("mean", 0, 2 - 0.5 * 0.5),  # both means are 5/2: the first one
        ("penalised", 0, 2 - 0.5 * 0.5),
    ],
)
def test_sqts_target_by_hand(greedy, ddof, value):
    rule = ta.algorithms(2, ddof, greedy)["sqt"].rule
    assert target(rule, coef=0.5) == pytest.approx(1 + 0.5 * value)
    assert target(rule, coef=0.5, discount=0.0) == 1.0


def test_the_next_action_is_greedy_for_the_chosen_value():
    # minima 1, 0.9; means 3, 0.95; penalised with coef 1, ddof 0: 1 - 2, 0.9 - 0.05
    next_q = jnp.array([[1.0, 0.9], [5.0, 1.0]])
    values = [target(ta.algorithms(2, 0, greedy)["sqt"].rule, next_q, coef=1.0) for greedy in ta.GREEDY]
    assert values == pytest.approx([1 - 0.5, 1 - 0.5, 1 + 0.5 * 0.85])
    next_q = jnp.array([[1.0, 0.9], [1.0, 5.0]])
    values = [target(ta.algorithms(2, 0, greedy)["sqt"].rule, next_q, coef=1.0) for greedy in ta.GREEDY]
    assert values == pytest.approx([1.5, 1 + 0.5 * (0.9 - 2.05), 1.5])


def learner_of(num_tables):
    tables = jnp.arange(num_tables * 4, dtype=jnp.float32).reshape(num_tables, 2, 2)
    return ta.Learner(tables, jnp.ones_like(tables), jnp.int32(0), jnp.int32(0))


SEEN = ta.TabularTransition(jnp.int32(0), jnp.int32(1), jnp.float32(1.0), jnp.int32(1), jnp.float32(1.0))


def test_only_the_table_that_learns_changes_by_its_own_step_size():
    algorithm = ta.algorithms(3)["maxmin"]
    before = learner_of(3)
    after = ta.learn(before, SEEN, jnp.int32(1), jnp.float32(0), algorithm=algorithm, gamma=GAMMA, power=1.0)
    # second visit: step size 1/2; target 1 + 0.5 * max(min(2, 6, 10), min(3, 7, 11)) = 2.5; old value 5
    expected = np.array(before.tables)
    expected[1, 0, 1] = 5 + 0.5 * (2.5 - 5)
    np.testing.assert_array_equal(after.tables, expected)
    assert after.visits[1, 0, 1] == 2 and after.visits.sum() == before.visits.sum() + 1


def test_all_tables_learn_if_the_data_are_shared():
    algorithm = ta.algorithms(3)["sqt_shared"]
    after = ta.learn(learner_of(3), SEEN, jnp.int32(1), jnp.float32(0), algorithm=algorithm, gamma=GAMMA, power=1.0)
    np.testing.assert_array_equal(after.tables[:, 0, 1], [(1 + 2.5) / 2, (5 + 2.5) / 2, (9 + 2.5) / 2])
    assert (after.visits[:, 0, 1] == 2).all() and after.visits.sum() == 12 + 3


def test_identical_tables_have_no_penalty_and_equal_q_learning():
    same = jnp.broadcast_to(NEXT[0], (4, 3))
    for greedy in ta.GREEDY:
        for coef in (0.0, 0.5, 10.0):
            rule = ta.algorithms(4, 1, greedy)["sqt"].rule
            assert target(rule, same, coef=coef) == target(ta.algorithms()["q_learning"].rule, same)


@functools.cache
def swept(name):
    """An algorithm on the chain, eight seeds, 20,000 steps: (record, tables)."""
    gamma, seeds, coefs = 0.8, 8, jnp.array([0.0, 0.5, 2.0])
    mdp = mdps.bias_chain(links=2, actions=6)
    model = ta.model_of(mdps.stack([mdp] * seeds), np.stack([mdps.optimal_q(mdp, gamma)] * seeds))
    lengths = jnp.array([300, 1700, 18_000])
    algorithm = ta.algorithms()[name]
    run = jax.jit(functools.partial(ta.sweep, algorithm=algorithm, gamma=gamma, power=0.8))
    learner, record = run(model, jnp.arange(seeds), coefs if algorithm.has_coef else coefs[:1], lengths)
    return jax.device_get((record, learner))


@pytest.mark.slow
@pytest.mark.parametrize("name", ta.algorithms())
def test_every_algorithm_converges(name):
    record, learner = swept(name)
    error = record.error_max.mean(axis=0)  # [coefs, checkpoints]
    assert (error[:, 2] < 0.4 * error[:, 0]).all() and (error[:, 2] < 0.5).all()
    visits = learner.visits.sum(axis=(2, 3, 4))
    assert (visits == 20_000 * (4 if name == "sqt_shared" else 1)).all()


def test_q_learning_overestimates_and_sqt_less_with_every_coefficient():
    bias = {name: swept(name)[0].bias.mean(axis=-1) for name in ("q_learning", "sqt")}
    assert (bias["q_learning"] > 0).all()
    assert (bias["sqt"] < bias["q_learning"]).all()
    assert (np.diff(bias["sqt"], axis=1) < 0).all()
    assert bias["sqt"][:, 2].mean() < 0


def test_the_penalty_vanishes():
    std = swept("sqt")[0].std
    assert (std[..., 2] < std[..., 1]).all() and (std[..., 2] < 0.3 * std[..., 0]).all()


def test_without_a_penalty_sqt_is_maxmin_bit_for_bit():
    (sqt, sqt_learner), (maxmin, maxmin_learner) = swept("sqt"), swept("maxmin")
    np.testing.assert_array_equal(sqt_learner.tables[:, :1], maxmin_learner.tables)
    np.testing.assert_array_equal(sqt.bias[:, :1], maxmin.bias)


def test_tables_that_learn_from_the_same_transitions_are_q_learning_whatever_the_coefficient():
    (shared, learner), (_, plain) = swept("sqt_shared"), swept("q_learning")
    assert not shared.std.any()
    # between two programs, except for rounding
    np.testing.assert_allclose(learner.tables, np.broadcast_to(plain.tables, learner.tables.shape), atol=1e-5)


def test_the_operator_keeps_the_optimum_and_contracts_without_a_penalty():
    for name in ("q_learning", "maxmin"):
        assert (swept(name)[0].ratio <= 1 + 1e-5).all()
    mdp = mdps.random_mdp(1)
    model = ta.model_of(mdp, mdps.optimal_q(mdp, 0.8))
    for name in ("double_q", "weighted_double_q", "sqt"):
        algorithm = ta.algorithms()[name]
        tables = jnp.broadcast_to(model.optimal, (algorithm.num_tables, *model.optimal.shape))
        after = ta.expected_target(model, tables, jnp.float32(2.0), algorithm, 0.8)
        np.testing.assert_allclose(after, jnp.broadcast_to(model.optimal, after.shape), atol=1e-5)


def test_the_experience_has_the_models_frequencies():
    mdp = mdps.Mdp(
        np.array([[[0.5, 0.25]], [[0.0, 1.0]]]), np.array([[1.0], [2.0]]), np.full((2, 1), 2.0), np.eye(2)[0]
    )
    model = ta.model_of(mdp, np.zeros((2, 1)))
    learner = ta.Learner(jnp.zeros((1, 2, 1)), jnp.zeros((1, 2, 1)), jnp.int32(0), jnp.int32(0))
    keys = jax.vmap(jax.random.key)(jnp.arange(4000))
    seen, begin = jax.jit(jax.vmap(lambda key: ta.act(model, learner, key, 1.0)))(keys)
    ended = seen.discount == 0
    assert abs(float(jnp.mean(ended)) - 0.25) < 0.03
    assert abs(float(jnp.mean(seen.next_state[~ended])) - 1 / 3) < 0.03
    assert abs(float(jnp.mean(seen.reward)) - 1) < 0.15 and abs(float(jnp.std(seen.reward)) - 2) < 0.1
    assert (begin[ended] == 0).all() and (begin[~ended] == seen.next_state[~ended]).all()


def test_epsilon_greedy_chooses_the_best_action_of_the_mean():
    mdp = mdps.bias_chain(links=1, actions=4)
    model = ta.model_of(mdp, np.zeros((2, 4)))
    tables = jnp.zeros((2, 2, 4)).at[0, 0, 1].set(3.0).at[:, 0, 2].set(1.6)
    learner = ta.Learner(tables, tables, jnp.int32(0), jnp.int32(0))
    keys = jax.vmap(jax.random.key)(jnp.arange(2000))
    seen, _ = jax.jit(jax.vmap(lambda key: ta.act(model, learner, key, 0.4)))(keys)
    shares = np.bincount(np.asarray(seen.action), minlength=4) / 2000
    np.testing.assert_allclose(shares, [0.1, 0.1, 0.7, 0.1], atol=0.03)


# Eq. 16.


def test_the_counter_example_in_exact_arithmetic():
    # mean 0, variance (1 + 0 + 1) / 2 = 1: min - coef * std is 0 for Q and -1 - coef for Q'; no entry differs by > 1.
    for coef in (Fraction(1, 10), Fraction(1, 2), Fraction(1)):
        assert contraction.counter_example(coef) == (1 + coef, 1)
    assert contraction.counter_example(Fraction(0)) == (1, 1)
    with pytest.raises(ValueError, match="rational"):
        contraction.exact_value([Fraction(0), Fraction(1)], Fraction(1), 1)


def test_the_counter_example_holds_for_the_rule_itself():
    rule = ta.algorithms(3)["sqt"].rule
    one, other = (np.array(q, np.float32).reshape(1, 3, 1) for q in contraction.EXAMPLE)
    assert contraction.ratios(contraction.values_of(rule), 0.5, one, other) == pytest.approx([1.5])


@pytest.mark.parametrize(("count", "ddof"), [(2, 1), (3, 0), (4, 1)])
def test_the_search_finds_the_bound_and_nothing_above(count, ddof):
    values = contraction.values_of(ta.algorithms(count, ddof)["sqt"].rule)
    found = contraction.search(values, 0.5, count, 1, pairs=50_000).ratio
    bound = contraction.bound(0.5, count, ddof)
    assert 0.99 * bound < found < bound + 1e-4
    assert contraction.search(values, 0.0, count, 1, pairs=50_000).ratio <= 1 + 1e-5
    assert contraction.search(values, 0.5, count, 1, identical=True, pairs=50_000).ratio <= 1 + 1e-5


def test_near_a_tie_the_ratio_is_unbounded():
    ratios = {
        greedy: [
            contraction.near_tie(contraction.values_of(ta.algorithms(2, 1, greedy)["sqt"].rule), 0.5, gap)
            for gap in (0.01, 0.001)
        ]
        for greedy in ta.GREEDY
    }
    # the std of the second action is sqrt(2): its penalty depends on the choice
    assert ratios["min"] == pytest.approx([(2**0.5 / 2 - gap) / (2 * gap) for gap in (0.01, 0.001)], rel=1e-3)
    assert ratios["mean"][1] > 9 * ratios["mean"][0] > 300
    assert max(ratios["penalised"]) <= contraction.bound(0.5, 2, 1)
