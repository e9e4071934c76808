"""Settings that are made before JAX starts. Tested in new processes, because it has started in this one."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
import test_plan

from experiments.commandline.arguments import UsageError
from experiments.surroundings import jax_settings
from sqt_jax.job_limits import usable_cores

ROOT = Path(__file__).parents[1]
PROGRAM = """
import sys
from experiments.commandline import flags
from experiments.surroundings import jax_settings
jax_settings.prepare()
from experiments.running.plan import make_plan
print(len(make_plan(flags.parse(["run", *sys.argv[1:]])).layout.devices))
import jax
jax_settings.start_jax(99)  # too late: without effect, and no error
print(len(jax.local_devices()))
"""


def devices_of_a_run(*arguments):
    """The number of devices that the members use, and of all devices."""
    command = [sys.executable, "-c", PROGRAM, *arguments]
    found = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | {"JAX_PLATFORMS": "cpu"}, cwd=ROOT
    )
    return tuple(map(int, found.stdout.split()))


def test_switches_are_the_callers_again_afterwards(capsys):
    names = {"jax_enable_x64": True, "jax_numpy_rank_promotion": "raise"}
    before = {name: jax.config.values[name] for name in names}
    try:
        for name, value in names.items():
            jax.config.update(name, value)
        with jax_settings.needed_switches():
            assert {name: jax.config.values[name] for name in names} == before
        assert {name: jax.config.values[name] for name in names} == names
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
    assert "JAX_ENABLE_X64, JAX_NUMPY_RANK_PROMOTION: has no effect" in capsys.readouterr().err


@pytest.mark.parametrize("name", jax_settings.REFUSED)
def test_a_switch_that_asks_for_something_else_is_refused(name):
    jax.config.update(name, True)
    try:
        with pytest.raises(UsageError, match=f"{name.upper()}: expects it to be off"), jax_settings.needed_switches():
            pass
    finally:
        jax.config.update(name, False)


def seeds(count):
    return f"--seeds={','.join(map(str, range(count)))}"


def test_a_processor_is_a_device_for_each_member(tmp_path):
    members = 2 * usable_cores() + 1
    run = f"--out={tmp_path}", "--algo=td3", "--env=cheetah", "--replay_capacity=10000", seeds(members)
    assert devices_of_a_run(*run) == (members, members)


def test_a_processor_is_a_device_for_each_member_of_a_resumed_run(tmp_path):
    members = 2 * usable_cores() + 1
    path = test_plan.begun(tmp_path, "a", "--replay_capacity=10000", seeds(members))
    assert devices_of_a_run(f"--resume={path}") == (members, members)


def test_there_are_at_most_16_devices_for_a_core(tmp_path):
    here = 16 * usable_cores()
    run = f"--out={tmp_path}", "--algo=td3", "--env=cheetah", "--replay_capacity=10000", seeds(here + 2)
    assert devices_of_a_run(*run) == (here // 2 + 1, here)
