"""Physics `warp`: MuJoCo Warp through MJX, as CUDA kernels called from the compiled program.

All robots of a program (members, environments) are simulated in one call, as one batch of worlds. Warp keeps the
contacts of all of them in one array, which has room for every pair of bodies that can touch.

Needs the package warp-lang (the extra `warp`). Warp also runs on a CPU, slowly, which is good for tests.
"""

from typing import Any

import jax
import jax.numpy as jnp
import warp

from sqt_jax.envs.physics import Physics, PhysicsState, Setup
from sqt_jax.envs.physics.mjx import PRIVATE, mjx, newton_model, numerics
from sqt_jax.envs.physics.mjx import make as make_mjx
from sqt_jax.types import Array

warp.config.log_level = warp.LOG_WARNING  # else it prints a line for each kernel it compiles


def make(setup: Setup, iterations: int | None = None, ls_iterations: int | None = None) -> Physics:
    """MJX-Warp with Newton's method; starts are placed by MJX's kinematics.

    Args:
      setup: the model, and the quantities that the task needs.
      iterations: maximum steps of the constraint solver, which stops when it converges; None: the model file's.
      ls_iterations: maximum steps of its line search; None: the model file's.

    Raises:
      ValueError: the model has activation states, or an integrator other than Euler and RK4; a limit below 1.
    """
    host_model = newton_model(setup.model, iterations, ls_iterations)
    model = mjx.put_model(host_model, impl="warp")
    if "cfrc_ext" in setup.quantities:
        model = model.tree_replace({"opt._impl.run_rne_postconstraint": True})
    largest = mjx.make_data(host_model, impl="jax")._impl  # MJX's arrays have a row for everything that can touch
    num_contacts, num_rows = largest.contact.dist.shape[0], largest.efc_J.shape[0]

    def advance_one(blank: mjx.Data, state: PhysicsState, control: Array) -> PhysicsState:
        before, warm_start = state.internal
        data = blank.replace(qpos=state.qpos, qvel=state.qvel, ctrl=control, qacc_warmstart=warm_start)
        data = jax.lax.fori_loop(0, setup.frame_skip, lambda _, data: mjx.step(model, data), data)
        after = data.qpos[0] if setup.tracked is None else setup.tracked(model, data)
        quantities = {
            name: getattr(data._impl if name in PRIVATE else data, name).reshape(-1) for name in setup.quantities
        }
        return PhysicsState(
            qpos=data.qpos,
            qvel=data.qvel,
            displacement=after - before,
            quantities=quantities,
            internal=(after, data.qacc_warmstart),
        )

    @jax.custom_batching.custom_vmap
    def advance_all(state: PhysicsState, control: Array) -> PhysicsState:
        """States and controls [R, ...] of all robots."""
        with numerics():
            room = {"naconmax": len(control) * num_contacts, "njmax": num_rows}
            blank = mjx.make_data(host_model, impl="warp", **room)
            return jax.vmap(advance_one, (None, 0, 0))(blank, state, control)

    @advance_all.def_vmap
    def _(size: int, batched: Any, *arguments: Any) -> tuple[PhysicsState, Any]:
        def flat(leaf: Array, is_batched: bool) -> Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        state = advance_all(*jax.tree.map(flat, arguments, tuple(batched)))
        state = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), state)
        return state, jax.tree.map(lambda _: True, state)

    def advance(state: PhysicsState, control: Array) -> PhysicsState:
        batch = jax.tree.map(lambda leaf: leaf[None], (state, jnp.asarray(control, jnp.float32)))
        return jax.tree.map(lambda leaf: leaf[0], advance_all(*batch))

    return Physics(make_mjx(setup).place, advance)
