"""Tunes settings: `python -m experiments.tune --algo=td3_sqt --env=cheetah --space=penalty_coef=0..1 --steps=20000`.

Optuna proposes trials. One run of experiments.run trains a batch of them, each with all seeds, in one program. The best
trial is then trained again on seeds that tuning never saw, beside its baseline, tuned over the same space with as many
trials. OUT gets the trials (study.log, which optuna-dashboard opens; trials.csv), the runs, and a report: tuning.md,
tuning.csv and tuning.png.

Flags other than those below go to every run, for example --steps=20000 or --physics=mujoco. The same command continues
a study that was stopped or killed. Exit codes: 0 done, 1 a run failed or the results could not be written, 2 bad
usage, 3 a member diverged on fresh seeds or in all trials, 130 interrupted.
"""

import shlex
import sys
from collections.abc import Sequence

from absl import app, flags

from experiments.commandline.answers import refused_in_one_line
from experiments.commandline.arguments import FAILED, reject_folder
from experiments.commandline.known_flags import parse_known
from experiments.commandline.path_flags import define_path
from experiments.launchers import launcher_flags
from experiments.tuning.rounds import make_rounds
from experiments.tuning.tune_flags import OBJECTIVES, SAMPLERS, Given, check_flags

FLAGS = flags.FLAGS


def main(argv: Sequence[str]) -> int:
    """Tunes; `argv` has the program name and the flags for every run. Returns the exit code."""
    # FAILED: the folder was checked, so an OSError is a full disk, for example.
    return refused_in_one_line(lambda: tune(argv[1:]), FLAGS.out, os_error=FAILED)


def tune(run_flags: Sequence[str]) -> int:
    """As `main`. Raises `UsageError`, and `OSError` if --out cannot be written."""
    options = check_flags(Given._make(FLAGS[name].value for name in Given._fields), run_flags)
    reject_folder("--out", options.out)
    rounds = make_rounds(launcher_flags.given(FLAGS, options.out))
    from experiments.tuning.session import Session  # imports Optuna and matplotlib

    command = shlex.join(["python", "-m", "experiments.tune", *sys.argv[1:]])
    return Session(options, rounds, FLAGS.retries, command).run()


if __name__ == "__main__":
    flags.DEFINE_string("algo", None, "The algorithm.")
    flags.DEFINE_string("env", None, "The task.")
    flags.DEFINE_string(
        "space",
        None,
        "What is tuned: NAME=LOW..HIGH, NAME=log:LOW..HIGH, NAME=LOW..HIGH:STEP or 'NAME=A|B|C', separated by commas.",
    )
    flags.DEFINE_integer("trials", 64, "Trials, of the algorithm and of its baseline.", 1)
    flags.DEFINE_integer("batch", 16, "Trials that are asked for and trained together.", 1, 5000)
    flags.DEFINE_list("seeds", ["0", "1"], "Seeds of each trial.")
    flags.DEFINE_string("sampler", "tpe", f"Who proposes: {', '.join(SAMPLERS)}.")
    flags.DEFINE_integer("sampler_seed", 0, "Seed of the proposals.", 0)
    flags.DEFINE_string(
        "objective",
        "score",
        f"Value of a trial: {', '.join(OBJECTIVES)}: the best, or the last evaluation of the mean over seeds.",
    )
    flags.DEFINE_integer("final_seeds", 10, "How many fresh seeds the winner is trained on.", 1)
    define_path("out", "runs/tuned", "The folder of the study. On a cluster: one that all machines share.")
    launcher_flags.define("Batches that are asked for and trained side by side.")
    app.run(main, flags_parser=parse_known)
