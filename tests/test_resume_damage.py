"""Damaged or hostile checkpoints: the run resumes from the one before, prints that, and ends as it would have."""

import csv
import json
import re
import shutil
from pathlib import Path

import pytest

from experiments.run import main
from experiments.running import manifests

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

NEW = (
    "--algo=sac_sqt --env=ant --seeds=3,1 --steps=60 --warmup_steps=20 --eval_every=30 --eval_episodes=1 "
    "--batch_size=8 --hidden=8,8 --checkpoint_every=20 --notensorboard --quiet --name=run"
)
LAST, BEFORE = "step_0000000060", "step_0000000040"
ROWS = "rows_0000000040_0000000060.bin"


def run(*arguments):
    return main(["experiments.run", *arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished")
    assert run(*NEW.split(), f"--out={out}") == 0
    return out / "ant" / "sac_sqt" / "run"


def evaluations(path):
    with (path / "evaluations.csv").open(newline="") as file:
        return [{name: text for name, text in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


def truncated(path):
    path.write_bytes(path.read_bytes()[:-1])


def flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def digit_changed(path):
    """Another length of a table, in a valid manifest."""
    text = path.read_text()
    changed = re.sub(r'("evaluations": \d*)(\d)', lambda match: match[1] + str((int(match[2]) + 1) % 10), text)
    assert changed != text
    path.write_text(changed)


def largest(folder):
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def in_state(damage):
    return lambda folder: damage(largest(folder / LAST / "state"))


def in_rows(damage):
    return lambda folder: damage(folder / ROWS)


def manifest(**changes):
    def damage(folder):
        path = folder / LAST / "manifest.json"
        content = json.loads(path.read_text())
        content |= {name: change(content[name]) for name, change in changes.items()}
        del content["own_crc"]  # a deliberate change can recompute it
        path.write_text(json.dumps(content | {"own_crc": manifests.own_crc(content)}))

    return damage


def manifest_is(content):
    return lambda folder: (folder / LAST / "manifest.json").write_text(content)


def moved_out(name):
    def damage(folder):
        (folder / name).rename(folder.parents[1] / "outside" / "moved")
        (folder / name).symlink_to(folder.parents[1] / "outside" / "moved")

    return damage


def added(folder):
    (folder / LAST / "state" / "more").write_text("")


def of_another_step(folder):
    before = json.loads((folder / BEFORE / "manifest.json").read_text())
    for name in ("state", "policy", "policy_best"):
        shutil.rmtree(folder / LAST / name)
        shutil.copytree(folder / BEFORE / name, folder / LAST / name)
    manifest(files=lambda _: before["files"])(folder)


UNREADABLE = "its manifest.json cannot be read"
MISSING = "rows of the replay are missing"
# Damage to `checkpoint/`, and the message about the last checkpoint.
DAMAGED = {
    "manifest truncated": (lambda folder: truncated(folder / LAST / "manifest.json"), UNREADABLE),
    "manifest with another digit": (
        lambda folder: digit_changed(folder / LAST / "manifest.json"),
        "its manifest.json is damaged",
    ),
    "manifest a list": (manifest_is("[1]"), UNREADABLE),
    "manifest deep": (manifest_is("[" * 100_000), UNREADABLE),
    "manifest missing": (lambda folder: (folder / LAST / "manifest.json").unlink(), UNREADABLE),
    "rows elsewhere": (manifest(rows=lambda names: [*names[:-1], "../../x.bin"]), MISSING),
    "rows of none": (manifest(rows=lambda _: [], crc=lambda _: []), MISSING),
    "rows twice": (manifest(rows=lambda names: [*names, names[-1]], crc=lambda crcs: [*crcs, crcs[-1]]), MISSING),
    "time not finite": (manifest(position=lambda old: old | {"wall_seconds": float("inf")}), UNREADABLE),
    "another step": (manifest(position=lambda old: old | {"env_steps": 40}), UNREADABLE),
    "negative length": (manifest(lengths=lambda _: {"evaluations": -1, "metrics": 0}), UNREADABLE),
    "absurd size": (manifest(files=lambda old: dict.fromkeys(old, [10**15, 0])), "far larger"),
    "state flipped": (in_state(flipped), "is damaged"),
    "state truncated": (in_state(truncated), "is damaged"),
    "state file missing": (in_state(Path.unlink), "files are missing"),
    "state with another file": (added, "files are missing, or there are others"),
    "state a link": (moved_out(f"{LAST}/state"), "files are missing"),
    "policy flipped": (lambda folder: flipped(folder / LAST / "policy_best" / "best.json"), "is damaged"),
    "policy a link": (moved_out(f"{LAST}/policy"), "files are missing"),
    "checkpoint a link": (moved_out(LAST), "it is a link"),
    "rows missing": (in_rows(Path.unlink), f"{ROWS} is missing"),
    "rows truncated": (in_rows(truncated), f"{ROWS} is damaged"),
    "rows flipped": (in_rows(flipped), f"{ROWS} is damaged"),
    "rows a link": (moved_out(ROWS), f"{ROWS} is missing or is not a file"),
}


def copied(finished, folder):
    (folder / "outside").mkdir()
    (folder / "outside" / "file").write_text("mine")
    shutil.copytree(finished, folder / "run")
    return folder / "run"


def outside(path):
    return {item: item.read_bytes() for item in (path.parent / "outside").rglob("*") if item.is_file()}


def goes_on(finished, path, capsys, said):
    """Resumes; the messages about checkpoints match `said`, a pattern per line."""
    before = outside(path)
    assert run(f"--resume={path}", "--quiet") == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert err == "" and len(lines) == len(said)
    for line, pattern in zip(lines, said, strict=True):
        assert re.search(pattern, line), line
    assert evaluations(path) == evaluations(finished)
    assert json.loads((path / "summary.json").read_text())["status"] == "done"
    assert sorted(item.name for item in (path / "checkpoint").glob("step_*")) == [BEFORE, LAST]
    assert not any(item.is_symlink() for item in path.rglob("*"))
    assert outside(path) == before


# Complete runs: one of each kind of damage is in the fast suite.
QUICK = ("manifest truncated", "state flipped", "rows missing")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[] if case in QUICK else pytest.mark.slow) for case in DAMAGED]
)
def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(finished, tmp_path, capsys, case):
    damage, reason = DAMAGED[case]
    path = copied(finished, tmp_path)
    damage(path / "checkpoint")
    goes_on(finished, path, capsys, [f"^the checkpoint at step 60 cannot be used: .*{re.escape(reason)}"])
    entry = json.loads((path / "config.json").read_text())["resumed"][-1]
    assert entry["env_steps"] == 40


def contents(path):
    return {item: item.read_bytes() for item in path.rglob("*") if item.is_file()}


@pytest.mark.parametrize(
    ("damage", "said", "reason"),
    [
        (lambda folder: flipped(min(folder.glob("rows_*"))), 2, "none of its 2 checkpoints is valid"),
        (manifest(format=lambda _: 99), 0, "its checkpoints are of format '99', not "),
        (of_another_step, 0, "its checkpoint at step 60 is of step 40"),
    ],
    ids=["no checkpoint is valid", "another format", "the state of another step"],
)
def test_a_run_that_cannot_be_resumed_is_rejected_and_not_changed(finished, tmp_path, capsys, damage, said, reason):
    path = copied(finished, tmp_path)
    damage(path / "checkpoint")
    before = contents(tmp_path)
    assert run(f"--resume={path}", "--steps=80", "--quiet") == 2
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == said and err.count("\n") == 1
    assert err.startswith(f"--resume={path}: expects a run with checkpoints to resume from; ") and reason in err
    lock = path / "lock"
    assert {item: text for item, text in contents(tmp_path).items() if item != lock} == {
        item: text for item, text in before.items() if item != lock
    }


def test_nothing_is_written_through_links(finished, tmp_path, capsys):
    """Links under the names that a checkpoint has while it is written."""
    path = copied(finished, tmp_path)
    in_rows(Path.unlink)(path / "checkpoint")
    for name in (f"{LAST}.part", f"{ROWS}.part"):
        (path / "checkpoint" / name).symlink_to(tmp_path / "outside")
    goes_on(finished, path, capsys, [f"{ROWS} is missing"])
