"""A resumed run ends like a run without a break."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys

import jax
import pytest
from made_runs import write_run
from test_cli import rows_of, run

from experiments.commandline.arguments import UsageError
from experiments.endurance.run_results import differences, read_results
from experiments.run import main
from experiments.running import checkpoints, loop, records, resume, run_config, session
from sqt_jax.envs import physics

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

MEMBERS = ("--penalty_coef=0,0.5", "--checkpoint_every=20")


def path_in(out):
    return out / "ant" / "sac_sqt" / "run"


def resumed(out, *arguments):
    return main(["experiments.run", f"--resume={path_in(out)}", *arguments])


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """The folder of a run without a break."""
    out = tmp_path_factory.mktemp("unbroken")
    assert run(out, *MEMBERS) == 0
    return out


@pytest.mark.slow
@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="one device only")
def test_a_run_resumes_on_another_number_of_devices(tmp_path):
    assert run(tmp_path, *MEMBERS, "--steps=80", "--devices=2") == 0
    assert json.loads((path_in(tmp_path) / "config.json").read_text())["output"]["devices"] == 2
    assert resumed(tmp_path, "--devices=1", "--steps=120") == 0
    assert json.loads((path_in(tmp_path) / "config.json").read_text())["output"]["devices"] == 1
    assert {row["env_steps"] for row in rows_of(path_in(tmp_path) / "evaluations.csv")} >= {"0", "80", "120"}


def interrupted(out, monkeypatch, at, *more, by=signal.SIGTERM):
    """A run that gets a signal when the evaluation or the checkpoint of step `at` has been made."""

    sent = []

    def then(original, env_steps_of):
        def method(self, *arguments):
            original(self, *arguments)
            if env_steps_of(arguments) == at and not sent:  # a second signal would end the process at once
                sent.append(by)
                os.kill(os.getpid(), by)

        return method

    with monkeypatch.context() as patch:
        patch.setattr(records.Records, "report", then(records.Records.report, lambda given: given[0].env_steps))
        patch.setattr(
            checkpoints.CheckpointStore,
            "save",
            then(checkpoints.CheckpointStore.save, lambda given: given[1].env_steps),
        )
        assert run(out, *MEMBERS, *more) == 130
    summary = json.loads((path_in(out) / "summary.json").read_text())
    assert (summary["status"], summary["env_steps"]) == ("interrupted", at)


@pytest.mark.parametrize(
    ("at", "by"),
    [
        pytest.param(0, signal.SIGINT, marks=pytest.mark.slow),
        pytest.param(20, signal.SIGTERM, marks=pytest.mark.slow),
        (50, signal.SIGTERM),
        (80, signal.SIGINT),
        pytest.param(100, signal.SIGTERM, marks=pytest.mark.slow),
    ],
    ids=["at the first evaluation", "in the warm-up", "at an evaluation", "between two", "at both"],
)
def test_an_interrupted_run_ends_like_a_run_without_a_break(tmp_path, monkeypatch, capsys, unbroken, at, by):
    interrupted(tmp_path, monkeypatch, at, by=by)
    assert f"--resume={path_in(tmp_path)}" in capsys.readouterr().out
    assert resumed(tmp_path) == 0
    assert f"resuming at step {at}" in capsys.readouterr().out
    assert differences(read_results(path_in(unbroken)), read_results(path_in(tmp_path))) == []
    summary = json.loads((path_in(tmp_path) / "summary.json").read_text())
    assert (summary["status"], summary["env_steps"]) == ("done", 120)
    seconds = [float(row["wall_seconds"]) for row in rows_of(path_in(tmp_path) / "evaluations.csv")]
    assert seconds == sorted(seconds)
    config = json.loads((path_in(tmp_path) / "config.json").read_text())
    assert [entry["env_steps"] for entry in config["resumed"]] == [at]


@pytest.mark.slow
@pytest.mark.parametrize("at", [20, 80])
def test_the_statistics_of_observations_are_resumed(tmp_path, monkeypatch, at):
    """In the warm-up and in training."""
    assert run(tmp_path / "unbroken", *MEMBERS, "--normalize_observations") == 0
    interrupted(tmp_path, monkeypatch, at, "--normalize_observations")
    assert resumed(tmp_path) == 0
    results = read_results(path_in(tmp_path / "unbroken"))
    assert differences(results, read_results(path_in(tmp_path))) == []
    assert results["policy/member_3/moments/variance"].min() > 0.1  # of uniform observations in [-1, 1]: 1/3


def test_the_same_command_with_resume_starts_the_run_and_resumes_it(tmp_path, monkeypatch, unbroken):
    interrupted(tmp_path, monkeypatch, 80)
    assert run(tmp_path, *MEMBERS, "--resume") == 0
    assert differences(read_results(path_in(unbroken)), read_results(path_in(tmp_path))) == []
    assert run(tmp_path / "new", *MEMBERS, "--resume") == 0
    assert differences(read_results(path_in(unbroken)), read_results(path_in(tmp_path / "new"))) == []


def content(folder):
    """The files below a folder, without locks: they say which process was the last."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}


def test_a_finished_run_does_not_change(tmp_path, unbroken):
    assert run(tmp_path, *MEMBERS) == 0
    before = content(tmp_path)
    assert resumed(tmp_path) == 0
    assert content(tmp_path) == before
    for name in ("policy", "policy_best"):
        shutil.rmtree(path_in(tmp_path) / name)  # as after a full disk
        assert resumed(tmp_path) == 0
        assert content(tmp_path).keys() >= before.keys()


def test_a_finished_run_is_resumed_for_more_steps(tmp_path):
    assert run(tmp_path, *MEMBERS) == 0
    path = path_in(tmp_path)
    before = rows_of(path / "evaluations.csv")
    assert resumed(tmp_path, "--steps=200") == 0
    rows = rows_of(path / "evaluations.csv")
    assert rows[: len(before)] == before
    assert [int(row["env_steps"]) for row in rows[::4]] == [0, 50, 100, 120, 150, 200]
    config = json.loads((path / "config.json").read_text())
    assert (config["settings"]["steps"], config["replay_rows"]) == (200, 120)
    assert read_results(path)["rows"].shape[1] == 120
    assert int(read_results(path)["replay/inserted"]) == 200
    # Again, with its new number of steps.
    assert resumed(tmp_path, "--steps=200") == 0


def test_a_diverged_member_stays_diverged(tmp_path, capsys):
    assert run(tmp_path, "--penalty_coef=0,1e38", "--checkpoint_every=20") == 3
    first = json.loads((path_in(tmp_path) / "summary.json").read_text())["diverged"]
    assert [entry["member"] for entry in first] == [2, 3]
    capsys.readouterr()
    assert resumed(tmp_path, "--steps=200") == 3
    summary = json.loads((path_in(tmp_path) / "summary.json").read_text())
    assert summary["diverged"] == first and summary["status"] == "diverged"
    assert "diverged at" not in capsys.readouterr().out  # it was reported before
    late = [row for row in rows_of(path_in(tmp_path) / "evaluations.csv") if row["env_steps"] == "200"]
    assert [row["return_mean"] for row in late] == ["5.0", "5.0", "", ""]


def test_a_run_without_checkpoints_is_rejected_and_not_changed(tmp_path, capsys):
    assert run(tmp_path, *MEMBERS, "--checkpoint_every=0") == 0
    assert not (path_in(tmp_path) / "checkpoint").exists()
    before = content(tmp_path)
    capsys.readouterr()
    assert resumed(tmp_path, "--checkpoint_every=20") == 2
    assert "expects a run with checkpoints to resume from; it has none" in capsys.readouterr().err
    assert content(tmp_path) == before


@pytest.mark.parametrize(("reached", "rejected"), [(0, False), (50, False), (100, False), (150, True)])
def test_a_run_that_lost_its_checkpoints_does_not_start_again(tmp_path, reached, rejected):
    """Evaluations every 50 steps, checkpoints every 50: the row of step 100 exists before the second checkpoint."""
    path = write_run(tmp_path, curves=[range(reached // 50 + 1)])
    if not rejected:
        resume.check_may_restart(path, 50)
        return
    with pytest.raises(UsageError) as error:
        resume.check_may_restart(path, 50)
    assert str(error.value) == (
        f"--resume={path}: expects a run with checkpoints to resume from; it has none, and its evaluations reach step "
        "150; remove the folder to start again"
    )


def test_tables_that_cannot_be_written_are_named_by_the_flag_of_their_folder(tmp_path, monkeypatch, capsys):
    def fails(*_):
        raise OSError(30, "Read-only file system")

    with monkeypatch.context() as patch:
        patch.setattr(records, "Records", fails)
        for _ in range(2):  # a new run, then the one whose config.json it has left
            again = path_in(tmp_path).exists()
            assert run(tmp_path, *MEMBERS, *(["--resume"] if again else [])) == 2
            flag = f"--resume={path_in(tmp_path)}" if again else f"--out={tmp_path}"
            line = capsys.readouterr().err
            assert line.startswith(f"{flag}: expects a folder that can be written: ") and "Read-only" in line


@pytest.mark.parametrize("where", ["run_config.write", "Records", "train_loop"])
def test_a_run_that_died_before_its_first_checkpoint_starts_again(tmp_path, monkeypatch, unbroken, where):
    """Wherever it died, the same command with --resume starts it again."""

    class Killed(BaseException):
        pass

    def die(*_, **__):
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        target = {"run_config.write": run_config, "Records": records, "train_loop": session}[where]
        patch.setattr(target, where.split(".")[-1], die)
        run(tmp_path, *MEMBERS)
    assert run(tmp_path, *MEMBERS, "--resume") == 0
    assert differences(read_results(path_in(unbroken)), read_results(path_in(tmp_path))) == []


def test_a_signal_in_the_last_chunk_changes_nothing(tmp_path, monkeypatch, unbroken):
    """The last step is made, and its evaluation is not."""

    def stopped(*arguments, stop, **options):
        original = arguments[0].advance
        last = []

        def advance(state, steps, learn):
            state = original(state, steps, learn)
            last.append(int(state.env_steps))
            return state

        return loop.train_loop(
            arguments[0]._replace(advance=advance),
            *arguments[1:],
            stop=lambda: bool(last) and last[-1] == 120,
            **options,
        )

    with monkeypatch.context() as patch:
        patch.setattr(session, "train_loop", stopped)
        assert run(tmp_path, *MEMBERS) == 130
    assert resumed(tmp_path) == 0
    assert differences(read_results(path_in(unbroken)), read_results(path_in(tmp_path))) == []


@pytest.mark.slow
def test_invalid_steps_are_rejected_and_the_run_does_not_change(tmp_path, capsys):
    assert run(tmp_path, *MEMBERS, "--num_envs=2", "--checkpoint_every=20") == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert resumed(tmp_path, "--steps=141") == 2
    assert capsys.readouterr().err.startswith("--steps: expects a multiple of num_envs (2), not 141")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_resumed_run_has_no_summary_until_it_ends(tmp_path, monkeypatch):
    assert run(tmp_path, *MEMBERS) == 0
    seen = []

    def looked_at(*arguments, **options):
        names = ("summary.json", "policy", "policy_best")
        seen.append([name for name in names if (path_in(tmp_path) / name).exists()])
        return loop.train_loop(*arguments, **options)

    monkeypatch.setattr(session, "train_loop", looked_at)
    assert resumed(tmp_path, "--steps=200", "--keep_checkpoints=3") == 0
    assert seen == [[]]  # until then the policies are the checkpoints'
    assert json.loads((path_in(tmp_path) / "config.json").read_text())["output"]["keep_checkpoints"] == 3


def test_a_resumed_run_is_evaluated_on_the_physics_of_its_start(tmp_path, monkeypatch):
    """Whatever --eval_physics=auto would choose on this machine, which is mujoco on a CPU."""
    path = write_run(tmp_path, physics="mujoco", versions=run_config.versions())
    content = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(content | {"evaluated_on": "mjx"}))
    for wanted in ({}, {"eval_physics": "auto"}):  # its own setting has not changed
        run = resume.check(path, resume.read(path), wanted)
        assert {member.config.eval_physics for member in run.members} == {"mjx"}
        assert run.content["settings"]["eval_physics"] == "auto"
    monkeypatch.setitem(physics.LACKS, "mjx", lambda: "a part")
    with pytest.raises(UsageError, match="^--eval_physics: mjx needs a part"):
        resume.check(path, resume.read(path), {})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "env", "physics"),
    [
        *itertools.product(["td3_sqt", "sac_sqt_tuple", "td7_sqt"], ["cheetah"], ["mjx", "mujoco"]),
        ("td3_sqt", "brax:reacher", "mjx"),
    ],
)
def test_the_command_resumes_on_every_physics(tmp_path, algo, env, physics):
    command = [sys.executable, "-m", "experiments.run", f"--algo={algo}", f"--env={env}", f"--physics={physics}"]
    command += ["--seeds=0,1", "--warmup_steps=50", "--eval_every=60", "--eval_episodes=1", "--batch_size=16"]
    command += ["--hidden=16,16", "--checkpoint_every=30", "--name=run", "--quiet"]

    def train(folder, *more):
        done = subprocess.run([*command, f"--out={folder}", *more], capture_output=True, text=True, timeout=600)
        assert (done.returncode, done.stderr) == (0, "")
        return folder / env / algo / "run"

    unbroken = train(tmp_path / "unbroken", "--steps=150", "--replay_capacity=90")
    train(tmp_path / "parts", "--steps=120", "--replay_capacity=90")
    parts = train(tmp_path / "parts", "--steps=150", "--replay_capacity=90", "--resume")
    assert differences(read_results(unbroken), read_results(parts)) == []
