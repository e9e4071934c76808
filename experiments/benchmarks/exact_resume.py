"""Whether training repeats bit for bit, and resumes bit for bit from a checkpoint, in processes of their own.

`compare` starts `python -m experiments.benchmarks.exact_resume ALGO TASK PHYSICS MEMBERS STEPS FOLDER HOW` three times:
two complete trainings, and one that continues the first one's checkpoint. Each compiles for itself, because XLA may
choose other kernels each time, and prints a sum of every array at the end.
"""

import hashlib
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.measure_loops import WARMUP_STEPS, loop_config
from experiments.benchmarks.measurements import EQUAL, Measurement, member_keys
from experiments.benchmarks.part_process import output_of
from experiments.running.checkpoints import CheckpointStore
from experiments.running.loop import Position
from experiments.surroundings import jax_settings
from sqt_jax import experiment, train
from sqt_jax.members import Layout
from sqt_jax.trees import by_path

STEPS = 400  # of a training, after the warm-up; the checkpoint is in the middle
WHOLE, RESUMED = "whole", "resumed"


def train_and_sum(algo: str, task: str, physics: str, members: int, steps: int, folder: Path, how: str) -> dict:
    """Trains, and returns the SHA-256 of each array of the final state by its path.

    Args:
      folder: of the checkpoint in the middle, which `whole` writes and `resumed` reads.
    """
    config = loop_config(algo, task, members, physics)
    layout = Layout(members, tuple(jax.local_devices()[:1]))
    sweep = train.make_sweep(experiment.make_trainer(config), layout)
    scalars = jax.tree.map(lambda value: jnp.full(members, value), config.agent.scalars())
    replay = experiment.replay_of(config, experiment.env_of(config))
    store = CheckpointStore(folder, replay, layout, 1, lambda text: sys.exit(text))
    if how == WHOLE:
        state = sweep.init(member_keys(members), scalars)
        state = sweep.advance(state, WARMUP_STEPS, False)
        state = sweep.advance(state, steps // 2, True)
        at = WARMUP_STEPS + steps // 2
        store.save(state, Position(at, at), {})
        store.wait()
    else:
        restored = store.restore(jax.eval_shape(sweep.init, member_keys(members), scalars))
        if restored is None:
            sys.exit(f"no checkpoint in {folder}")
        state = sweep.restart(restored.state)
    state = sweep.advance(state, steps - steps // 2, True)
    return {path: _sum(leaf) for path, leaf in by_path(state).items()}


def _sum(leaf: jax.Array) -> str:
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return hashlib.sha256(np.asarray(jax.random.key_data(leaf) if is_key else leaf).tobytes()).hexdigest()


def compare(
    algo: str,
    task: str,
    physics: str,
    members: int,
    label: str = "",
    steps: int = STEPS,
    run: Callable[[Sequence[str]], str] = output_of,
) -> Iterator[Measurement]:
    """The shares of arrays that are bit for bit equal: of two trainings, and of one and its resumed other.

    Args:
      label: how the processes differ from the default, in words.
      run: as `part_process.output_of`; the sums as JSON.
    """
    command = [sys.executable, "-m", __name__, algo, task, physics, str(members), str(steps)]
    with tempfile.TemporaryDirectory() as folder:
        first = json.loads(run([*command, f"{folder}/1", WHOLE]))
        for what, other in (("the same again", [f"{folder}/2", WHOLE]), ("resumed", [f"{folder}/1", RESUMED])):
            second = json.loads(run([*command, *other]))
            equal = [path for path in first if first[path] == second[path]]
            differing = [path for path in first if first[path] != second[path]]
            verdict = f"differs in {', '.join(differing[:3])}" if differing else "bit for bit equal"
            yield Measurement(
                suite="exact",
                what=f"{algo} on {task}, {physics}, {steps} steps{label}, {what}: {verdict}",
                members=members,
                unit=EQUAL,
                rate=100 * len(equal) / len(first),
            )


if __name__ == "__main__":
    jax_settings.prepare()
    jax_settings.start_jax(1)
    jax.config.update("jax_enable_compilation_cache", False)
    _, algo, task, physics, members, steps, folder, how = sys.argv
    print(json.dumps(train_and_sum(algo, task, physics, int(members), int(steps), Path(folder), how)))
