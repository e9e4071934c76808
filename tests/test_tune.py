"""The command on a real task: killed by -9 it ends as the uninterrupted study, and a batch is one compilation."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

optuna = pytest.importorskip("optuna", reason="needs the extra tune")
from tuned_runs import contents  # noqa: E402

pytestmark = pytest.mark.slow

TINY = {
    "algo": "td3_sqt", "env": "cheetah", "physics": "mujoco", "objective": "final", "final_seeds": 2, "steps": 300,
    "warmup_steps": 100, "eval_every": 100, "eval_episodes": 1, "batch_size": 8, "hidden": 8, "checkpoint_every": 100,
    "tensorboard": "false",
}  # fmt: skip


def start(out, *arguments, **variables):
    command = [sys.executable, "-m", "experiments.tune", f"--out={out}", *arguments]
    command += [f"--{name}={value}" for name, value in TINY.items()]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | variables
    )


def trials(out, algo="td3_sqt"):
    backend = optuna.storages.journal.JournalFileBackend(str(out / "study.log"))
    return contents(optuna.load_study(study_name=algo, storage=optuna.storages.JournalStorage(backend)))


def wait_for(path, process):
    give_up = time.monotonic() + 600
    while not path.exists():
        assert process.poll() is None and time.monotonic() < give_up, process.communicate()[0]
        time.sleep(0.05)


def test_a_study_that_is_killed_ends_as_the_uninterrupted_one(tmp_path):
    space = ["--space=penalty_coef=0..1", "--trials=4", "--batch=2"]
    whole = start(tmp_path / "whole", *space)
    assert whole.wait(1200) == 0, whole.communicate()[0]
    out = tmp_path / "killed"
    batch = out / "trials" / "cheetah" / "td3_sqt"
    for moment in ("batch_0001/checkpoint/step_0000000100", "batch_0002/config.json"):
        process = start(out, *space)
        wait_for(batch / moment, process)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(1)  # the run dies with it
    last = start(out, *space)
    assert last.wait(1200) == 0, last.communicate()[0]
    assert json.loads((batch / "batch_0001" / "config.json").read_text())["resumed"]  # it was killed while it trained
    assert trials(out) == trials(tmp_path / "whole") and len(trials(out)) == 4
    without_command = [re.sub(r"--out=\S+", "", (tmp_path / n / "tuning.csv").read_text()) for n in ("killed", "whole")]
    assert without_command[0] == without_command[1]


def test_64_trials_of_two_seeds_are_one_compilation(tmp_path):
    process = start(tmp_path, "--space=penalty_coef=0..1", "--trials=64", "--batch=64", JAX_LOG_COMPILES="1")
    assert process.wait(1800) == 0, process.communicate()[0]
    logs = sorted((tmp_path / "trials" / "cheetah" / "td3_sqt").glob("*.log.txt"))
    assert [log.name for log in logs] == ["batch_0001.log.txt"] and len(trials(tmp_path)) == 64
    compiled = re.findall(r"Finished XLA compilation of jit\((\w+)\)", logs[0].read_text())
    assert compiled.count("advance") == 2  # the warm-up and training
    assert compiled.count("evaluate_policy") == 1


def test_a_log_that_cannot_be_written_is_a_failure(tmp_path):
    log = tmp_path / "trials" / "cheetah" / "td3_sqt" / "batch_0001.log.txt"
    log.mkdir(parents=True)
    process = start(tmp_path, "--space=penalty_coef=0..1", "--trials=2", "--batch=2")
    printed = process.communicate(timeout=300)[0]
    assert process.returncode == 1 and str(log) in printed and "Traceback" not in printed
