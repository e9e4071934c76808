"""Physics `warp`: MuJoCo Warp (https://github.com/google-deepmind/mujoco_warp), called from the compiled program.

All robots of a program (members, environments) are one batch of worlds. One call makes all physics steps of a control
step. Warp keeps the simulator's data, so that only a row of numbers per robot passes between the program and the
simulator. Each call resets the data first: it is a pure function.

Needs the package warp-lang (the extra `warp`). Warp also runs on a CPU, slowly, which is good for tests.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import warp
from mujoco.mjx.third_party import mujoco_warp

from sqt_jax.envs.physics import Physics, PhysicsState, Setup
from sqt_jax.envs.physics.mjx import make as make_mjx
from sqt_jax.envs.physics.mjx import mjx, newton_model
from sqt_jax.types import Array

warp.config.log_level = warp.LOG_WARNING  # else it prints a line for each kernel it compiles

POINTS = ("xpos", "xipos")  # what `Setup.tracked` may read: the origins and the centres of mass of all bodies


def make(setup: Setup, iterations: int | None = None, ls_iterations: int | None = None) -> Physics:
    """MuJoCo Warp with Newton's method; starts are placed by MJX's kinematics.

    Args:
      setup: the model, and the quantities that the task needs.
      iterations: maximum steps of the constraint solver, which stops when it converges; None: the model file's.
      ls_iterations: maximum steps of its line search; None: the model file's.

    Raises:
      ValueError: the model has activation states, or an integrator other than Euler and RK4; a limit below 1.
    """
    host_model = newton_model(setup.model, iterations, ls_iterations)
    read = _columns(host_model, ("qpos", "qvel", "qacc_warmstart", "ctrl"))
    written = _columns(host_model, ("qpos", "qvel", "qacc_warmstart", *setup.quantities, *POINTS))
    width = max(columns.stop for columns in written.values())
    worlds = functools.cache(lambda count: _make_worlds(host_model, count, "cfrc_ext" in setup.quantities))

    def control_step(inputs: warp.array2d[float], outputs: warp.array2d[float]) -> None:
        """A row of the fields `read` per world -> a row of `written`, all physics steps of a control step later."""
        model, data = worlds(len(inputs))[str(inputs.device)]
        mujoco_warp.reset_data(model, data)
        for name, columns in read.items():
            warp.copy(_rows(getattr(data, name)), inputs[:, columns])
        for _ in range(setup.frame_skip):
            mujoco_warp.step(model, data)
        for name, columns in written.items():
            warp.copy(outputs[:, columns], _rows(getattr(data, name)))

    # Warp captures a call as one CUDA graph. XLA cannot: MuJoCo Warp does not work with GraphMode.JAX
    # (mujoco/mjx/warp/forward_test.py).
    modes = warp.JaxCallableGraphMode
    graph_mode = modes.WARP if jax.default_backend() == "gpu" else modes.NONE
    step_worlds = warp.jax_callable(control_step, graph_mode=graph_mode)

    @jax.custom_batching.custom_vmap
    def advance_all(inputs: Array) -> Array:
        """`control_step` for any leading axes: [..., the width of `read`] -> [..., width]"""
        rows = inputs.reshape(-1, inputs.shape[-1])
        worlds(len(rows))  # before the first call, which is captured
        (outputs,) = step_worlds(rows, output_dims={"outputs": (len(rows), width)})
        return outputs.reshape(*inputs.shape[:-1], width)

    @advance_all.def_vmap
    def _(size: int, batched: Sequence[bool], inputs: Array) -> tuple[Array, bool]:
        inputs = inputs if batched[0] else jnp.broadcast_to(inputs, (size, *inputs.shape))
        return advance_all(inputs), True

    def advance(state: PhysicsState, control: Array) -> PhysicsState:
        before, warm_start = state.internal
        control = jnp.asarray(control, jnp.float32)
        row = advance_all(jnp.concatenate([state.qpos, state.qvel, warm_start, control]))
        fields = {name: row[columns] for name, columns in written.items()}
        points = SimpleNamespace(**{name: fields[name].reshape(-1, 3) for name in POINTS})
        after = setup.tracked(host_model, points) if setup.tracked else fields["qpos"][0]
        return PhysicsState(
            qpos=fields["qpos"],
            qvel=fields["qvel"],
            displacement=after - before,
            quantities={name: fields[name] for name in setup.quantities},
            internal=(after, fields["qacc_warmstart"]),
        )

    return Physics(make_mjx(setup).place, advance)


def _columns(model: mujoco.MjModel, names: Sequence[str]) -> dict[str, slice]:
    """Where the numbers of each field of MuJoCo's data are, in a row of all of them."""
    data, columns, start = mujoco.MjData(model), {}, 0
    for name in names:
        columns[name] = slice(start, start := start + getattr(data, name).size)
    return columns


def _rows(field: Any) -> Any:
    """A field of Warp's data [R, ...] as rows of numbers [R, ...], which share its memory."""
    floats = field.capacity // 4
    return warp.array(ptr=field.ptr, shape=(len(field), floats // len(field)), dtype=float, device=field.device)


def _make_worlds(host_model: mujoco.MjModel, count: int, external_forces: bool) -> dict[str, tuple[Any, Any]]:
    """Warp's model and the data of `count` worlds, by device. All kernels of a control step are compiled too.

    Both have to exist before a call is captured: a capture records kernels; it should not allocate or compile.
    """
    largest = mjx.make_data(host_model, impl="jax")._impl  # MJX's arrays have a row for everything that can touch
    room = {"naconmax": count * largest.contact.dist.shape[0], "njmax": largest.efc_J.shape[0]}
    made = {}
    for device in dict.fromkeys(map(_name_in_warp, jax.local_devices())):
        with warp.ScopedDevice(device):
            model, data = mujoco_warp.put_model(host_model), mujoco_warp.make_data(host_model, nworld=count, **room)
            model.opt.run_rne_postconstraint = external_forces
            mujoco_warp.reset_data(model, data)
            mujoco_warp.step(model, data)
            warp.synchronize_device(device)  # JAX's calls are on another stream
        made[device] = model, data
    return made


def _name_in_warp(device: jax.Device) -> str:
    return f"cuda:{device.local_hardware_id}" if device.platform == "gpu" else "cpu"
