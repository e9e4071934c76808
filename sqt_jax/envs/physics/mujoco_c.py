"""MuJoCo's C library on the host, called from inside the compiled program: what Gymnasium computes, in float64.

A control step of all robots of a device (members, environments) is one call: their states go out and come back as one
array of 32-bit words each, and a few threads work them off. The call is pure: a robot's whole state (the solver's warm
start included) is in what it is given, carried through JAX, which has no float64 here, as the bits of float64 numbers.
"""

import copy
import itertools
import os
import queue
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from sqt_jax.cores import usable_cores
from sqt_jax.envs.physics import Physics, PhysicsState, Setup
from sqt_jax.types import Array

# What of MuJoCo's state goes in and comes out, in this order: qpos [nq], qvel [nv], qacc_warmstart [nv], ctrl [nu].
STATE = (
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_CTRL
)


def make(setup: Setup, num_threads: int | None = None) -> Physics:
    """MuJoCo's C library.

    Args:
      num_threads: threads that step the robots of a call; None is one for each core that the process may use.

    Raises:
      ValueError: the model has activation states, or there is no thread.
    """
    model = setup.model
    if model.na:
        raise ValueError(f"{model.na} activation states: only models with none")
    if num_threads is not None and num_threads < 1:
        raise ValueError(f"num_threads expects at least 1, not {num_threads}")
    placed_quantities = _placed_quantities(setup)
    stepper = Stepper(setup, num_threads or usable_cores())
    num_places = model.nq + model.nv
    # a header (0: just placed, the words are float32; 1: stepped, they are float64), x of the tracked point, STATE
    state_words = 1 + 2 * (1 + num_places + model.nv)

    def place(qpos: Array, qvel: Array) -> PhysicsState:
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        words = _bits(jnp.concatenate([qpos, qvel]))
        internal = jnp.zeros(state_words, jnp.uint32).at[1 : 1 + num_places].set(words)
        quantities = placed_quantities(qpos, qvel)
        return PhysicsState(qpos, qvel, jnp.zeros((), jnp.float32), quantities, internal)

    def host(packed: np.ndarray) -> np.ndarray:
        """Words of states and controls [..., W + nu] -> words of states and of the numbers `advance` takes apart."""
        words = packed.reshape(-1, packed.shape[-1])
        rows = np.empty((len(words), (state_words - 1) // 2 + model.nu))
        rows[:, : -model.nu] = np.ascontiguousarray(words[:, 1:state_words]).view(np.float64)
        rows[:, -model.nu :] = np.ascontiguousarray(words[:, state_words:]).view(np.float32)
        fresh = words[:, 0] == 0
        if fresh.any():
            placed = np.ascontiguousarray(words[fresh, 1 : 1 + num_places]).view(np.float32)
            rows[fresh, : -model.nu] = 0
            rows[fresh, 0] = np.nan  # the stepper measures it
            rows[fresh, 1 : 1 + num_places] = placed
        measured = stepper(rows)
        out = np.empty((len(words), state_words + measured.shape[1]), np.uint32)
        out[:, 0] = 1
        out[:, 1:state_words] = np.ascontiguousarray(rows[:, : -model.nu]).view(np.uint32)
        out[:, state_words:] = measured.view(np.uint32)
        return out.reshape(*packed.shape[:-1], -1)

    def host_in_place(context: Any, out: Any, packed: Any) -> None:
        del context
        np.asarray(out)[...] = host(np.asarray(packed))

    shape = jax.ShapeDtypeStruct((state_words + stepper.num_measured,), jnp.uint32)
    # On CPU the buffers themselves, without a detour by JAX's arrays, which would cost 15 times the time and may
    # deadlock (https://github.com/jax-ml/jax/issues/24255).
    on_cpu = buffer_callback(host_in_place, shape, vmap_method="broadcast_all")

    def elsewhere(packed: Array) -> Array:
        return jax.pure_callback(lambda words: host(np.asarray(words)), shape, packed, vmap_method="broadcast_all")

    def advance(state: PhysicsState, control: Array) -> PhysicsState:
        packed = jnp.concatenate([state.internal, _bits(jnp.asarray(control, jnp.float32))])
        out = jax.lax.platform_dependent(packed, cpu=on_cpu, default=elsewhere)
        measured = jax.lax.bitcast_convert_type(out[state_words:], jnp.float32)
        qpos, qvel, displacement, *quantities = jnp.split(measured, stepper.splits)
        return PhysicsState(
            qpos, qvel, displacement[0], dict(zip(setup.quantities, quantities, strict=True)), out[:state_words]
        )

    return Physics(place, advance)


class Stepper:
    """A control step of many robots, on several threads. NumPy only: nothing of JAX may run inside a callback.

    Where nobody has set a handler of MuJoCo's warnings, one is set that drops them: MuJoCo would write of diverged
    robots into a file in the current directory.
    """

    def __init__(self, setup: Setup, num_threads: int):
        self.setup = setup
        self.num_threads = num_threads
        self.model = copy.copy(setup.model)
        # A diverged robot is told by its numbers; MuJoCo would put it back to the start and go on.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # Those that no thread is at work on. Calls come side by side where members lie on several XLA devices.
        self.idle = [data := mujoco.MjData(self.model)]
        sizes = [self.model.nq, self.model.nv, 1] + [getattr(data, name).size for name in setup.quantities]
        self.num_measured = sum(sizes)
        self.splits = np.cumsum(sizes)[:-1].tolist()

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Steps `rows` [R, 1 + nq + 2 nv + nu] (x of the tracked point, then STATE) in place.

        Returns:
          [R, F] float32: qpos, qvel, the tracked point's displacement, the quantities; NaN where the robot diverged.
        """
        if mujoco.get_mju_user_warning() is None:
            mujoco.set_mju_user_warning(_be_quiet)
        measured = np.empty((len(rows), self.num_measured), np.float32)
        displacement, first_quantity = self.splits[1], self.splits[1] + 1
        numbers = itertools.count()  # of the next row that no thread has taken; its steps are atomic

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
                fields = [getattr(data, name).ravel() for name in self.setup.quantities]
                measured[i, first_quantity:] = np.concatenate(fields)

        if len(rows) == 1:
            work()
        else:
            _threads(self.num_threads).run(work, min(self.num_threads, len(rows)))
        with np.errstate(over="ignore"):
            measured[:, :displacement] = rows[:, 1 : 1 + displacement]
        stable = np.all(np.abs(rows) < mujoco.mjMAXVAL, axis=1)
        measured[~stable] = np.nan
        return measured

    def tracked(self, data: mujoco.MjData) -> float:
        return data.qpos[0] if self.setup.tracked is None else self.setup.tracked(self.model, data)


class _Threads:
    """The caller and a few threads beside it that wait for work: one call at a time."""

    def __init__(self, num_threads: int):
        self.lock = threading.Lock()
        self.todo: list[queue.SimpleQueue] = [queue.SimpleQueue() for _ in range(num_threads - 1)]
        for number, todo in enumerate(self.todo, start=1):
            threading.Thread(target=_serve, args=(todo,), daemon=True, name=f"mujoco-{number}").start()

    def run(self, work: Callable[[], None], num_threads: int) -> None:
        """Runs `work()` here and on `num_threads - 1` others; raises the first of their errors when all have ended.

        An interrupt (Ctrl-C) waits for them too: they write into memory that the next call uses.
        """
        with self.lock:
            done: queue.SimpleQueue = queue.SimpleQueue()
            helpers = self.todo[: num_threads - 1]
            for todo in helpers:
                todo.put((work, done))
            errors = [_error_of(work)]
            running = len(helpers)
            while running:
                try:
                    errors.append(done.get())
                    running -= 1
                except BaseException as interrupt:
                    errors.append(interrupt)
        for error in errors:
            if error is not None:
                raise error


def _serve(todo: queue.SimpleQueue) -> None:
    while True:
        work, done = todo.get()
        done.put(_error_of(work))


def _error_of(work: Callable[[], None]) -> BaseException | None:
    try:
        work()
    except BaseException as error:
        return error
    return None


_pools: dict[tuple[int, int], _Threads] = {}
_pools_lock = threading.Lock()


def _threads(num_threads: int) -> _Threads:
    """The one pool of this size in this process: a forked child has none of its parent's threads."""
    key = (os.getpid(), num_threads)
    with _pools_lock:
        if key not in _pools:
            _pools[key] = _Threads(num_threads)
        return _pools[key]


def _be_quiet(message: str) -> None:
    del message


def _bits(x: Array) -> Array:
    return jax.lax.bitcast_convert_type(x, jnp.uint32)


def _placed_quantities(setup: Setup) -> Callable[[Array, Array], dict[str, Array]]:
    """(qpos, qvel) -> the quantities of a robot that was just placed there.

    By MJX: a call to the host for every possible start would cost more than the few kinematics of it, which are exact
    to float32.
    """
    if not setup.quantities:
        return lambda qpos, qvel: {}
    from sqt_jax.envs.physics import mjx

    place = mjx.make(setup).place
    return lambda qpos, qvel: place(qpos, qvel).quantities
