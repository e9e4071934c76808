"""The benchmark's tables and ratios."""

import jax
import pytest

from experiments.benchmarks import output
from experiments.benchmarks.measurements import Measurement
from experiments.commandline.arguments import UsageError


def test_ratios_are_of_one_task_and_number_of_members():
    rates = {"MuJoCo without JAX": 100.0, "mujoco": 90.0, "mjx": 50.0, "mjx, the file's iterations": 20.0}
    found = [Measurement("physics", f"ant, {what}", 5, "env steps", rate, 0.0) for what, rate in rates.items()]
    loops = {"td3 on ant, mjx": 200.0, "td3 on ant, mujoco": 250.0, "td3 on walker, mujoco": 300.0}
    loops["td3 on ant, warp"] = 500.0
    found += [Measurement("loop", what, 5, "env steps", rate, 0.0) for what, rate in loops.items()]
    found += [
        Measurement("loop", f"{what}, 5 devices", 5, "env steps", 3 * rate, devices=5) for what, rate in loops.items()
    ]
    assert output.physics_ratios(found) == [
        "ant, 5 members: mujoco / MuJoCo without JAX = 0.90",
        "ant, 5 members: mjx / mjx, the file's iterations = 2.50",
        "td3 on ant, 5 members: mujoco / mjx = 1.25",
        "td3 on ant, 5 members: warp / mjx = 2.50",
        "td3 on ant, 5 members, 5 devices: mujoco / mjx = 1.25",
        "td3 on ant, 5 members, 5 devices: warp / mjx = 2.50",
    ]


@pytest.mark.parametrize(("backend", "share"), [("cpu", "80%"), ("gpu", "40%")])
def test_accelerators_have_a_peak_each_and_a_cpus_devices_one(monkeypatch, backend, share):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    found = Measurement("update", "a", 5, "member updates", 8.0, 1.0, operations=1e9, devices=2)
    assert output.cells(found, peak=1e10)[6:] == ("1", share, "")
    assert output.cells(found, peak=0.0)[6:] == ("1", "", "")  # interrupted before it was measured


def test_figures_that_cannot_be_written_are_an_error_after_the_table(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    found = Measurement("growth", "a", 5, "member updates", 10.0, point=("members", "td3", 5))
    with pytest.raises(UsageError, match="^--figures=.*/file/below: expects a folder that can be written: Not a dir"):
        output.print_all([found], 0.0, tmp_path / "file" / "below")
    assert "| growth | a | 5 | 10 |" in capsys.readouterr().out
