"""Members as runs in Weights & Biases, with a stand-in for the package. The real one: test_wandb_package.py."""

import contextlib
import json
import os
import sys
import threading

import pytest
from fake_wandb import FakeWandb
from hypothesis import given, settings
from hypothesis import strategies as st
from test_records import outcome, report

from experiments.run import main
from experiments.running import records, wandb_runs
from experiments.running.run_config import make_members
from experiments.running.wandb_runs import open_runs
from sqt_jax.experiment import make_config

pytestmark = pytest.mark.usefixtures("no_service")


@pytest.fixture(scope="module")
def no_service():
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("WANDB_SERVICE", raising=False)
        patch.delenv("WANDB_CACHE_DIR", raising=False)
        yield


@pytest.fixture
def wandb(monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


def members_of(*seeds, **settings):
    return make_members(seeds, [make_config("sac_sqt", "ant", **settings)])


END = 60


class Training:
    """The part of a run that writes rows: an evaluation every 10 steps, a checkpoint every 20, two members."""

    def __init__(self, folder):
        self.folder, self.members = folder, members_of(3, 5)
        self.checkpoint, self.lines = None, []

    def steps(self, until, complete=True):
        """Trains from the last checkpoint to step `until`; a process that is not complete is killed there."""
        tables = records.Records(self.folder, self.members, [], False, self.checkpoint)
        runs = open_runs(self.folder, self.members, [], "proj", self.lines.append)
        if runs:
            tables.track(runs)
        for step in range(self.checkpoint[0] + 10 if self.checkpoint else 0, until + 1, 10):
            tables.report(self.report(step))
            if step % 20 == 0:
                self.checkpoint = step, tables.lengths()
        if complete:
            tables.summary(outcome(interrupted=until < END))
            tables.__exit__()

    @staticmethod
    def report(step):
        return report(step, [[step + 1.0], [step + 2.0]], {"q_std": [step + 0.25, step + 0.5]} if step else {})


def rows_until(step, member):
    """What W&B should have."""
    rows = []
    for at in range(0, step + 1, 10):
        values = {"eval/return_mean": at + 1.0 + member, "eval/return_std": 0.0, "eval/episode_length_mean": 100.0}
        rows.append((at, values | ({"train/q_std": at + 0.25 + member / 4} if at else {})))
    return rows


def rows_of(wandb, member):
    (name,) = {name for name in wandb.server if name.endswith(f"-{member}")}
    return wandb.server[name]


def test_a_member_is_a_run_of_the_groups(tmp_path, wandb):
    (tmp_path / "my run").mkdir()
    members = members_of(3, 5, penalty_coef=0.25, lr=1e-3)
    runs = open_runs(tmp_path / "my run", members, ["lr"], "proj", pytest.fail)
    for index, run in enumerate(sorted(wandb.runs, key=lambda run: run.id)):
        told = run.arguments
        config, settings = told.pop("config"), told.pop("settings")
        assert told == {
            "project": "proj",
            "id": f"{json.loads((tmp_path / 'my run' / 'wandb.json').read_text())['id']}-{index}",
            "name": f"seed={(3, 5)[index]},penalty_coef=0.25,lr=0.001",
            "group": "ant/sac_sqt/my run",
            "job_type": "sac_sqt",
            "tags": ["sac_sqt", "ant"],
            "dir": str(tmp_path / "my run"),
            "reinit": "create_new",
            "resume": "allow",
        }
        assert (config["seed"], config["member"], config["lr"], config["env"]) == ((3, 5)[index], index, 1e-3, "ant")
        assert settings.silent and settings.console == "off" and not settings.symlink
        assert settings.stop_fn() is None and settings.x_disable_stats == (index > 0)
        assert not hasattr(settings, "finish_timeout_raises")  # a setting that this version does not know
    assert runs.where == "W&B: the group ant/sac_sqt/my run of https://wandb.test/me/proj"


def test_long_names_are_cut_to_what_the_server_accepts():
    told = wandb_runs.describe("n" * 200 + "20250102", members_of(3)[0], 0, [])
    assert len(told["group"]) == 128 and told["group"].endswith("20250102")


def test_rows_are_those_of_tensorboard(tmp_path, wandb):
    Training(tmp_path).steps(40)
    for member in (0, 1):
        assert rows_of(wandb, member) == rows_until(40, member)


def test_an_interval_that_was_cut_short_is_no_row(tmp_path, wandb):
    with records.Records(tmp_path, members_of(3), [], tensorboard=False) as tables:
        tables.track(open_runs(tmp_path, members_of(3), [], "proj", pytest.fail))
        tables.report(report(20, None, {"q_std": [0.5]}))
    assert wandb.server == {}


def test_fields_without_a_value_are_left_out(tmp_path, wandb):
    with records.Records(tmp_path, members_of(3, 5), [], tensorboard=False) as tables:
        tables.track(open_runs(tmp_path, members_of(3, 5), [], "proj", pytest.fail))
        tables.report(report(20, [[1.0], [float("nan")]], {"q_std": [float("nan"), 0.5]}))
    assert "train/q_std" not in rows_of(wandb, 0)[0][1]
    assert rows_of(wandb, 1)[0][1].keys() == {"train/q_std", "eval/episode_length_mean"}


@settings(max_examples=15)
@given(
    st.lists(
        st.tuples(st.sampled_from(["online", "offline"]), st.integers(0, 5), st.booleans(), st.booleans()),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from(["online", "offline"]),
)
def test_no_row_comes_twice_and_none_is_lost_whatever_was_killed_and_wherever_it_is_resumed(
    tmp_path_factory, processes, last
):
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        wandb = FakeWandb()
        patch.setitem(sys.modules, "wandb", wandb)
        training = Training(folder)
        for mode, evaluations, complete, synced in processes:
            wandb.mode = mode
            start = training.checkpoint[0] if training.checkpoint else 0
            training.steps(min(start + 10 * evaluations, END), complete)
            if synced:
                wandb.sync(folder)
        wandb.mode = last
        training.steps(END)
        wandb.sync(folder)
    assert training.lines == []
    for member in (0, 1):
        assert rows_of(wandb, member) == rows_until(END, member)


def test_a_kill_between_a_row_and_its_record_does_not_double_it(tmp_path, wandb):
    class Killed(Exception):
        pass

    wandb.mode, training = "offline", Training(tmp_path)
    training.steps(20)
    sent = []

    def kill(step):
        assert json.loads((tmp_path / "wandb.json").read_text())["env_steps"] == step
        sent.append(step)
        if len(sent) == 3:  # the second row of the first member
            raise Killed

    wandb.before_row = kill
    training.steps(50, complete=False)
    wandb.before_row = lambda step: None
    training.steps(END)
    wandb.sync(tmp_path)
    for member, steps in ((0, {40}), (1, {40})):
        expected = [row for row in rows_until(END, member) if row[0] not in steps]
        assert rows_of(wandb, member) == expected


def test_rows_from_before_the_flag_was_given_are_sent(tmp_path, wandb):
    training = Training(tmp_path)
    wandb.mode = "disabled"
    training.steps(60)
    assert wandb.server == {} and training.lines == [] and not (tmp_path / "wandb.json").exists()
    wandb.mode = "online"
    training.steps(END)
    assert rows_of(wandb, 1) == rows_until(END, 1)


# What goes wrong


def opened(folder, lines, count=2):
    return open_runs(folder, members_of(*range(count)), [], "proj", lines.append)


def test_without_a_project_the_package_is_not_imported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert open_runs(tmp_path, members_of(3), [], "", pytest.fail) is None


@pytest.mark.parametrize("module", [None, type(sys)("wandb")], ids=["missing", "a folder called wandb"])
def test_a_missing_package_is_one_line(tmp_path, monkeypatch, module):
    lines = []
    monkeypatch.setitem(sys.modules, "wandb", module)
    assert opened(tmp_path, lines) is None
    assert lines == [
        "--wandb: expects the package wandb; pip install 'sqt_jax[wandb]'; training continues without it",
    ]


def test_a_missing_login_is_one_line(tmp_path, wandb):
    lines, wandb.logged_in = [], False
    assert opened(tmp_path, lines) is None and wandb.runs == []
    assert lines == [
        "--wandb: no login; expects `wandb login`, WANDB_API_KEY, or WANDB_MODE=offline; training continues without it"
    ]
    assert [name for name, _ in wandb.calls] == ["setup", "teardown"]


def test_the_packages_process_logs_to_the_runs_folder_and_our_variables_stay_as_they_were(tmp_path, wandb, monkeypatch):
    seen, setup, before = {}, wandb.setup, dict(os.environ)
    monkeypatch.setattr(wandb, "setup", lambda settings: seen.update(os.environ) or setup(settings))
    opened(tmp_path, [])
    assert (seen["WANDB_CACHE_DIR"], seen["WANDB_ERROR_REPORTING"]) == (str(tmp_path), "false")
    assert dict(os.environ) == before


def test_offline_needs_no_login(tmp_path, wandb):
    wandb.mode, wandb.logged_in = "offline", False
    runs = opened(tmp_path, [])
    assert runs.where == f"W&B is offline: `wandb sync {tmp_path}/wandb/offline-run-*` sends the rows later"


def test_too_many_members_are_one_line(tmp_path, wandb):
    lines = []
    assert opened(tmp_path, lines, 201) is None and wandb.calls == []
    assert lines == ["--wandb: expects at most 200 members, a run each, not 201; training continues without it"]


def test_an_error_of_the_server_is_one_line(tmp_path, wandb, monkeypatch):
    def fails(**arguments):
        raise OSError("no route\nto host")

    lines = []
    monkeypatch.setattr(wandb, "init", fails)
    assert opened(tmp_path, lines) is None
    assert lines == ["--wandb: OSError: no route to host; training continues without it"]
    assert wandb.calls[-1][0] == "teardown"


def test_a_server_that_does_not_answer_costs_the_limit(tmp_path, wandb, monkeypatch):
    lines, gate = [], threading.Event()
    monkeypatch.setattr(wandb_runs, "OPEN_SECONDS", 0.1)
    monkeypatch.setattr(wandb, "init", lambda **arguments: gate.wait())
    assert opened(tmp_path, lines) is None
    assert lines == ["--wandb: TimeoutError: no answer within 0.1 seconds; training continues without it"]
    gate.set()


@pytest.mark.parametrize("how", ["raises", "hangs"])
def test_rows_that_cannot_be_sent_are_one_line_and_the_last_try(tmp_path, wandb, monkeypatch, how):
    lines, tries, gate = [], [], threading.Event()
    runs = opened(tmp_path, lines)
    monkeypatch.setattr(wandb_runs, "SEND_SECONDS", 0.1)

    def fails(step):
        tries.append(step)
        if how == "raises":
            raise ConnectionResetError("Connection lost")
        gate.wait()

    wandb.before_row = fails
    for step in (0, 10):
        runs.add([{"x": 1.0}, {"x": 1.0}], step)
    runs.close([0, 0])
    why = "ConnectionResetError: Connection lost" if how == "raises" else "TimeoutError: no answer within 0.1 seconds"
    assert lines == [f"no more rows for W&B, evaluations.csv has them: {why}"] and tries == [0]
    gate.set()


def test_a_full_disk_ends_the_rows_since_wandb_json_could_not_prevent_doubles(tmp_path, wandb, monkeypatch):
    lines = []
    runs = opened(tmp_path, lines)

    def full(folder, sent):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(wandb_runs.wandb_file, "write", full)
    runs.add([{"x": 1.0}, {"x": 1.0}], 10)
    assert wandb.server == {} and lines == [
        "no more rows for W&B, evaluations.csv has them: OSError: [Errno 28] No space left on device"
    ]


@pytest.mark.parametrize(("code", "limit"), [(0, 0.2), (130, 0.1)], ids=["at the end", "after a signal"])
def test_runs_that_cannot_be_ended_are_one_line(tmp_path, wandb, monkeypatch, code, limit):
    lines, gate = [], threading.Event()
    runs = opened(tmp_path, lines)
    monkeypatch.setattr(wandb_runs, "CLOSE_SECONDS", 0.2)
    monkeypatch.setattr(wandb_runs, "STOP_SECONDS", 0.1)
    monkeypatch.setattr(wandb, "teardown", gate.wait)
    wandb.before_finish = gate.wait
    runs.close([code, code])
    assert lines == [
        f"W&B may lack the last rows, evaluations.csv has them: TimeoutError: no answer within {limit} seconds"
    ]
    gate.set()


@pytest.mark.parametrize(
    ("ended", "codes"),
    [({}, [0, 0]), ({"diverged": {1: 10}}, [0, 3]), ({"interrupted": True}, [130, 130]), (None, [1, 1])],
)
def test_a_run_ends_with_the_exit_code_of_its_member(tmp_path, wandb, ended, codes):
    with contextlib.suppress(ZeroDivisionError), records.Records(tmp_path, members_of(3, 5), [], False) as tables:
        tables.track(open_runs(tmp_path, members_of(3, 5), [], "proj", pytest.fail))
        tables.report(report(0, [[1.0], [2.0]]))
        tables.summary(outcome(**ended)) if ended is not None else 1 / 0
    assert [run.exit_code for run in sorted(wandb.runs, key=lambda run: run.id)] == codes


def test_the_callers_own_runs_are_left_alone(tmp_path, wandb, monkeypatch):
    monkeypatch.setenv("WANDB_SERVICE", "3-1-unix-socket")
    runs = opened(tmp_path, [])
    runs.close([0, 0])
    assert wandb.calls == [("setup", None)]
    assert [run.exit_code for run in wandb.runs] == [0, 0]


# A run from its command line

TINY = (
    "--algo=td3_sqt --env=ant --seeds=3,1 --warmup_steps=30 --eval_every=50 --eval_episodes=1 --batch_size=8 "
    "--hidden=8,8 --name=run --checkpoint_every=50 --notensorboard"
)


@pytest.mark.usefixtures("shared_programs", "tiny_tasks")
@pytest.mark.slow
def test_a_run_and_its_resumption_send_each_row_once(tmp_path, wandb, capsys):
    def run(*arguments):
        assert main(["experiments.run", *TINY.split(), f"--out={tmp_path}", "--resume", *arguments]) == 0
        return capsys.readouterr().out

    path = tmp_path / "ant" / "td3_sqt" / "run"
    assert "W&B: the group ant/td3_sqt/run of https://wandb.test/me/ants\n" in run("--steps=60", "--wandb=ants")
    run("--steps=120")
    names = [f"{json.loads((path / 'wandb.json').read_text())['id']}-{member}" for member in (0, 1)]
    assert sorted(wandb.server) == names and len(wandb.runs) == 4
    table = records.read_evaluations(path / "evaluations.csv")
    for member, name in enumerate(names):
        steps, rows = zip(*wandb.server[name], strict=True)
        assert list(steps) == [0, 50, 60, 100, 120]
        for column, key in (("return_mean", "eval/return_mean"), ("q_std", "train/q_std")):
            values = records.of_member(table, member, column)
            assert [row[key] for row in rows[1:]] == list(values[1:])
    assert json.loads((path / "config.json").read_text())["output"]["wandb"] == "ants"
