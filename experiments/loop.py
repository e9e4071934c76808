"""The host loop: chunks of compiled training between evaluations, and what they report.

Everything the loop needs is a value: the compiled sweep, a display, a function that takes reports, one that says
whether to stop. It writes no files.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.progress import Display, Status, eta_seconds
from sqt_jax.config import TrainConfig
from sqt_jax.train import Sweep, TrainState, evaluation_steps, new_interval

# How long one call into the compiled program may take: the display and Ctrl-C wait for it.
CHUNK_SECONDS = 2.0


class Report(NamedTuple):
    """What the loop knows at an evaluation, or where it was stopped; arrays have the members first."""

    env_steps: int
    gradient_steps: int
    wall_seconds: float  # since the loop began
    metrics: dict[str, np.ndarray]  # name -> [S], of the steps since the last report; empty at step 0
    returns: np.ndarray | None  # [S, episodes]; None where there was no evaluation
    lengths: np.ndarray | None  # [S, episodes]


class Outcome(NamedTuple):
    state: TrainState
    env_steps: int
    interrupted: bool
    diverged: dict[int, int]  # member -> environment steps at which it was found
    wall_seconds: float
    train_seconds: float  # without compilation
    steps_per_second: float | None  # of all members together, without compilation; None before the second chunk


class Pace:
    """How long things take, without compilation: the length of the next chunk and the time left follow from it.

    Warm-up and learning differ in speed and are timed apart, by the key `learn`.
    """

    def __init__(self) -> None:
        self.compiled = False
        self.rates: dict[bool, float] = {}  # lockstep steps per second, lately
        self.steps = 0  # lockstep steps timed so far
        self.train_seconds = 0.0  # that they took
        self.evaluations = 0
        self.evaluate_seconds = 0.0  # of all but the first, which compiles

    def chunk(self, learn: bool, limit: int) -> int:
        """Lockstep steps for the next call: about `CHUNK_SECONDS`, and one where the call has to compile."""
        if not self.compiled:
            return 1
        rate = self.rates.get(learn)
        return min(limit, 10 if rate is None else max(1, int(rate * CHUNK_SECONDS)))

    def advanced(self, learn: bool, steps: int, seconds: float) -> None:
        if self.compiled:
            rate = steps / max(seconds, 1e-9)
            self.rates[learn] = 0.7 * self.rates.get(learn, rate) + 0.3 * rate  # steady enough to be read
            self.steps += steps
            self.train_seconds += seconds
        self.compiled = True

    def evaluated(self, seconds: float) -> None:
        if self.evaluations:
            self.evaluate_seconds += seconds
        self.evaluations += 1

    def eta(self, done: int, train: TrainConfig) -> float | None:
        warmup_left = max(0, min(train.warmup_steps, train.steps) - done)
        return eta_seconds(
            steps_left={False: warmup_left, True: train.steps - done - warmup_left},
            steps_per_second={learn: rate * train.num_envs for learn, rate in self.rates.items()},
            evaluations_left=len(evaluation_steps(train)) - self.evaluations,
            seconds_per_evaluation=self.evaluate_seconds / (self.evaluations - 1) if self.evaluations > 1 else None,
        )


@partial(jax.jit, static_argnums=1)
def _finite(tree: Any, num_members: int) -> jax.Array:
    """[S] bool: whether all of a member's own floating-point numbers are finite."""
    ok = jnp.ones(num_members, bool)
    for leaf in jax.tree.leaves(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.ndim:
            ok &= jnp.all(jnp.isfinite(leaf.reshape(num_members, -1)), axis=1)
    return ok


def train_loop(
    sweep: Sweep,
    state: TrainState,
    train: TrainConfig,
    num_members: int,
    *,
    report: Callable[[Report], None],
    display: Display,
    stop: Callable[[], bool],
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Train a fresh `state` to `train.steps`, with an evaluation at step 0, every `eval_every` and at the end.

    Advances in chunks that end at the evaluations and at the end of the warm-up. `stop` is asked between chunks;
    once it says True, what there is is reported and the loop returns.
    """
    began = clock()
    pace = Pace()
    diverged: dict[int, int] = {}
    done = 0
    last_point = 0  # where the interval began
    interrupted = False
    last_return: float | None = None

    def show(phase: str, learn: bool) -> None:
        rate = pace.rates[learn] * train.num_envs * num_members if learn in pace.rates else None
        display.update(Status(phase, done, rate, pace.eta(done, train), last_return))

    def evaluate_and_report(metrics: dict[str, np.ndarray]) -> None:
        nonlocal last_return
        show("evaluating" if pace.evaluations else "compiling the evaluation", done >= train.warmup_steps)
        start = clock()
        evaluation = sweep.evaluate(state)
        returns, lengths = np.asarray(evaluation.returns), np.asarray(evaluation.lengths)
        pace.evaluated(clock() - start)
        bad = find_diverged(metrics, returns)
        # An environment takes a NaN action as the end of the episode: what a diverged member returns says nothing.
        returns = np.where(bad[:, None], np.nan, returns)
        if not bad.all():
            last_return = float(np.nanmean(returns))
        send(metrics, returns, lengths)
        display.evaluated(done, returns[~bad].mean(axis=1))

    def find_diverged(metrics: dict[str, np.ndarray], returns: np.ndarray | None) -> np.ndarray:
        """[S] bool; members that were not known to be are announced."""
        # NaN metrics are those not measured; a NaN loss is seen in the parameters it made.
        bad = ~np.asarray(_finite(state.agent, num_members))
        bad |= np.any([np.isinf(values) for values in metrics.values()], axis=0)
        if returns is not None:
            bad |= ~np.isfinite(returns).all(axis=1)
        for member in (int(index) for index in np.flatnonzero(bad)):
            if member not in diverged:
                diverged[member] = done
                display.message(f"member {member} diverged: not all its numbers are finite at step {done:,}")
        return bad

    def send(metrics: dict[str, np.ndarray], returns: np.ndarray | None, lengths: np.ndarray | None) -> None:
        report(Report(done, int(state.agent.gradient_steps), clock() - began, metrics, returns, lengths))

    def measured() -> dict[str, np.ndarray]:
        """What the state tells of the interval; nothing before the first step."""
        return {name: np.asarray(value) for name, value in sweep.measure(state).items()} if done else {}

    for point in evaluation_steps(train):
        state = new_interval(state)
        while done < point and not stop():
            learn = done >= train.warmup_steps
            end = point if learn else min(point, train.warmup_steps)
            steps = pace.chunk(learn, (end - done) // train.num_envs)
            show(("training" if learn else "warm-up") if pace.compiled else "compiling the training", learn)
            start = clock()
            state = sweep.advance(state, steps, learn)
            jax.block_until_ready(state.env_steps)
            pace.advanced(learn, steps, clock() - start)
            done += steps * train.num_envs
        if stop():
            interrupted = True
            if done > last_point:
                find_diverged(measured(), None)
                send(measured(), None, None)
            break
        evaluate_and_report(measured())
        last_point = point

    timed = pace.steps * train.num_envs * num_members
    rate = timed / pace.train_seconds if pace.train_seconds else None
    return Outcome(state, done, interrupted, diverged, clock() - began, pace.train_seconds, rate)
