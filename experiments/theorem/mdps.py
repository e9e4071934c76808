"""Small Markov decision processes with known optimal values, for the tabular study.

NumPy, float64: they are built once and passed to JAX as arrays. `S` is the number of states, `A` of actions.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Mdp(NamedTuple):
    """A finite MDP with Gaussian rewards. Several of one shape, stacked along a leading axis, are an `Mdp` too.

    There are no terminal states: the episode ends with probability 1 minus the sum of a transition's row, and the next
    one begins at `start`.
    """

    transition: np.ndarray  # [S, A, S], rows sum to at most 1
    reward: np.ndarray  # [S, A], means
    noise: np.ndarray  # [S, A], stds
    start: np.ndarray  # [S], probabilities


def random_mdp(
    seed: int,
    states: int = 15,  # as many as the grid has, so that both share their programs
    actions: int = 4,
    concentration: float = 0.5,
    spread: float = 0.3,
    noise: float = 1.0,
) -> Mdp:
    """Dirichlet transitions, normally distributed mean rewards, no end of an episode; differs between seeds."""
    generator = np.random.default_rng(seed)
    transition = generator.dirichlet(np.full(states, concentration), (states, actions))
    reward = generator.normal(scale=spread, size=(states, actions))
    return Mdp(
        transition=transition, reward=reward, noise=np.full((states, actions), noise), start=np.full(states, 1 / states)
    )


def bias_chain(seed: int = 0, links: int = 3, actions: int = 8, mean: float = -0.1, noise: float = 1.0) -> Mdp:
    """A chain on which a maximum over noisy values is too high, after Sutton and Barto's example 6.7.

    In state 0 half of the actions end the episode and the others lead to state 1, all without reward. `links` states
    follow (1 in the book); in each, every action has reward N(mean, noise) and leads to the next state, and from the
    last state to the end. Where `mean` is negative, ending at once is best.
    """
    del seed
    transition = np.zeros((links + 1, actions, links + 1))
    transition[0, actions // 2 :, 1] = 1.0
    for state in range(1, links):
        transition[state, :, state + 1] = 1.0
    reward, spread = np.full((links + 1, actions), mean), np.full((links + 1, actions), noise)
    reward[0] = spread[0] = 0.0
    return Mdp(transition=transition, reward=reward, noise=spread, start=np.eye(links + 1)[0])


def grid_world(seed: int = 0, size: int = 4, slip: float = 0.2, step: float = -0.1, noise: float = 1.0) -> Mdp:
    """From one corner of a square to the opposite one, where the episode ends with a reward of 1.

    Four actions; with probability `slip` the direction is random; walls block. All other steps have reward
    N(step, noise).
    """
    del seed
    states, goal = size * size - 1, size * size - 1  # the goal is not a state, because the episode ends there
    transition = np.zeros((states, 4, states))
    reward, spread = np.full((states, 4), step), np.full((states, 4), noise)
    moves = ((-1, 0), (1, 0), (0, -1), (0, 1))
    for state in range(states):
        row, column = divmod(state, size)
        for action in range(4):
            for direction, (down, right) in enumerate(moves):
                chance = slip / 4 + (1 - slip) * (direction == action)
                next_state = min(max(row + down, 0), size - 1) * size + min(max(column + right, 0), size - 1)
                if next_state == goal:
                    reward[state, action] += chance * (1 - step)
                else:
                    transition[state, action, next_state] += chance
    return Mdp(transition=transition, reward=reward, noise=spread, start=np.eye(states)[0])


MDPS: dict[str, Callable[[int], Mdp]] = {"random": random_mdp, "chain": bias_chain, "grid": grid_world}
TITLES = {"random": "random MDPs", "chain": "maximisation-bias chain", "grid": "stochastic grid"}
ABOUT = {
    "random": "random: a different one per seed, 15 states, 4 actions, Dirichlet(0.5) transitions, rewards N(m, 1), "
    "m from N(0, 0.3^2) and a constant added that makes Q* 0 on average",
    "chain": "chain: 3 links after the choice to leave, 8 actions, rewards N(-0.1, 1)",
    "grid": "grid: 4 x 4, slip 0.2, steps N(-0.1, 1), goal +1",
}


def stack(mdps: list[Mdp]) -> Mdp:
    """MDPs of one shape as one `Mdp`, leaves [len(mdps), ...]."""
    return Mdp(*(np.stack(leaves) for leaves in zip(*mdps, strict=True)))


def backup(mdp: Mdp, value: np.ndarray, gamma: float) -> np.ndarray:
    """The value of each action if `value [S]` is the value of the states: [S, A]."""
    return mdp.reward + gamma * mdp.transition @ value


def optimal_q(mdp: Mdp, gamma: float, tolerance: float = 1e-12) -> np.ndarray:
    """Q* [S, A], by value iteration until the error is certainly below `tolerance` or rounding stops it.

    Raises:
      ValueError: `gamma` is not in [0, 1).
    """
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be at least 0 and below 1, not {gamma}")
    q = np.zeros_like(mdp.reward)
    change = np.inf
    while True:
        better = backup(mdp, q.max(axis=1), gamma)
        change, before = np.abs(better - q).max(), change
        q = better
        # The distance to the fixed point is at most gamma / (1 - gamma) times the last change.
        if change * gamma <= tolerance * (1 - gamma) or (change < 1e-9 * (1 + np.abs(q).max()) and change >= before):
            return q


def centred(mdp: Mdp, gamma: float) -> Mdp:
    """The MDP with a constant added to all rewards so that the mean of Q* is 0; unchanged where episodes end.

    Tables that are initialised with zeros then begin without a bias.
    """
    if mdp.transition.sum(axis=-1).min() < 1 - 1e-9:
        return mdp
    return mdp._replace(reward=mdp.reward - (1 - gamma) * optimal_q(mdp, gamma).mean())


def policy_q(mdp: Mdp, policy: np.ndarray, gamma: float) -> np.ndarray:
    """Q [S, A] of the deterministic policy [S], by its linear equations."""
    states = np.arange(len(policy))
    value = np.linalg.solve(np.eye(len(policy)) - gamma * mdp.transition[states, policy], mdp.reward[states, policy])
    return backup(mdp, value, gamma)
