"""Members along devices: how many each holds, and results do not depend on the device."""

import math
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import one_of_two_processes
import probe_envs
import pytest

from sqt_jax import experiment, members, train
from sqt_jax.members import Layout

DEVICES = tuple(jax.local_devices()[:2])
two_devices = pytest.mark.skipif(len(DEVICES) < 2, reason="one device only")


@pytest.mark.parametrize(
    ("count", "devices", "size"), [(1, 0, 1), (5, 1, 5), (4, 2, 4), (5, 2, 6), (3, 8, 8), (9, 4, 12)]
)
def test_shares_are_equal(count, devices, size):
    layout = Layout(count, (jax.devices()[0],) * devices)
    assert layout.padded_size == size
    padded = layout.padded(np.arange(count))
    assert list(padded) == [index % count for index in range(size)]


@pytest.mark.parametrize(
    ("here", "count", "used"),
    [
        (1, 5, 1),
        (4, 4, 4),
        (8, 5, 5),
        (32, 25, 25),
        (4, 5, 3),  # shares of two: the fourth would hold copies only
        (4, 7, 4),
        (8, 17, 6),
    ],
)
def test_a_sweep_uses_the_devices_that_get_members(monkeypatch, here, count, used):
    monkeypatch.setattr(jax, "local_devices", lambda: list(range(here)))
    assert members.usable_devices(count) == used
    assert Layout(count, (jax.devices()[0],) * used).padded_size - count < math.ceil(count / used)


def learner_of(state):
    """The agent's state; TD7's is inside its policy checkpoints."""
    return getattr(state.agent, "learner", state.agent)


def trained(sweep, config, count):
    """The actors at the start, and the state after a little training."""
    start = one_of_two_processes.start(sweep, config, count)
    first = jax.device_get(learner_of(start).actor)
    return first, one_of_two_processes.train_a_little(sweep, start)


@pytest.fixture(scope="module", params=["td3_sqt", pytest.param("td7_sqt", marks=pytest.mark.slow)])
def both(request):
    """Three members on one device and on two."""
    small = {"embedding_size": 16} if request.param == "td7_sqt" else {}
    config = experiment.make_config(request.param, "cheetah", **one_of_two_processes.SETTINGS | small)
    trainer = experiment.make_trainer(config, probe_envs.one_step())
    sweeps = [train.make_sweep(trainer), train.make_sweep(trainer, Layout(3, DEVICES))]
    return sweeps, [trained(sweep, config, 3) for sweep in sweeps]


def numbers(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree) if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)]


@two_devices
def test_members_start_on_two_devices_as_on_one_bit_for_bit(both):
    _, ((one, _), (two, _)) = both
    for a, b in zip(numbers(one), numbers(two), strict=True):
        np.testing.assert_array_equal(a, b[:3])


@two_devices
def test_members_train_on_two_devices_as_on_one(both):
    sweeps, ((_, one), (_, two)) = both
    for a, b in zip(numbers(one), numbers(two), strict=True):
        np.testing.assert_allclose(a, b[:3] if a.ndim else b, rtol=1e-4, atol=1e-5)
    assert int(one.env_steps) == int(two.env_steps) == 90
    assert int(one.gradient_steps) == int(two.gradient_steps) == 50
    results = [(sweep.evaluate(state), sweep.measure(state)) for sweep, state in zip(sweeps, (one, two), strict=True)]
    for a, b in zip(*map(numbers, results), strict=True):
        assert b.shape[0] == 4
        np.testing.assert_allclose(a, b[:3], rtol=1e-3, atol=1e-4)


@two_devices
def test_each_device_holds_only_its_share(both):
    _, (_, (_, state)) = both
    for leaf in jax.tree.leaves((learner_of(state).actor, state.replay)):
        if not leaf.ndim:
            continue  # a shared counter
        assert {shard.device for shard in leaf.addressable_shards} == set(DEVICES)
        assert [shard.data.shape[0] for shard in leaf.addressable_shards] == [2, 2]


@two_devices
def test_two_programs_for_all_devices_whatever_the_number_of_steps(both):
    sweeps, _ = both
    assert sweeps[1].advance._cache_size() == 2  # the warm-up and training


@pytest.mark.slow
def test_members_train_over_two_processes_as_in_one(tmp_path):
    """`jax.distributed`: the same calls in each process, over the devices of both."""
    config = experiment.make_config("td3_sqt", "cheetah", **one_of_two_processes.SETTINGS)
    sweep = train.make_sweep(experiment.make_trainer(config, probe_envs.one_step()))
    _, state = trained(sweep, config, 3)
    expected = np.asarray(sweep.evaluate(state)[0].returns)

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    tests = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tests.parent), str(tests)])}
    started = [
        subprocess.Popen(
            [sys.executable, str(tests / "one_of_two_processes.py"), address, str(rank), str(tmp_path / f"{rank}.npy")],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        for process in started:
            output, _ = process.communicate(timeout=240)
            assert process.returncode == 0, output
    finally:  # if one ended or hangs, the other waits for it
        for process in started:
            process.kill()
            process.wait()
    for rank in range(2):
        returns = np.load(tmp_path / f"{rank}.npy")
        assert returns.shape == (4, 2)
        np.testing.assert_allclose(returns[:3], expected, rtol=1e-3, atol=1e-4)
