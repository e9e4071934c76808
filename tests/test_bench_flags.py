"""The benchmark's flags: invalid values are rejected in one line that names the flag."""

import pytest
from absl.testing import flagsaver

from experiments.benchmarks import bench_flags
from experiments.benchmarks.bench_flags import FLAGS, check_flags
from experiments.evidence.published import PAPERS_TASKS
from sqt_jax.envs import physics


@pytest.fixture(autouse=True)
def _parsed():
    FLAGS.mark_as_parsed()


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("suites", "all"),
        ("tasks", "hopper2"),
        ("algos", "td8"),
        ("physics", "x"),
        ("solver", "8"),
        ("solver", "8/0"),
        ("members", "0"),
        ("capacities", "x"),
        ("devices", "0"),
        ("compare", "cleanrl"),
        ("devices", "most"),
        ("parts", "all"),
        ("members", "all"),
    ],
)
def test_a_wrong_value_is_rejected_in_one_line(flag, value):
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        check_flags()
    message = str(error.value)
    assert message.startswith(f"--{flag}: expects ") and value in message and "\n" not in message


@pytest.mark.parametrize("flag", ["tasks", "algos", "members", "devices", "capacities", "physics", "parts"])
def test_an_empty_list_is_rejected_except_of_suites(flag):
    with flagsaver.flagsaver(suites=[]):
        check_flags()
    with flagsaver.flagsaver(**{flag: []}), pytest.raises(SystemExit, match=f"^--{flag}: expects at least one$"):
        check_flags()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"suites": ["update", "growth"], "members": ["1", "5"]},
            "--members: expects one number with the suite growth, not 1,5",
        ),
        (
            {"suites": ["gpu"], "members": ["1", "2", "3", "4"]},
            "--members: expects at most three numbers with --suite=gpu, not 1,2,3,4$",
        ),
        ({"compare": ["sbx"], "algos": ["td7"]}, "--algos: expects some of td3, sac with --compare=sbx"),
        ({"json": "/no/such/folder/bench.json"}, "--json: expects a file in an existing folder"),
        ({"json": "/"}, "--json: expects a file in an existing folder"),
    ],
)
def test_flags_that_would_give_no_measurements_or_lose_them_are_rejected(given, says):
    with flagsaver.flagsaver(**given), pytest.raises(SystemExit, match=f"^{says}"):
        check_flags()


def test_a_figures_folder_that_cannot_be_written_is_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    figures = str(tmp_path / "file" / "below")
    with (
        flagsaver.flagsaver(suites=["growth"], members=["5"], figures=figures),
        pytest.raises(SystemExit, match="^--figures=.*/file/below: expects a folder that can be written$"),
    ):
        check_flags()


def test_a_peer_that_is_not_installed_is_rejected(monkeypatch):
    monkeypatch.setitem(bench_flags.compare.NEEDS, "sbx", "no_such_module")
    with (
        flagsaver.flagsaver(compare=["sbx"]),
        pytest.raises(SystemExit, match="^--compare: sbx needs a Python with sbx"),
    ):
        check_flags()


def test_physics_that_cannot_run_here_is_left_out_or_rejected(monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    assert bench_flags.physics_here() == ["mjx", "mujoco"]
    with flagsaver.flagsaver(physics=["warp"]), pytest.raises(SystemExit, match="^--physics: warp needs a part$"):
        bench_flags.physics_here()
    with (
        flagsaver.flagsaver(physics=["warp", "mjx", "mujoco"]),
        pytest.raises(SystemExit, match="^--physics: warp needs a part; --physics=mjx,mujoco leaves it out$"),
    ):
        bench_flags.physics_here()


def test_a_named_suite_sets_the_flags_that_were_not_given():
    with flagsaver.flagsaver(suite="gpu"), flagsaver.flagsaver():
        FLAGS["tasks"].present = 1
        try:
            check_flags()
            assert FLAGS.members == ["25", "100", "250"] and FLAGS.physics == ["warp", "mjx", "mujoco"]
            assert (FLAGS.suites, FLAGS.devices, FLAGS.seconds, FLAGS.repeats) == (["gpu"], ["1"], 2.0, 3)
            assert FLAGS.tasks == list(PAPERS_TASKS)  # as given
        finally:
            FLAGS["tasks"].present = 0


@pytest.mark.parametrize("name", bench_flags.NAMED_SUITES)
def test_a_named_suite_has_valid_flags(name):
    with flagsaver.flagsaver(suite=name), flagsaver.flagsaver():
        check_flags()


def test_more_devices_than_available_are_rejected():
    with (
        flagsaver.flagsaver(devices=["1", "99"]),
        pytest.raises(SystemExit, match=r"^--devices: expects at most \d+ here, not 99$"),
    ):
        bench_flags.devices_here()


def test_automatic_devices_depend_on_the_number_of_members():
    with flagsaver.flagsaver(devices=["1", "auto"]):
        assert bench_flags.devices_here() == [1, None]


def test_the_processor_is_divided_for_the_largest_measurement():
    with flagsaver.flagsaver(members=["1", "7"], devices=["1", "3"]):
        assert bench_flags.most_devices() == 3
        with flagsaver.flagsaver(devices=["1", "auto"]):
            assert bench_flags.most_devices() == 7
        with flagsaver.flagsaver(compare=["sbx"]):
            assert bench_flags.most_devices() == 7
        with flagsaver.flagsaver(suites=["growth"]):
            assert bench_flags.most_devices() == 50


def test_solver_limits_are_pairs():
    with flagsaver.flagsaver(solver=["100/50", "8/3"]):
        first, second = bench_flags.solver_limits().items()
    assert first == ("100/50", {"iterations": 100, "ls_iterations": 50})
    assert second == ("8/3", {"iterations": 8, "ls_iterations": 3})


def test_a_request_has_the_flags_values():
    with flagsaver.flagsaver(members=["1", "7"], devices=["auto"], physics=["mjx"], solver=["8/3"]):
        found = bench_flags.request()
    assert (found.members, found.devices, found.capacities) == ([1, 7], [None], [10_000, 1_000_000])
    assert found.physics == ["mjx"] and found.solver == {"8/3": {"iterations": 8, "ls_iterations": 3}}
