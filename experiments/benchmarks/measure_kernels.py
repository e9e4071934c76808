"""The launches of a GPU's training program, counted without a GPU: `python -m experiments.bench --suites=kernels`.

Each case is compiled by a process of its own, because JAX's platforms are chosen when it starts. That process is this
module: `python -m experiments.benchmarks.measure_kernels ALGO TASK PHYSICS MEMBERS` prints the counts as JSON.
"""

import json
import sys
from collections.abc import Callable, Iterator
from functools import partial

from experiments.benchmarks import gpu_target, launches
from experiments.benchmarks.measurements import HOST_SYNCS, KERNELS, Measurement
from experiments.benchmarks.part_process import output_of

# The scopes of a lockstep step (`train.make_trainer`, `rollout.step`, the tasks).
PARTS = ("act", "physics", "environment", "restart", "observe", "insert", "sample", "update", "feedback", "metrics")
PHYSICS = ("mjx", "warp")  # the others call the host
STEPS = 100_000  # of the run: they choose the capacity of the replay


def compile_and_count(algo: str, task: str, physics: str, members: int) -> launches.Launches:
    """The launches of a lockstep step. Call in a process with `gpu_target.environment`."""
    import jax
    import jax.numpy as jnp

    import sqt_jax
    from sqt_jax.envs import physics as simulators
    from sqt_jax.members import Layout, every_leaf

    simulators.LACKS.clear()  # no GPU is asked for
    config = sqt_jax.make_config(algo, task, physics=physics, steps=STEPS)
    trainer = sqt_jax.make_trainer(config)
    layout, keys = Layout(members), jax.eval_shape(lambda: jax.vmap(jax.random.key)(jnp.arange(members)))
    axes = every_leaf(trainer.member_axes, jax.eval_shape(trainer.init, jax.random.key(0)))
    scalars = jax.eval_shape(lambda: jax.tree.map(lambda x: jnp.full(members, x), config.agent.scalars()))
    state = jax.eval_shape(layout.over_members(trainer.init, (0, 0), axes), keys, scalars)
    advance = layout.over_members(partial(trainer.advance, learn=True), (axes, None), axes)
    text = gpu_target.compiled_text(advance, state, jax.ShapeDtypeStruct((), jnp.int32), donate=0)
    # As if no robot fell: each member's episodes end at their time limit, and at a step of their own.
    ends = min(1.0, members / sqt_jax.make_env(task, physics=physics).episode_length)
    return launches.count(text, PARTS, {"restart": ends, "observe": ends})


def bench_kernels(
    algo: str, task: str, members: int, physics: str, run: Callable[..., str] = output_of
) -> Iterator[Measurement]:
    """Kernels of a lockstep step, and synchronisations with the host; the parts of each in `what`.

    Args:
      run: as `part_process.output_of`.
    """
    command = [sys.executable, "-m", __name__, algo, task, physics, str(members)]
    found = launches.Launches(**json.loads(run(command, gpu_target.environment())))
    for unit, parts in ((KERNELS, found.kernels), (HOST_SYNCS, found.host_syncs)):
        ordered = sorted(parts.items(), key=lambda item: -item[1])
        listed = ", ".join(f"{name}: {number:.3g}" for name, number in ordered if number >= 0.05)
        what = f"{algo} on {task}, {physics} ({listed})"
        yield Measurement(suite="kernels", what=what, members=members, unit=unit, rate=sum(parts.values()))


if __name__ == "__main__":
    _, algo, task, physics, members = sys.argv
    print(json.dumps(compile_and_count(algo, task, physics, int(members))._asdict()))
