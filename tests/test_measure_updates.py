"""Updates: counted over all members, on each number of devices."""

import jax
import pytest

from experiments.benchmarks.measure_loops import bench_loops
from experiments.benchmarks.measure_updates import bench_updates

SHORT = {"seconds": 0.0, "repeats": 1}


@pytest.mark.slow
def test_an_updates_row_counts_the_updates_of_all_members():
    (row,) = bench_updates("td3_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td3_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0
    assert 4e8 < row.operations < 5e8


def test_fewer_members_than_devices_give_a_line_in_place_of_a_measurement(capsys):
    assert list(bench_updates("td3", "cheetah", 1, (2, 4), **SHORT)) == []
    assert list(bench_loops("td3", "cheetah", 1, ["mjx"], (2,), **SHORT)) == []
    assert capsys.readouterr().out.splitlines() == [
        "no measurement of 1 members on 2 or 4 devices: each device needs at least one member",
        "no measurement of 1 members on 2 devices: each device needs at least one member",
    ]


@pytest.mark.slow
@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="one device only")
def test_an_update_is_measured_on_each_number_of_devices_that_has_members():
    settings = {"hidden": (16, 16), "batch_size": 16}
    rows = list(bench_updates("td3", "cheetah", 2, (1, 2, 5), settings, **SHORT))
    assert [row.what for row in rows] == ["td3, cheetah sizes", "td3, cheetah sizes, 2 devices"]
    assert [row.devices for row in rows] == [1, 2]
    assert rows[0].operations == rows[1].operations > 0
