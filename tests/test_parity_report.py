"""The cases of the parity report: each physics, and further limits of MJX's solver."""

from experiments.gymnasium_parity.parity_report import physics_cases

SOLVER = {"8/3": {"iterations": 8, "ls_iterations": 3}}


def test_limits_of_mjxs_solver_are_cases_of_their_own():
    found = physics_cases(["mjx", "mujoco"], SOLVER)
    assert found["mjx 8/3"] == ("mjx", {"iterations": 8, "ls_iterations": 3})
    assert found["mjx"] == ("mjx", {}) and list(found) == ["mjx", "mujoco", "mjx 8/3"]
    assert physics_cases(["mujoco"], SOLVER).keys() == {"mujoco"}
