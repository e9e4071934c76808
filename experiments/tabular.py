"""Section 5 of the SQT paper, measured: `python -m experiments.tabular`.

Runs tabular Q-learning, Double Q, Weighted Double Q, MaxMin and SQT on small MDPs with known Q*. Do the values converge
to Q*, does the penalty vanish, which sign has the error during learning, and is the operator a contraction, as eq. 16
states? All verdicts are computed from the numbers of the run. Writes table.md and tabular.png into --out.

Exit codes: 0 done; 2 bad usage (one line, nothing written); 130 interrupted.
"""

import shlex
import sys
from collections.abc import Sequence

from experiments.commandline.arguments import BAD_USAGE, DONE, INTERRUPTED, UsageError, printable
from experiments.theorem import study, study_flags


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    if any(word in ("--help", "-help", "-h") for word in argv[1:]):
        print(__doc__ + "\n" + study_flags.define_flags().get_help())
        return DONE
    try:
        settings, out = study_flags.parse(argv)
        study.run(settings, out, shlex.join(["python", "-m", "experiments.tabular", *argv[1:]]))
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt:
        return INTERRUPTED
    return DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv))
