"""The script of a job array."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.commandline.arguments import UsageError
from experiments.launchers.cell import Cell
from experiments.launchers.slurm_options import parse
from experiments.launchers.slurm_submission import Submission, checks, parameters, submit_array, variables_of_no_job

CELLS = [Cell("ant", algo, Path(f"runs/ant/{algo}/x"), ()) for algo in ("td3", "sac", "td7")]


@pytest.fixture
def sbatch(tmp_path, monkeypatch):
    """Puts a script in sbatch's place; it keeps the job's script."""
    pytest.importorskip("submitit")
    monkeypatch.chdir(tmp_path)

    def make(script):
        for name in ("sbatch", "srun"):
            path = tmp_path / "bin" / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(f"#!/bin/sh\ncp $1 {tmp_path}/job.sh\n{script}\n")
            path.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")

    return make


def test_the_script_has_the_options_and_an_element_per_cell(sbatch, tmp_path):
    sbatch("echo Submitted batch job 41")
    options = parse("partition=gpu,gpus_per_node=1,time=04:00:00,exclusive=true")
    jobs = submit_array(Submission(Path("out"), options, max_jobs=2), CELLS)
    assert [job.job for job in jobs] == ["41_0", "41_1", "41_2"]
    (folder,) = (tmp_path / "out" / ".slurm").iterdir()
    assert [job.log for job in jobs] == [folder / f"41_{index}_0_log.out" for index in range(3)]
    lines = (tmp_path / "job.sh").read_text().splitlines()
    for option in ("array=0-2%2", "partition=gpu", "gpus-per-node=1", "time=04:00:00", "signal=USR2@300"):
        assert f"#SBATCH --{option}" in lines
    assert {"#SBATCH --exclusive", "#SBATCH --requeue", f"#SBATCH --output={folder}/%A_%a_0_log.out"} <= set(lines)
    assert not any("--wckey" in line or "--error" in line for line in lines)
    assert lines[-1].startswith("srun --unbuffered --output ") and "-m submitit.core._submit" in lines[-1]


def test_a_single_cell_gives_its_name_to_the_job_and_has_slurms_time_limit(sbatch, tmp_path):
    sbatch("echo Submitted batch job 41")
    (job,) = submit_array(Submission(Path("out"), parse(""), None), CELLS[:1])
    text = (tmp_path / "job.sh").read_text()
    assert job.job == "41" and "#SBATCH --job-name=td3-ant\n" in text and "--time" not in text and "--array" not in text


def test_the_error_of_sbatch_is_one_line_and_leaves_no_folder(sbatch, tmp_path, capfd):
    sbatch("echo 'sbatch: error: invalid partition' >&2; echo 'sbatch: error: failed' >&2; exit 1")
    with pytest.raises(UsageError) as error:
        submit_array(Submission(Path("out"), parse(""), None), CELLS)
    line = "--slurm: expects options that sbatch accepts: sbatch: error: invalid partition; sbatch: error: failed"
    assert str(error.value) == line
    assert not (tmp_path / "out").exists() and capfd.readouterr() == ("", "")


def test_a_job_that_is_submitted_from_a_job_does_not_take_over_its_variables(monkeypatch):
    monkeypatch.setenv("SLURM_CONF", "/etc/slurm.conf")
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "4")  # outside of a job: the user's own
    with variables_of_no_job():
        assert os.environ["SLURM_MEM_PER_CPU"] == "4"
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SQT_JOB", "slurm 7")
    with variables_of_no_job():
        assert not {"SLURM_MEM_PER_CPU", "SLURM_JOB_ID", "SQT_JOB"} & set(os.environ)
        assert os.environ["SLURM_CONF"] == "/etc/slurm.conf"
    assert os.environ["SLURM_JOB_ID"] == "7"


def test_setup_lines_come_before_the_checks():
    options = parse("")._replace(setup=("module load cuda",))
    setup = parameters(Submission(Path("out"), options, None), CELLS)["setup"]
    assert setup[0] == "module load cuda" and len(setup) > 1


def run_shell(lines, **variables):
    return subprocess.run(
        ["bash", "-c", "\n".join([*lines, "echo trains"])], capture_output=True, text=True, env=variables
    )


@pytest.mark.parametrize(
    ("folder", "python", "missing"),
    [
        ("/no where", sys.executable, "the folder /no where"),
        ("/", "/no/python", "/no/python with sqt_jax[slurm]"),
    ],
)
def test_a_machine_without_the_code_or_python_ends_the_job_in_one_line(folder, python, missing):
    done = run_shell(checks(folder, python), SLURMD_NODENAME="n7")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.splitlines()[-1] == f"--launcher=slurm: expects {missing} on all machines; n7 does not have it"


def test_a_step_gets_the_jobs_cores():
    lines = [*checks("/", "true")[-1:], 'echo "cores: $SRUN_CPUS_PER_TASK"']
    assert "cores: 4\n" in run_shell(lines, SLURM_CPUS_PER_TASK="4").stdout
    assert "cores: \n" in run_shell(lines).stdout
