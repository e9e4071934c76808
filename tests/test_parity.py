"""The parity command: its report has every task and physics; invalid flags are rejected."""

import pytest
from absl.testing import flagsaver

from experiments import parity
from experiments.gymnasium_parity import parity_report
from experiments.gymnasium_parity.gymnasium_reference import record_episode


@pytest.mark.slow
def test_the_report_has_a_row_for_every_task_and_physics(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(parity.jax_settings, "prepare", lambda: None)
    monkeypatch.setattr(
        parity_report, "record_episode", lambda name, seed, scale: record_episode(name, seed, scale, steps=20)
    )
    parity.FLAGS.mark_as_parsed()
    out = tmp_path / "new" / "parity.md"
    with flagsaver.flagsaver(
        tasks=["hopper", "walker-v5"],
        physics=["mujoco"],
        states=16,
        starts=16,
        episodes=2,
        seconds=0.0,
        repeats=1,
        out=str(out),
    ):
        monkeypatch.setattr(parity.sys, "argv", ["parity", "--states=16"])
        parity.main(["parity"])
    text = out.read_text()
    assert text in capsys.readouterr().out
    assert text.count("| Hopper-v4 |") == text.count("| Walker2d-v5 |") == 4
    assert "| Hopper-v4 | mujoco | " in text and "DIFFER" not in text
    assert "| Hopper-v4 | 16 | " in text and "| Walker2d-v5 | 2 | " in text
    speed = text.split("| Hopper-v4 | mujoco |")[1].split("\n")[0].split("|")[-2]
    assert float(speed.replace(",", "")) > 0
    assert "`python -m experiments.parity --states=16`" in text


@pytest.mark.parametrize(("flag", "value"), [("tasks", "hopper2"), ("physics", "bullet")])
def test_wrong_names_are_rejected_in_one_line(flag, value):
    parity.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        parity.main(["parity"])
    assert str(error.value).startswith(f"--{flag}: expects some of ") and "\n" not in str(error.value)


OTHERS = [
    "suites",
    "suite",
    "algos",
    "members",
    "devices",
    "capacities",
    "profile",
    "figures",
    "compare",
    "json",
    "peak",
]


@pytest.mark.parametrize("name", [*OTHERS, "peer_python"])
def test_flags_that_apply_only_to_the_benchmark_are_rejected(name):
    parity.FLAGS.mark_as_parsed()
    parity.FLAGS[name].present = 1
    try:
        with pytest.raises(SystemExit, match=f"^--{name}: has no effect here; of the benchmark's flags only --tasks, "):
            parity.main(["parity"])
    finally:
        parity.FLAGS[name].present = 0
    for applying in parity.BENCH_FLAGS:
        parity.FLAGS[applying].present += 1
    try:
        parity.reject_other_bench_flags()
    finally:
        for applying in parity.BENCH_FLAGS:
            parity.FLAGS[applying].present -= 1


def test_a_report_that_cannot_be_written_is_rejected_before_anything_runs(tmp_path):
    parity.FLAGS.mark_as_parsed()
    (tmp_path / "file").write_text("")
    for out, says in {
        tmp_path: "expects a file, which this folder",
        tmp_path / "file" / "a.md": "expects a file in",
    }.items():
        with flagsaver.flagsaver(out=str(out)), pytest.raises(SystemExit, match=f"^--out={out}: {says}"):
            parity.main(["parity"])
