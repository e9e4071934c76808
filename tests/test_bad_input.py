"""Invalid input: one line that names the flag, exit code 2, and nothing is written or changed."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.run import main

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

NEW = (
    "--algo=sac_sqt --env=ant --seeds=3,1 --steps=60 --warmup_steps=20 --eval_every=30 --eval_episodes=1 "
    "--batch_size=8 --hidden=8,8 --checkpoint_every=20 --notensorboard --quiet"
)
RUN = Path("runs/ant/sac_sqt/run")


def run(*arguments):
    return main(["experiments.run", *arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder `runs` with a finished run in it."""
    out = tmp_path_factory.mktemp("finished") / "runs"
    assert run(*NEW.split(), "--name=run", f"--out={out}") == 0
    return out


@pytest.fixture
def folder(finished, tmp_path, monkeypatch):
    """The working directory: a copy of the finished run, and files that do not belong to a run."""
    shutil.copytree(finished, tmp_path / "runs")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def snapshot(path):
    """The contents of a folder: names, bytes and the targets of links. Of a lock only that it is a file."""
    found = {}
    for item in path.rglob("*"):
        link = item.readlink() if item.is_symlink() else None
        content = "folder or device" if not item.is_file() else "lock" if item.name == "lock" else item.read_bytes()
        found[item.relative_to(path)] = link or content
    return found


def rejected(folder, capsys, arguments, begins, expects):
    """Expects one line with this beginning and rest, and no change to any file."""
    before = snapshot(folder)
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.endswith("\n") and err.count("\n") == 1 and err[:-1].isprintable(), err
    assert err.startswith(begins) and re.search(expects, err[len(begins) :]), err
    assert snapshot(folder) == before


# The text of one flag

FLAGS = [
    ("--wibble", "--wibble: unknown flag", "--help"),
    ("--stepz=5", "--stepz: unknown flag", "did you mean --steps"),
    ("--nosteps", "--nosteps: unknown flag", "did you mean --steps"),
    ("--flagfile=file", "--flagfile: unknown flag", "--help"),
    ("--undefok=stepz", "--undefok: unknown flag", "--help"),
    ("--steps", "--steps:", "expects a whole number"),
    ("extra", "extra:", "--flag=value"),
    ("--steps=many", "--steps=many:", "expects a whole number"),
    ("--steps=1.5", "--steps=1.5:", "expects a whole number"),
    ("--steps=nan", "--steps=nan:", "expects a whole number"),
    ("--steps=1\x1b[31m", "--steps=1\\x1b[31m:", "expects a whole number"),
    ("--steps=0", "--steps:", "expects a whole number from 1 to"),
    ("--steps=1e300", "--steps:", "expects a whole number from 1 to"),
    ("--steps=" + "9" * 5000, "--steps=", "expects a whole number"),
    ("--ddof=" + "9" * 400, "--ddof:", "at most 2147483647"),
    ("--policy_delay=1e12", "--policy_delay:", "at most 2147483647"),
    ("--updates_per_step=-1", "--updates_per_step:", "at least 1"),
    ("--penalty_coef=1e39", "--penalty_coef:", "at most 3.4e"),
    ("--penalty_coef=-0.1", "--penalty_coef:", "at least 0"),
    ("--lr=nan", "--lr=nan:", "expects a number"),
    ("--lr=inf", "--lr=inf:", "expects a number"),
    ("--lr=0.1,,0.2", "--lr=0.1,,0.2:", "expects a number"),
    ("--lr=1e-3,1e-3", "--lr:", "expects each value once"),
    ("--gamma=1.01", "--gamma:", "expects a number from 0 to 1"),
    ("--hidden=8,wide", "--hidden=8,wide:", "expects whole numbers"),
    ("--hidden=8,0", "--hidden:", "expects layer widths"),
    ("--hidden=" + ",".join(["8"] * 1000), "--hidden:", "up to 32"),
    ("--train_encoder=maybe", "--train_encoder=maybe:", "expects true or false"),
    ("--temperature=warm", "--temperature=warm:", "or auto"),
    ("--reduce=max", "--reduce:", "expects one of min, mean"),
    ("--seeds=-1", "--seeds=-1:", "expects whole numbers from 0"),
    ("--seeds=4294967296", "--seeds=4294967296:", "expects whole numbers from 0"),
    ("--seeds=0,1,0", "--seeds:", "expects each value once"),
    ("--seeds=" + ",".join(map(str, range(10_001))), "--seeds:", "expects at most 10000 members"),
    ("--algo=sac_sqtt", "--algo:", "expects one of td3"),
    ("--env=antt", "--env:", "expects one of cheetah"),
    ("--env=brax:antt", "--env:", "expects one of"),
    ("--physics=warp9", "--physics:", "expects one of mjx"),
    ("--eval_physics=warp9", "--eval_physics:", "expects one of auto"),
    ("--preset=fast", "--preset=fast:", "expects one of paper"),
    ("--checkpoint_every=-20", "--checkpoint_every:", "at least 0"),
    ("--checkpoint_every=often", "--checkpoint_every=often:", "expects a whole number"),
    ("--keep_checkpoints=0", "--keep_checkpoints:", "at least 1"),
    ("--devices=0", "--devices:", "at least 1"),
    ("--devices=two", "--devices=two:", "a whole number"),
    ("--devices=1000", "--devices=1000:", " here"),
    ("--name=a/b", "--name=a/b:", "no slashes"),
    ("--name=..", "--name=..:", "no slashes"),
    ("--name=a\nb", "--name=a\\nb:", "no slashes or control characters"),
    ("--name=" + "x" * 300, "--name=xxx", "expects up to 200 bytes"),
    ("--name=run", "--name=run:", "expects another name"),
    ("--out=", "--out=:", "expects a folder"),
    ("--out=file", "--out=file:", "expects a folder that can be written"),
    ("--out=/proc/none", "--out=/proc/none:", "expects a folder that can be written"),
    ("--out=" + "x" * 300, "--out=xxx", "expects a folder"),
    ("--out=a\0b", "--out=a\\x00b:", "expects a folder"),
]


def short(value):
    return ascii(value)[1:40]


@pytest.mark.parametrize(("argument", "begins", "expects"), FLAGS, ids=[short(row[0]) for row in FLAGS])
def test_an_invalid_flag_is_rejected(folder, capsys, argument, begins, expects):
    rejected(folder, capsys, [*NEW.split(), argument], begins, expects)


# Flags that exclude each other

TOGETHER = [
    ("--algo=sac --penalty_coef=0.5", "--penalty_coef:", "has no effect with sac"),
    ("--algo=td3_sqt --temperature=0.1,0.2", "--temperature:", "has no effect with td3_sqt"),
    ("--algo=td7 --num_envs=2", "--num_envs:", "expects 1 for td7"),
    ("--num_envs=7", "--steps:", "expects a multiple of num_envs"),
    (
        "--num_envs=20 --eval_every=20 --checkpoint_every=30",
        "--checkpoint_every:",
        r"expects a multiple of num_envs \(20",
    ),
    ("--ensemble_size=1", "--ensemble_size:", "expects at least 2"),
    ("--ensemble_size=3 --ddof=3", "--ddof:", "below the ensemble_size"),
    ("--reduce=subset_min --subset_size=3", "--subset_size:", "expects at most the ensemble_size"),
    ("--batch_size=50 --replay_capacity=40", "--batch_size:", "expects at most the replay's capacity"),
    ("--warmup_steps=60", "--warmup_steps:", "expects fewer than the run's steps"),
    ("--networks=sale --temperature=auto", "--temperature:", "expects a number with"),
    ("--preset=released --networks=mlp", "--", "by --preset=released"),
    ("--env=brax:ant --physics=mujoco", "--physics:", "expects one of"),
    ("--steps=2e9 --replay_capacity=2e9", "--replay_capacity=", "expects a smaller number"),
    ("--resume --overwrite", "--overwrite:", "expects no --resume"),
]


@pytest.mark.parametrize(("arguments", "begins", "expects"), TOGETHER, ids=[row[0] for row in TOGETHER])
def test_flags_that_exclude_each_other_are_rejected(folder, capsys, arguments, begins, expects):
    rejected(folder, capsys, [*NEW.split(), *arguments.split()], begins, expects)


# --config=FILE

DEEP = "\n".join(["a: &a [x]", *(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi"))])  # noqa: B905
MERGED = DEEP.replace("[x]", "{x: 1}").replace("[*", "{<<: [*").replace("]", "]}")
FILES = {
    "truncated": ("steps: [5", "expects a YAML file"),
    "twice": ("steps: 5\nseeds: 1\nsteps: 6", "expects each setting once, not steps 2 times"),
    "list": ("- steps", "expects lines like"),
    "word": ("steps", "expects lines like"),
    "nothing": ("", "expects lines like"),
    "unknown": ("stepz: 5", "did you mean --steps"),
    "absl's": ("undefok: stepz", "unknown flag"),
    "value": ("steps: many", "expects a whole number"),
    "range": ("gamma: 2", "expects a number from 0 to 1"),
    "nan": ("lr: .nan", "expects a number"),
    "date": ("steps: 2025-99-99", "expects a whole number"),
    "tagged": ("steps: !!bool perhaps", "expects a whole number"),
    "mapping": ("steps: {a: 5}", "steps expects a number, a word"),
    "null": ("steps:", "steps expects a number, a word"),
    "number": ("5: 6", "unknown flag"),
    "resume": ("resume: runs", "resume is for the command line"),
    "zero": ('out: "a\\0b"', "expects a folder"),
    "surrogate": ('out: "\\ud800"', "expects a folder"),
    "python": ("steps: !!python/object/apply:os.system ['touch hacked']", "expects a whole number"),
    "laughs": (DEEP, "expects a number, a word"),
    "merged": (MERGED, "expects a number, a word"),
    "deep": ("steps: " + "[" * 2000, "expects a YAML file"),
    "large": ("#" * 200_000, "expects a file of at most 100000 bytes"),
    "binary": (bytes(range(256)), "expects a YAML file"),
    "latin1": ("name: é".encode("latin1"), "expects a YAML file"),
}


@pytest.mark.parametrize("case", FILES)
def test_an_invalid_file_of_flags_is_rejected(folder, capsys, case):
    content, expects = FILES[case]
    (folder / "flags.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    given = [word for word in NEW.split() if not word.startswith("--steps")]  # the command line would override it
    rejected(folder, capsys, [*given, "--config=flags.yaml"], "--", expects)


@pytest.mark.parametrize("path", ["none.yaml", "empty", "/dev/zero", "x" * 300, "fifo", "lön\x07k"])
def test_a_path_that_is_no_file_is_rejected(folder, capsys, path):
    os.mkfifo(folder / "fifo")
    rejected(
        folder, capsys, [*NEW.split(), f"--config={path}"], "--config=", "expects a file|no such file|cannot be read"
    )


# --resume=DIR


def settings(**changes):
    def change(config):
        config["settings"] |= changes

    return change


def entries(**changes):
    return lambda config: config.update(changes)


def member(**changes):
    def change(config):
        config["members"][1] |= changes

    return change


def without(key):
    return lambda config: config.pop(key)


# Changes of config.json.
CHANGED = {
    "unknown setting": (settings(stepz=5), "--stepz: is not a setting"),
    "setting out of range": (settings(gamma=2), "--gamma: expects a number from 0 to 1"),
    "setting of no kind": (settings(hidden={"a": 1}), "--hidden: expects layer widths"),
    "setting too large": (settings(ddof=10**400), "--ddof: expects"),
    "layers without end": (settings(hidden=[8] * 10_000), "--hidden: expects layer widths"),
    "no algorithm": (settings(algo="ppo"), "--algo: expects one of"),
    "another environment": (settings(env="/etc/passwd"), "--env: expects one of"),
    "steps that are a list": (settings(steps=[60]), "--steps: expects"),
    "no settings": (without("settings"), "does not describe a run"),
    "settings that are a list": (entries(settings=[1]), "does not describe a run"),
    "no members": (entries(members=[]), "does not describe a run"),
    "members without end": (entries(members=[{"seed": 1}] * 20_000), "does not describe a run"),
    "members that are a number": (entries(members=10**9), "does not describe a run"),
    "seed that is a word": (member(seed="one"), "does not describe a run"),
    "seed too large": (member(seed=2**32), "does not describe a run"),
    "seed that is true": (member(seed=True), "does not describe a run"),
    "swept setting": (entries(swept=["hidden"]), "does not describe a run"),
    "swept twice": (entries(swept=["lr", "lr"]), "does not describe a run"),
    "swept without values": (entries(swept=["lr"]), "does not describe a run"),
    "replay too large": (entries(replay_rows=10**400), "an invalid replay capacity"),
    "replay without rows": (entries(replay_rows=0), "an invalid replay capacity"),
    "replay of no size": (entries(replay_rows=None), "does not describe a run"),
    "output that is a list": (entries(output=[]), "does not describe a run"),
    "nan": (entries(device=float("nan")), "does not describe a run"),
    "infinity": (entries(device=float("inf")), "does not describe a run"),
    "another algorithm": (settings(algo="sac", penalty="none", penalty_coef=0.0), "these differ: algo"),
    "another version": (entries(versions={"sqt_jax": "9.9.0\x1b"}), "expects a run of sqt_jax"),
    "no version": (entries(versions={}), "expects a run of sqt_jax"),
}


@pytest.mark.parametrize("case", CHANGED)
def test_a_run_with_invalid_settings_is_rejected(folder, capsys, case):
    change, expects = CHANGED[case]
    config = json.loads((RUN / "config.json").read_text())
    change(config)
    (RUN / "config.json").write_text(json.dumps(config))
    algo = ["--algo=sac_sqt"] if case == "another algorithm" else []
    rejected(folder, capsys, [f"--resume={RUN}", *algo], f"--resume={RUN}:", expects)


def replaced_by(content):
    def damage(path):
        path.unlink()
        path.write_bytes(content)

    return damage


def linked(name):
    def damage(path):
        item = path.parent / name
        outside = Path("outside").absolute()
        item.rename(outside) if item.exists() else outside.mkdir()
        item.symlink_to(outside)

    return damage


def truncated(path):
    path.write_bytes(path.read_bytes()[:-10])


def a_folder(name):
    def damage(path):
        (path.parent / name).unlink()
        (path.parent / name).mkdir()

    return damage


# Damage to a run's folder, as a function of its config.json.
DAMAGED = {
    "no config": (Path.unlink, "it has no config.json"),
    "truncated": (truncated, "does not describe a run"),
    "a list": (replaced_by(b"[1, 2]"), "does not describe a run"),
    "null": (replaced_by(b"null"), "does not describe a run"),
    "no JSON": (replaced_by(b"\x80\x04K\x01."), "does not describe a run"),
    "nothing": (replaced_by(b""), "does not describe a run"),
    "huge": (replaced_by(b" " * 10_000_001), "does not describe a run"),
    "deep": (replaced_by(b"[" * 100_000), "does not describe a run"),
    "deep in a list": (replaced_by(b'{"settings": ' + b"[" * 500 + b"]" * 500 + b"}"), "does not describe a run"),
    "long number": (replaced_by(b'{"settings": ' + b"9" * 5000 + b"}"), "does not describe a run"),
    "config is a folder": (a_folder("config.json"), "it has no config.json"),
    "config is a link": (linked("config.json"), "it has no config.json"),
    "table is a link": (linked("evaluations.csv"), "evaluations.csv in it is a link"),
    "curves are a link": (linked("curves.png"), "curves.png in it is a link"),
    "lock is a link": (linked("lock"), "lock in it is a link"),
    "lock is a folder": (a_folder("lock"), "expects a folder that can be written"),
    "checkpoint is a link": (linked("checkpoint"), "checkpoint in it is a link"),
    "policy is a link": (linked("policy"), "policy in it is a link"),
    "events are a link": (linked("tensorboard"), "tensorboard in it is a link"),
    "wandb is a link": (linked("wandb"), "wandb in it is a link"),
    "table is a folder": (a_folder("evaluations.csv"), "evaluations.csv has lost rows"),
    "table has lost rows": (lambda path: truncated(path.parent / "metrics.csv"), "metrics.csv has lost rows"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_run_is_rejected(folder, capsys, case):
    damage, expects = DAMAGED[case]
    damage(RUN / "config.json")
    further = ["--steps=160"] if case.startswith("table") else []  # otherwise the run is finished and not changed
    rejected(folder, capsys, [f"--resume={RUN}", *further], f"--resume={RUN}:", expects)


ITS_OWN = r"expects the run's own settings; these differ: "
# The run is complete; `RUN` stands for its folder, `NEW` for the flags that made it.
RESUMED = [
    ("--resume=none", "--resume=none:", "expects the folder of a run"),
    ("--resume=file", "--resume=file:", "expects the folder of a run"),
    ("--resume=empty", "--resume=empty:", "expects the folder of a run"),
    ("--resume=runs/ant", "--resume=runs/ant:", "expects the folder of a run"),
    ("--resume=" + "x" * 300, "--resume=xxx", "expects the folder of a run"),
    ("--resume=a\0b", "--resume=a\\x00b:", "expects a folder"),
    ("--resume=RUN --steps=50", "--resume=RUN:", r"expects at least the run's own --steps \(60\)"),
    ("--resume=RUN --lr=0.5", "--resume=RUN:", ITS_OWN + "lr .*0.5"),
    ("--resume=RUN --lr=0.5 --seeds=3 --algo=td3", "--resume=RUN:", ITS_OWN + "lr .*, algo .*, seeds "),
    ("--resume=RUN --env=antt", "--env:", "expects one of"),
    ("--resume=RUN --penalty_coef=0.1,0.2", "--resume=RUN:", ITS_OWN + "penalty_coef"),
    ("--resume=RUN --overwrite", "--overwrite:", "expects no --resume"),
    ("--resume=RUN --name=run", "--name:", "has no effect with --resume=RUN"),
    ("--resume=RUN --out=runs", "--out:", "has no effect with --resume=RUN"),
    ("--resume=RUN --keep_checkpoints=0", "--keep_checkpoints:", "at least 1"),
    ("NEW --resume --lr=0.5", "--resume:", "expects its folder: --resume=DIR"),
    ("NEW --resume --steps=50", "--resume:", "expects its folder: --resume=DIR"),
    ("NEW --resume --name=run --lr=0.5", "--resume=RUN:", ITS_OWN + "lr "),
    ("NEW --resume --out=" + "x" * 300, "--resume:", "expects"),
    ("NEW --resume --name=run --out=" + "x" * 300, "--out=xxx", "expects a folder"),
    ("--resume", "--algo:", "is required"),
]


@pytest.mark.parametrize(("arguments", "begins", "expects"), RESUMED, ids=[short(row[0]) for row in RESUMED])
def test_an_invalid_resume_is_rejected(folder, capsys, arguments, begins, expects):
    text = arguments.replace("RUN", str(RUN)).replace("NEW", NEW)
    rejected(folder, capsys, text.split(" "), begins.replace("RUN", str(RUN)), expects.replace("RUN", str(RUN)))


# --overwrite


def foreign_file(path):
    (path / "thesis.tex").write_text("mine")


def foreign_folder(path):
    shutil.rmtree(path)
    foreign_file_in = path / "src"
    foreign_file_in.mkdir(parents=True)
    foreign_file(foreign_file_in)


def a_link_below(path):
    (path / "policy" / "link").symlink_to(Path("file").absolute())


def a_link_itself(path):
    path.rename("elsewhere")
    path.symlink_to(Path("elsewhere").absolute())


def a_link_to_nothing(path):
    shutil.rmtree(path)
    path.symlink_to(Path("nowhere").absolute())


NOT_RUNS = [foreign_file, foreign_folder, a_link_below, a_link_itself, a_link_to_nothing]


@pytest.mark.parametrize("change", NOT_RUNS, ids=[change.__name__ for change in NOT_RUNS])
def test_a_folder_with_other_files_than_a_run_is_not_replaced(folder, capsys, change):
    change(RUN)
    expects = "expects a folder that holds a run and nothing else"
    rejected(folder, capsys, [*NEW.split(), "--name=run", "--overwrite"], f"--overwrite: {RUN}", expects)


def test_a_file_at_the_path_of_a_run_is_not_replaced(folder, capsys):
    shutil.rmtree(RUN)
    RUN.write_text("mine")
    rejected(folder, capsys, [*NEW.split(), "--name=run", "--overwrite"], "--out=runs:", "expects a folder")


HOLD = """
import sys, pathlib
from experiments.running import folder_lock
with folder_lock.locked(pathlib.Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_run_that_another_process_is_training_is_rejected(folder, capsys):
    command = [sys.executable, "-c", HOLD, str(RUN.absolute())]
    pipe = subprocess.PIPE
    root = Path(__file__).resolve().parent.parent
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=root) as holder:
        assert holder.stdout.readline() == "locked\n"
        who = rf"host {re.escape(platform.node())}, process {holder.pid}(, job \S+)?"
        expects = f" {who} is training {RUN}; expects another run"
        rejected(folder, capsys, [*NEW.split(), "--name=run", "--overwrite"], "--name=run:", expects)
        rejected(folder, capsys, [f"--resume={RUN}"], f"--resume={RUN}:", expects)
        holder.stdin.close()
