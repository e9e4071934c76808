"""The resources of a cell's task: `--ray`."""

import pytest

from experiments.commandline.arguments import UsageError
from experiments.launchers.ray_options import RayOptions, job_name, parse
from experiments.running.lock_record import new_record


def test_the_defaults_are_one_core_and_a_gpu_where_there_are_some():
    options = parse("")
    assert options == RayOptions() and options.num_cpus == 1
    assert options.with_gpus(True).num_gpus == 1 and options.with_gpus(False).num_gpus == 0
    assert parse("num_gpus=0").with_gpus(True).num_gpus == 0


def test_all_options_reach_ray():
    options = parse("num_cpus=2, num_gpus=0.5,memory=8G,accelerator_type=A100,resources.fast=1,resources.near=0.1")
    assert options.task_options == {
        "num_cpus": 2,
        "num_gpus": 0.5,
        "memory": 8_000_000_000,
        "accelerator_type": "A100",
        "resources": {"fast": 1.0, "near": 0.1},
    }
    assert options.text == (
        "num_cpus=2,num_gpus=0.5,memory=8000000000,accelerator_type=A100,resources.fast=1,resources.near=0.1"
    )
    assert parse("num_cpus=3").task_options == {"num_cpus": 3, "num_gpus": 0, "resources": {}}


def test_a_node_fits_that_has_everything():
    node = {"CPU": 4.0, "GPU": 1.0, "memory": 2e9, "accelerator_type:A100": 1.0, "fast": 1.0}
    for text in ("num_cpus=4", "num_gpus=1", "memory=2G", "accelerator_type=A100", "resources.fast=0.5"):
        assert parse(text).fit(node)
    for text in ("num_cpus=5", "num_gpus=2", "memory=3G", "accelerator_type=H100", "resources.slow=1"):
        assert not parse(text).fit(node)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("num_cpu=1", "--ray: expects one of num_cpus, "),
        ("resources.=1", "--ray: expects one of num_cpus, "),
        ("num_cpus=1,num_cpus=2", "--ray=num_cpus=1,num_cpus=2: expects num_cpus once"),
        ("num_cpus=0", "--ray: num_cpus expects a whole number from 1, not '0'"),
        ("num_cpus=0.5", "--ray: num_cpus expects a whole number from 1, not '0.5'"),
        ("num_cpus=nan", "--ray: num_cpus expects a whole number from 1, not 'nan'"),
        ("num_cpus", "--ray: num_cpus expects a whole number from 1, not ''"),
        ("num_gpus=-1", "--ray: num_gpus expects a whole number, or a part of a GPU like 0.5, not '-1'"),
        ("num_gpus=1.5", "--ray: num_gpus expects a whole number, or a part of a GPU like 0.5, not '1.5'"),
        ("memory=8T", "--ray: memory expects bytes, like 500M or 8G, not '8T'"),
        ("memory=1e30", "--ray: memory expects bytes, like 500M or 8G, not '1e30'"),
        ("accelerator_type=", "--ray: accelerator_type expects a name, like A100"),
        ("resources.fast=0", "--ray: resources.fast expects a number above 0, not '0'"),
    ],
)
def test_errors_are_one_line(text, line):
    with pytest.raises(UsageError) as error:
        parse(text)
    assert str(error.value).startswith(line) and "\n" not in str(error.value)


def test_starts_of_a_cell_are_attempts_at_one_job():
    def record(sweep, number):
        return new_record(variables={"SQT_JOB": job_name(sweep, number)})

    assert record("f00d", 7).succeeds(record("f00d", 7))
    assert not record("f00d", 7).succeeds(record("f00d", 8)) and not record("f00d", 7).succeeds(record("beef", 7))
