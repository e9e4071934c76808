"""Physics `mujoco`: MuJoCo's C library on the host, called from the compiled program. As in Gymnasium, in float64.

One call makes a control step of all robots of a device (members, environments), on a few threads; the states are passed
to it and back as arrays of 32-bit words. The call is pure: the complete state of a robot, with the solver's warm start,
is in its argument. JAX has no float64 here, so it carries the bits of the float64 numbers as pairs of words.
"""

import copy
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from sqt_jax.envs.physics import Physics, PhysicsState, Setup
from sqt_jax.envs.physics.threads import thread_pool
from sqt_jax.job_limits import usable_cores
from sqt_jax.types import Array

# The parts of MuJoCo's state that are passed, in this order: qpos [nq], qvel [nv], qacc_warmstart [nv], ctrl [nu].
STATE = (
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_CTRL
)

# The quantities that are not zero in a robot without forces.
MOTION = {"cinert", "cvel"}


def make(setup: Setup, num_threads: int | None = None) -> Physics:
    """MuJoCo's C library.

    Args:
      setup: the model, and the quantities that the task needs.
      num_threads: threads that step the robots of a call; None: one for each usable core.

    Raises:
      ValueError: the model has activation states, or `num_threads` is below 1.
    """
    model = setup.model
    if model.na:
        raise ValueError(f"the model: expected no activation states, got {model.na}")
    if num_threads is not None and num_threads < 1:
        raise ValueError(f"num_threads: expected a whole number of at least 1, got {num_threads}")
    stepper = Stepper(setup, num_threads or usable_cores())
    num_places = model.nq + model.nv
    # A header (0: just placed, the words are float32; 1: stepped, they are float64), x of the tracked point, STATE.
    state_words = 1 + 2 * (1 + num_places + model.nv)

    def by_name(quantities: Array) -> dict[str, Array]:
        if not setup.quantities:
            return {}
        return dict(zip(setup.quantities, jnp.split(quantities, stepper.quantity_splits), strict=True))

    def measured_at(words: np.ndarray) -> np.ndarray:
        """Words of positions and velocities [..., nq + nv] -> words of the quantities [..., Q]."""
        rows = np.ascontiguousarray(words).view(np.float32).reshape(-1, num_places)
        return stepper.placed_quantities(rows).view(np.uint32).reshape(*words.shape[:-1], -1)

    measure_on_host = _on_host(measured_at, stepper.num_quantities)

    def placed_quantities(words: Array) -> dict[str, Array]:
        if MOTION.isdisjoint(setup.quantities):
            return by_name(jnp.zeros(stepper.num_quantities))
        return by_name(_floats(measure_on_host(words)))

    def place(qpos: Array, qvel: Array) -> PhysicsState:
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        words = _bits(jnp.concatenate([qpos, qvel]))
        internal = jnp.zeros(state_words, jnp.uint32).at[1 : 1 + num_places].set(words)
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            displacement=jnp.zeros((), jnp.float32),
            quantities=placed_quantities(words),
            internal=internal,
        )

    def stepped(packed: np.ndarray) -> np.ndarray:
        """Words of states and controls [..., W + nu] -> words of states and of the measured numbers [..., W + F]."""
        words = packed.reshape(-1, packed.shape[-1])
        rows = np.empty((len(words), (state_words - 1) // 2 + model.nu))
        rows[:, : -model.nu] = np.ascontiguousarray(words[:, 1:state_words]).view(np.float64)
        rows[:, -model.nu :] = np.ascontiguousarray(words[:, state_words:]).view(np.float32)
        fresh = words[:, 0] == 0
        if fresh.any():
            placed = np.ascontiguousarray(words[fresh, 1 : 1 + num_places]).view(np.float32)
            rows[fresh, : -model.nu] = 0
            rows[fresh, 0] = np.nan  # the stepper computes it
            rows[fresh, 1 : 1 + num_places] = placed
        measured = stepper(rows)
        out = np.empty((len(words), state_words + measured.shape[1]), np.uint32)
        out[:, 0] = 1
        out[:, 1:state_words] = np.ascontiguousarray(rows[:, : -model.nu]).view(np.uint32)
        out[:, state_words:] = measured.view(np.uint32)
        return out.reshape(*packed.shape[:-1], -1)

    step_on_host = _on_host(stepped, state_words + stepper.num_measured)

    def advance(state: PhysicsState, control: Array) -> PhysicsState:
        out = step_on_host(jnp.concatenate([state.internal, _bits(jnp.asarray(control, jnp.float32))]))
        qpos, qvel, displacement, quantities = jnp.split(_floats(out[state_words:]), stepper.splits)
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            displacement=displacement[0],
            quantities=by_name(quantities),
            internal=out[:state_words],
        )

    return Physics(place, advance)


class Stepper:
    """One control step of many robots, on several threads. NumPy only: JAX must not be used inside a callback.

    If no handler for MuJoCo's warnings is set, one that drops them is set: by default, MuJoCo writes a warning about
    each diverged robot to a file in the current directory.
    """

    def __init__(self, setup: Setup, num_threads: int):
        self.setup = setup
        self.num_threads = num_threads
        self.model = copy.copy(setup.model)
        # `__call__` detects a diverged robot by its numbers; MuJoCo would silently put it back to the rest pose.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # The `MjData` that no thread is using. Calls are concurrent if members are on several XLA devices.
        self.idle = [data := mujoco.MjData(self.model)]
        sizes = [getattr(data, name).size for name in setup.quantities]
        self.num_quantities, self.quantity_splits = sum(sizes), np.cumsum(sizes)[:-1].tolist()
        self.splits = np.cumsum([self.model.nq, self.model.nv, 1]).tolist()  # of what `__call__` returns
        self.num_measured = self.splits[-1] + self.num_quantities

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Step `rows` [R, 1 + nq + 2 nv + nu] (x of the tracked point, then STATE) in place.

        Returns:
          [R, F] float32: qpos, qvel, displacement of the tracked point, quantities; NaN for a robot that diverged.
        """
        if mujoco.get_mju_user_warning() is None:
            mujoco.set_mju_user_warning(_ignore_warning)
        measured = np.empty((len(rows), self.num_measured), np.float32)
        _, displacement, first_quantity = self.splits
        numbers = itertools.count()  # the next row to be stepped; `next` is atomic

        def work() -> None:
            try:
                data = self.idle.pop()
            except IndexError:
                data = mujoco.MjData(self.model)
            try:
                for i in numbers:
                    if i >= len(rows):
                        return
                    advance(i, data)
            finally:
                self.idle.append(data)

        def advance(i: int, data: mujoco.MjData) -> None:
            model, row = self.model, rows[i]
            mujoco.mj_setState(model, data, row[1:], STATE)
            before = row[0]
            if np.isnan(before):
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                before = self.tracked(data)
            mujoco.mj_step(model, data, nstep=self.setup.frame_skip)
            mujoco.mj_getState(model, data, row[1:], STATE)
            row[0] = self.tracked(data)
            measured[i, displacement] = row[0] - before
            if self.setup.quantities:
                if "cfrc_ext" in self.setup.quantities:
                    mujoco.mj_rnePostConstraint(model, data)
                measured[i, first_quantity:] = self.quantities(data)

        if len(rows) == 1:
            work()
        else:
            thread_pool(self.num_threads).run(work, min(self.num_threads, len(rows)))
        with np.errstate(over="ignore"):
            measured[:, :displacement] = rows[:, 1 : 1 + displacement]
        stable = np.all(np.abs(rows) < mujoco.mjMAXVAL, axis=1)
        measured[~stable] = np.nan
        return measured

    def placed_quantities(self, rows: np.ndarray) -> np.ndarray:
        """The quantities [R, Q] float32 of robots that were just placed at `rows` [R, nq + nv], without forces."""
        quantities = np.empty((len(rows), self.num_quantities), np.float32)
        # Blank memory: that of robots that have moved holds their forces. A call is rare, so it has one thread.
        model, data = self.model, mujoco.MjData(self.model)
        for i, row in enumerate(rows):
            data.qpos, data.qvel = row[: model.nq], row[model.nq :]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            quantities[i] = self.quantities(data)
        return quantities

    def quantities(self, data: mujoco.MjData) -> np.ndarray:
        """The setup's quantities, one after another: [Q]"""
        return np.concatenate([getattr(data, name).ravel() for name in self.setup.quantities])

    def tracked(self, data: mujoco.MjData) -> float:
        """x of the tracked point, m."""
        return data.qpos[0] if self.setup.tracked is None else self.setup.tracked(self.model, data)


def _ignore_warning(message: str) -> None:
    del message


def _bits(x: Array) -> Array:
    return jax.lax.bitcast_convert_type(x, jnp.uint32)


def _floats(words: Array) -> Array:
    return jax.lax.bitcast_convert_type(words, jnp.float32)


def _on_host(function: Callable[[np.ndarray], np.ndarray], num_words: int) -> Callable[[Array], Array]:
    """A pure NumPy function of words [..., W] -> [..., `num_words`] as a function of JAX arrays [W] -> [`num_words`].

    Under `vmap` all entries go to the host in one call.
    """
    shape = jax.ShapeDtypeStruct((num_words,), jnp.uint32)

    def in_place(context: Any, out: Any, words: Any) -> None:
        del context
        np.asarray(out)[...] = function(np.asarray(words))

    # On a CPU the callback gets the buffers themselves. JAX arrays would be 15 times slower, and may deadlock
    # (https://github.com/jax-ml/jax/issues/24255).
    on_cpu = buffer_callback(in_place, shape, vmap_method="broadcast_all")

    def elsewhere(words: Array) -> Array:
        return jax.pure_callback(lambda words: function(np.asarray(words)), shape, words, vmap_method="broadcast_all")

    def call(words: Array) -> Array:
        return jax.lax.platform_dependent(words, cpu=on_cpu, default=elsewhere)

    return call
