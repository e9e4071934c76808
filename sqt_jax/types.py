"""The few shapes of data that pass between modules.

Letters in shapes: `S` members of a sweep, `E` environments per member, `N` critics, `B` batch, `O` observation,
`A` action; axis order `[S, N, B, ...]`. An interchangeable part (agent, replay, environment) is a NamedTuple of pure
functions over an explicit state, in the manner of `optax.GradientTransformation`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array
Params = Any  # a pytree of arrays
State = Any  # a pytree of arrays that only its owner looks into, but for what `Agent` says
Metrics = dict[str, Array]  # scalars by name


class Transition(NamedTuple):
    """One environment step, or a batch of them with leading axes.

    `discount` is 0 where the episode terminated and 1 elsewhere (also where it was truncated: the value of
    `next_obs` is then bootstrapped); the discount factor itself is the setting `gamma`. `next_obs` is the true next
    observation, never the first one of the following episode.
    """

    obs: Array  # [..., O]
    action: Array  # [..., A], in [-1, 1]
    reward: Array  # [...]
    next_obs: Array  # [..., O]
    discount: Array  # [...], 0 or 1


class TimeStep(NamedTuple):
    """What an environment gives after `reset` or `step`.

    When an episode ends (`terminated` or `truncated`), `obs` is already the first observation of the next episode,
    `final_obs` the last one of the episode that ended. Elsewhere `final_obs` equals `obs`.
    """

    state: State  # physics, the episode's step counter and the key of the next start
    obs: Array  # [O]
    reward: Array  # []
    terminated: Array  # [] bool: the task ended the episode; there is no value beyond
    truncated: Array  # [] bool: the time limit ended it; the value beyond is bootstrapped
    final_obs: Array  # [O]


class Environment(NamedTuple):
    """A task as pure functions of one environment; `vmap` gives many.

    `step` expects actions in [-1, 1] and starts a new episode by itself, with a new random start each time.
    """

    name: str
    observation_size: int
    action_size: int
    episode_length: int  # steps until truncation
    reset: Callable[[Array], TimeStep]  # key -> first time step
    step: Callable[[TimeStep, Array], TimeStep]  # (time step, action [A]) -> next time step
    set_physics: Callable[[Array, Array], TimeStep] | None = None  # (qpos, qvel) -> time step there
    status: Callable[[TimeStep], Metrics] = lambda timestep: {}  # counts worth reporting, summed over environments
    # Memory hint: a lower bound on the mean episode length, in steps. 1 is always safe; larger values let the replay
    # allocate less (`Ring`).
    min_mean_episode_length: int = 1
    speed: Callable[[TimeStep], Array] | None = (
        None  # -> [], forward speed in m/s of the step to this time step, if any
    )


class Agent(NamedTuple):
    """An algorithm as pure functions of one member; `vmap` gives a sweep.

    `update(state, batch, key)` is `update_with_noise(state, batch, draw_noise(key, batch))`: every random number of
    an update is in the `noise`, so that a test can pass its own.

    What the train loop reads of an agent's state, so that one of your own needs it too: `scalars.gamma`, `diverged` []
    bool, and `gradient_steps` [] int32 (equal in all members, by that name: `members.SHARED_LEAVES`).

    `td_error` is the largest |TD error| over the critics before the step, 0 once the agent has diverged. Metrics are []
    each, NaN where this update did not measure them (`actor_loss` in an update without the actor's step).
    """

    init: Callable[..., State]  # (key, scalars=None) -> state
    act: Callable[..., Array]  # (state, obs [B, O], key, deterministic=False) -> action [B, A]
    update: Callable[[State, Transition, Array], tuple[State, Array, Metrics]]  # -> (state, td_error [B], metrics)
    draw_noise: Callable[[Array, Transition], Any]  # (key, batch) -> noise
    update_with_noise: Callable[[State, Transition, Any], tuple[State, Array, Metrics]]
    # (state, batch, noise) -> [B], and its terms by name: penalty [] or [B]; next_log_prob [B] with an entropy term
    td_target: Callable[[State, Transition, Any], tuple[Array, dict[str, Array]]]
    policy: Callable[[State], Params]  # state -> what deterministic acting needs of it
    policy_action: Callable[[Params, Array], Array]  # (policy, obs [B, O]) -> action [B, A]
    q_values: Callable[[State, Array, Array], Array]  # (state, obs [B, O], action [B, A]) -> [N, B], the critics
    # The policy whose values the critics estimate, where that samples: (state, obs [B, O], key) -> action [B, A] and
    # its entropy bonus [B].
    valued_act: Callable[[State, Array, Array], tuple[Array, Array]] | None = None
    # After each step of the environments: (state, returns of the running episodes [E], which of them ended [E] bool) ->
    # state. TD7 assesses policies by it, and never acts otherwise than at the start without it.
    observe: Callable[[State, Array, Array], State] = lambda state, episode_return, ended: state
    status: Callable[[State], Metrics] = lambda state: {}  # what is worth reporting of a state


class Replay(NamedTuple):
    """A store of transitions as pure functions of one member's state.

    The k-th transition ever inserted lies in row k mod `capacity`. What was inserted stays as it is until it is
    overwritten, so that checkpoints write each row once.
    """

    capacity: int
    init: Callable[[], State]
    insert: Callable[[State, Transition], State]  # E new transitions at once
    # (state, key) -> B transitions, their rows [B]; something has to be there (`size`), else they are all zeros
    sample: Callable[[State, Array], tuple[Transition, Array]]
    # (state, rows [B], td_error [B] as `Agent.update` gives it, gradient_steps) -> state
    feedback: Callable[[State, Array, Array, Array], State]
    size: Callable[[State], Array]  # state -> [] int32: the newest transitions that are all there
    rows: Callable[[State, Array | int, int], Array]  # (state, first, count) -> rows to keep on disk [count, floats]
    with_rows: Callable[[State, Array, Array | int], State]  # (state, such rows, first) -> state: they are back
    without_rows: Callable[[State], State]  # state -> what else is to be kept: None for the arrays of the rows


class Scalars(NamedTuple):
    """Settings that are traced, so that a sweep over their values compiles once.

    Traced values cannot be checked, and an algorithm ignores those that it has no use for; `make_config` refuses both.
    """

    penalty_coef: Array | float  # of the variants with a penalty
    lr: Array | float
    gamma: Array | float
    tau: Array | float  # of soft target updates: not with SALE networks (td7)
    temperature: Array | float  # SAC's; the start value where it is learned

    def as_arrays(self) -> "Scalars":
        return Scalars(*(jnp.asarray(value, jnp.float32) for value in self))
