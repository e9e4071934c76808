"""Physics `mjx`: MuJoCo XLA, in JAX, compiled together with the agent (https://mujoco.readthedocs.io/en/stable/mjx.html).

The state carried from step to step is small (positions, velocities, the solver's warm start, observed quantities),
because an auto-reset selects between two states: MJX's large `Data` is made again inside each step.
"""

import contextlib
import copy
import io
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints there that the package warp is missing
    from mujoco import mjx

from sqt_jax.envs.physics import Physics, PhysicsState, Setup
from sqt_jax.types import Array

# The classical Runge-Kutta method: the times of its four stages, and their weights.
_RK4_STAGE = np.array([0, 1 / 2, 1 / 2, 1], np.float32)
_RK4_WEIGHT = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], np.float32)

PRIVATE = ("cinert", "cfrc_ext")  # quantities that MJX 3.17 keeps under `data._impl`


def make(setup: Setup, iterations: int | None = 8, ls_iterations: int | None = 8) -> Physics:
    """MJX with Newton's method (the humanoid's file specifies PGS, which MJX does not have).

    Args:
      setup: the model, and the quantities that the task needs.
      iterations: maximum steps of the constraint solver; None: the model file's. A control step with 8 is as close to
        MuJoCo's as one with 100; some tasks need fewer (`Task.options`).
      ls_iterations: maximum steps of its line search; None: the model file's. Under `vmap` all of them are computed.

    Raises:
      ValueError: the model has activation states, or an integrator other than Euler and RK4; a limit below 1.
    """
    host_model = newton_model(setup.model, iterations, ls_iterations)
    model = mjx.put_model(host_model, impl="jax")
    # Without implicit damping, an Euler step with zero acceleration only moves the positions along the velocities.
    host_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    drift_model = mjx.put_model(host_model, impl="jax")

    tracked = setup.tracked or (lambda model, data: data.qpos[0])

    def position(state: PhysicsState) -> Array:
        return state.qpos[0] if setup.tracked is None else state.internal[0]

    def data_at(qpos: Array, qvel: Array) -> mjx.Data:
        return mjx.make_data(host_model, impl="jax").replace(qpos=qpos, qvel=qvel)

    def quantities(data: mjx.Data) -> dict[str, Array]:
        names = setup.quantities
        return {name: getattr(data._impl if name in PRIVATE else data, name).reshape(-1) for name in names}

    def forward(state: PhysicsState, qpos: Array, qvel: Array, control: Array) -> tuple[mjx.Data, PhysicsState]:
        """Evaluate the dynamics at (qpos, qvel); the returned state has its quantities, but has not moved."""
        _, warm_start = state.internal
        data = _forward(model, data_at(qpos, qvel).replace(ctrl=control, qacc_warmstart=warm_start))
        if "cfrc_ext" in setup.quantities:
            data = mjx.rne_postconstraint(model, data)
        return data, state._replace(quantities=quantities(data), internal=(tracked(model, data), warm_start))

    def move(qpos: Array, qvel: Array) -> Array:
        return mjx.euler(drift_model, data_at(qpos, qvel)).qpos

    def euler(state: PhysicsState, control: Array) -> PhysicsState:
        data, state = forward(state, state.qpos, state.qvel, control)
        data = mjx.euler(model, data)
        return state._replace(qpos=data.qpos, qvel=data.qvel, internal=(state.internal[0], data.qacc_warmstart))

    def rk4(state: PhysicsState, control: Array) -> PhysicsState:
        # The same as mjx.rungekutta4, which unrolls the four stages: that doubles the compile time.
        qpos, qvel = state.qpos, state.qvel

        def stage(i: Array, carry: tuple) -> tuple:
            state, velocity, acceleration, mean_velocity, mean_acceleration = carry
            part, weight = jnp.asarray(_RK4_STAGE)[i], jnp.asarray(_RK4_WEIGHT)[i]
            at = jnp.where(i == 0, qpos, move(qpos, part * velocity))  # even a move of 0 would normalise quaternions
            velocity = qvel + part * acceleration * model.opt.timestep
            data, state = forward(state, at, velocity, control)
            mean_velocity += weight * velocity
            mean_acceleration += weight * data.qacc
            return state, velocity, data.qacc, mean_velocity, mean_acceleration

        zero = 0.0 * qvel  # not `zeros_like`: without the batch axes of qvel, `vmap` traces the loop twice
        state, _, last, velocity, acceleration = jax.lax.fori_loop(0, 4, stage, (state, zero, zero, zero, zero))
        return state._replace(
            qpos=move(qpos, velocity),
            qvel=qvel + acceleration * model.opt.timestep,
            internal=(state.internal[0], last),
        )

    substep = rk4 if host_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else euler

    def place(qpos: Array, qvel: Array) -> PhysicsState:
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        with numerics():
            # The part of `mjx.forward` that the quantities need; forces are zero before the first step.
            data = mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data_at(qpos, qvel))))
            internal = (tracked(model, data), jnp.zeros(host_model.nv, jnp.float32))
            return PhysicsState(
                qpos=qpos,
                qvel=qvel,
                displacement=jnp.zeros((), jnp.float32),
                quantities=quantities(data),
                internal=internal,
            )

    def advance(state: PhysicsState, control: Array) -> PhysicsState:
        control = jnp.asarray(control, jnp.float32)
        before = position(state)
        with numerics():
            state = jax.lax.fori_loop(0, setup.frame_skip, lambda _, state: substep(state, control), state)
        return state._replace(displacement=position(state) - before)

    return Physics(place, advance)


def newton_model(model: mujoco.MjModel, iterations: int | None, ls_iterations: int | None) -> mujoco.MjModel:
    """A copy of the model, set to Newton's method with these maximum steps (None: the model's own).

    Raises:
      ValueError: the model has activation states, or an integrator other than Euler and RK4; a limit below 1.
    """
    for name, limit in {"iterations": iterations, "ls_iterations": ls_iterations}.items():
        if limit is not None and limit < 1:
            raise ValueError(
                f"{name}: expected a whole number of at least 1, or None for the model file's, got {limit}"
            )
    model = copy.copy(model)
    integrator = mujoco.mjtIntegrator(model.opt.integrator)
    if model.na or integrator not in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4):
        raise ValueError(
            f"the model: expected Euler or RK4 without activation states, got {integrator.name} with {model.na} of them"
        )
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    if iterations is not None:
        model.opt.iterations = iterations
    if ls_iterations is not None:
        model.opt.ls_iterations = ls_iterations
    return model


def _forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.forward` for a model without sensors, with MuJoCo's contact frames."""
    data = mjx.fwd_position(model, data)
    data = mjx.make_constraint(model, _align_frames(model, data))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, mjx.fwd_velocity(model, data)))
    return mjx.solve(model, data)


def _align_frames(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Rotate the frames of plane-capsule contacts so that the first tangent is along the capsule.

    MuJoCo always does, MJX only if the capsule is less than 60 degrees from the plane
    (https://github.com/google-deepmind/mujoco/issues/2774). A pyramidal friction cone is not symmetric about its axis:
    without this, one in ten of the ant's control steps is wrong by about 0.1 rad/s or more.
    """
    contact = data._impl.contact
    first, second = contact.geom.T
    types = jnp.asarray(model.geom_type)
    plane_capsule = (types[first] == mjx.GeomType.PLANE) & (types[second] == mjx.GeomType.CAPSULE)
    normal, axis = contact.frame[:, 0], data.geom_xmat[second][:, :, 2]
    tangent = axis - normal * jnp.sum(normal * axis, axis=1, keepdims=True)
    length = jnp.linalg.norm(tangent, axis=1, keepdims=True)
    aligned = plane_capsule[:, None] & (length > 1e-4)  # an upright capsule has no direction in the plane
    tangent = jnp.where(aligned, tangent / jnp.where(aligned, length, 1), contact.frame[:, 1])
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)], axis=1)
    return data.tree_replace({"_impl.contact": contact.replace(frame=frame)})


@contextlib.contextmanager
def numerics() -> Iterator[None]:
    """Full precision and the implicit promotions that MJX relies on, whatever the surrounding program sets."""
    # "highest": GPUs would multiply matrices in TF32, with 10 bits of mantissa.
    with (
        jax.default_matmul_precision("highest"),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        yield
