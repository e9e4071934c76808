"""The data that pass between modules, and the interfaces of agents, environments and replays.

Letters in shapes: `S` members of a sweep, `E` environments per member, `N` critics, `B` batch, `O` observation,
`A` action; axis order `[S, N, B, ...]`. An interchangeable part (agent, replay, environment) is a NamedTuple of pure
functions over an explicit state, as in `optax.GradientTransformation`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

Array = jax.Array
Params = Any  # a pytree of arrays
State = Any  # a pytree of arrays that only its owner reads
Metrics = dict[str, Array]  # scalars by name


def not_measured() -> Array:
    """The value of a metric that an update did not measure: NaN, [] float32."""
    return jnp.full((), jnp.nan)


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
    """The result of an environment's `reset` and `step`.

    When an episode ends (`terminated` or `truncated`), `state` and `obs` are already those of the next episode,
    `final_obs` is the last observation of the episode that ended. Elsewhere `final_obs` equals `obs`.
    """

    state: State  # physics, the episode's step counter and the key of the next start
    obs: Array  # [O]
    reward: Array  # []
    terminated: Array  # [] bool: the task ended the episode; there is no value beyond
    truncated: Array  # [] bool: the time limit ended it; the value beyond is bootstrapped
    final_obs: Array  # [O]


class Environment(NamedTuple):
    """A task as pure functions of one environment; `vmap` gives many. `envs.autoreset.make_environment` makes one.

    `step` expects actions in [-1, 1]. It starts the next episode itself, with a new random start each time.
    """

    name: str
    observation_size: int
    action_size: int
    episode_length: int  # steps until truncation
    reset: Callable[[Array], TimeStep]  # key -> first time step
    step: Callable[[TimeStep, Array], TimeStep]  # (time step, action [A]) -> next time step
    set_physics: Callable[[Array, Array], TimeStep] | None = None  # (qpos, qvel) -> time step in that state
    status: Callable[[TimeStep], Metrics] = lambda timestep: {}  # counts to report, summed over environments
    # A lower bound on the mean episode length. 1 is always safe; a larger one saves memory in the replay (`Ring`).
    min_mean_episode_length: int = 1
    # Forward speed in m/s of the step that led to this time step; None: the environment does not measure it.
    speed: Callable[[TimeStep], Array] | None = None
    version: str = ""  # the package that it comes from and its version, where other packages' versions do not say it
    # Of an environment whose episodes are on the host, outside the compiled program (Gymnasium's); None: it is pure.
    host: "Host | None" = None


class HostError(NamedTuple):
    """An exception of an environment on the host."""

    text: str  # one line: its type and message
    traceback: str


class Host(NamedTuple):
    """What training needs of an environment on the host (`envs.host`).

    Its `reset` and `step` play the running episodes of this one object: one batch of episodes at a time, and each step
    has to follow the newest one.
    """

    restart: Callable[[TimeStep], TimeStep]  # a saved time step -> the start of a new episode, with its key and counts
    failed: Callable[[TimeStep], Array]  # [] bool: an environment has raised an exception, the numbers mean nothing
    error: Callable[[], HostError | None]  # the exception, also of a separate one; None: there was none
    separate: Callable[[], "Environment"]  # the same environment with episodes of its own
    close: Callable[[], None]  # closes the environments and processes of all of these
    processes: int  # that share the environments; 0: they are in this process
    make: Callable[..., Any]  # (further keyword arguments, as render_mode="rgb_array") -> one environment


class Scalars(NamedTuple):
    """The settings that are traced: a sweep over their values compiles once.

    Traced values cannot be checked; `make_config` with each of them is the check. An algorithm ignores those that it
    does not use.
    """

    penalty_coef: Array | float  # the paper's alpha: of algorithms with a penalty
    lr: Array | float
    gamma: Array | float
    tau: Array | float  # of soft target updates: not with SALE networks (td7)
    temperature: Array | float  # SAC's; its start where it is learned

    def as_arrays(self) -> "Scalars":
        """The same values as float32 arrays []."""
        return Scalars(*(jnp.asarray(value, jnp.float32) for value in self))


class Init(Protocol):
    """`Agent.init`."""

    def __call__(self, key: Array, scalars: Scalars | None = None) -> State:
        """A new agent.

        `scalars` replace the traced settings of the agent's configuration. The state must have `scalars.gamma` [] and
        `diverged` [] bool, which the training program reads; everything else is the agent's own.
        """


class Act(Protocol):
    """`Agent.act`."""

    def __call__(self, state: State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        """Actions [B, A] in [-1, 1] for obs [B, O]: exploring ones, or those of the policy that is evaluated."""


class Update(Protocol):
    """`Agent.update`."""

    def __call__(self, state: State, batch: Transition, key: Array, step: Array) -> tuple[State, Array, Metrics]:
        """One update of all networks that are due.

        Args:
          batch: B transitions.
          key: used once.
          step: [] int32, the number of updates done before. Members of a sweep share it: do not map it under `vmap`,
            else the conditions on it (delayed actor, hard copies) compute both branches.

        Returns:
          The state; td_error [B], the largest |Q_i - td_target| over the critics before the update (0 once the agent
          has diverged); metrics, [] each, NaN where this update did not measure them.
        """


class Observe(Protocol):
    """`Agent.observe`."""

    def __call__(self, state: State, episode_return: Array, ended: Array, step: Array) -> State:
        """Reports the progress of the agent's episodes; called after each environment step.

        Only TD7 uses it, for its policy checkpoints. Without it TD7 keeps acting with its initial policy.

        Args:
          episode_return: [E], undiscounted, of the running episodes up to this step.
          ended: [E] bool, the episodes that ended with this step.
          step: [] int32, the number of updates done so far.
        """


class See(Protocol):
    """`Agent.see`."""

    def __call__(self, state: State, obs: Array) -> State:
        """Reports the observations [E, O] that the behaviour acts on; called once per environment step, before `act`.

        Only agents with `normalize_observations` use it, for their statistics. Without it they only clip observations.
        """


class Views(NamedTuple):
    """Read-only functions of an agent's state: for evaluation, for records, for saving a policy."""

    policy: Callable[[State], Params]  # state -> the parameters that the deterministic policy needs
    policy_action: Callable[[Params, Array], Array]  # (policy, obs [B, O]) -> action [B, A]
    q_values: Callable[[State, Array, Array], Array]  # (state, obs [B, O], action [B, A]) -> the critics' [N, B]
    # The stochastic policy whose values the critics estimate, if it is not the deterministic one:
    # (state, obs [B, O], key) -> action [B, A], entropy bonus [B].
    sample: Callable[[State, Array, Array], tuple[Array, Array]] | None = None
    status: Callable[[State], Metrics] = lambda state: {}  # metrics of the state itself


class Agent(NamedTuple):
    """An algorithm as pure functions of one member; `vmap` gives a sweep."""

    init: Init
    act: Act
    update: Update
    views: Views
    observe: Observe = lambda state, episode_return, ended, step: state
    see: See = lambda state, obs: state


class Parts(NamedTuple):
    """An agent, and the pieces of its update, which tests call with random draws of their own.

    `agent.update(state, batch, key, step)` is `update(state, batch, draw(key, batch), step)`.
    """

    agent: Agent
    draw: Callable[[Array, Transition], Any]  # (key, batch) -> every random number of an update
    update: Callable[[State, Transition, Any, Array], tuple[State, Array, Metrics]]  # (state, batch, draws, step)
    # (state, batch, draws) -> td_target [B], and its terms by name: penalty [] or [B], next_log_prob [B] of SAC
    td_target: Callable[[State, Transition, Any], tuple[Array, dict[str, Array]]]


def assemble(init: Init, act: Act, draw: Any, update: Any, td_target: Any, views: Views, **more: Any) -> Parts:
    """`Parts` whose agent draws its own numbers; `more` are further fields of `Agent`."""

    def update_with_key(state: State, batch: Transition, key: Array, step: Array) -> tuple[State, Array, Metrics]:
        return update(state, batch, draw(key, batch), step)

    agent = Agent(init=init, act=act, update=update_with_key, views=views, **more)
    return Parts(agent=agent, draw=draw, update=update, td_target=td_target)


class Replay(NamedTuple):
    """A store of transitions as pure functions of one member's state.

    The k-th transition ever inserted is in row k mod `capacity`. A row does not change until it is overwritten, so
    checkpoints write each row once.
    """

    capacity: int
    init: Callable[[], State]
    insert: Callable[[State, Transition], State]  # E new transitions at once
    # (state, key) -> B transitions, their rows [B]. An empty replay (`size`) gives zeros.
    sample: Callable[[State, Array], tuple[Transition, Array]]
    # (state, rows [B], td_error [B] as `Agent.update` returns it, updates done so far [] int32) -> state
    feedback: Callable[[State, Array, Array, Array], State]
    size: Callable[[State], Array]  # state -> [] int32: how many of the newest transitions are complete
    rows: Callable[[State, Array | int, int], Array]  # (state, first, count) -> rows for a checkpoint [count, floats]
    with_rows: Callable[[State, Array, Array | int], State]  # (state, saved rows, first) -> state with them
    without_rows: Callable[[State], State]  # state -> the same with None in place of the arrays that `rows` covers
    # A prefix tree of the state for `vmap`: 0, or None for leaves that members share (they insert in lockstep).
    member_axes: Any = 0
