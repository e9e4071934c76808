"""Section 5 of the SQT paper measured: `python -m experiments.tabular`.

Tabular Q-learning, Double, Weighted Double, MaxMin and SQT on small MDPs whose Q* is known: do the values converge to
Q*, does the penalty vanish, which way are they wrong until then, and does the operator contract as eq. 16 has it? What
is printed follows from the numbers of the run. Writes table.md and tabular.png into --out.

Exit codes: 0 done; 2 bad usage (one line, nothing written); 130 interrupted.
"""

import functools
import io
import math
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags as absl_flags
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.commandline import arguments
from experiments.commandline.arguments import UsageError, printable
from experiments.commandline.flags import ABSL_FLAGS
from experiments.running import runtime
from experiments.running.progress import format_seconds
from experiments.theorem import claims as report
from experiments.theorem import contraction, mdps, q_learning, value_figure
from sqt_jax.names import nearest, unknown

DONE, BAD_USAGE, INTERRUPTED = 0, 2, 130
TABLE, FIGURE = "table.md", "tabular.png"
FIRST_CHECKPOINT = 100
CHECKPOINTS_PER_DECADE = 8


def define_flags() -> absl_flags.FlagValues:
    # Own flag values: the libraries define flags of theirs in the global ones.
    values = absl_flags.FlagValues()
    values.set_gnu_getopt(True)

    def define(kind: Callable, *arguments, **limits) -> None:
        kind(*arguments, flag_values=values, **limits)

    integer, number = absl_flags.DEFINE_integer, absl_flags.DEFINE_float
    define(absl_flags.DEFINE_list, "mdps", list(mdps.MDPS), f"MDPs: {', '.join(mdps.MDPS)}.")
    algos = list(q_learning.algorithms())
    define(absl_flags.DEFINE_list, "algos", algos, f"Algorithms: {', '.join(algos)}.")
    define(absl_flags.DEFINE_list, "coefs", ["0", "0.1", "0.25", "0.5", "1"], "SQT's penalty coefficients.")
    define(integer, "seeds", 20, "Number of seeds.", lower_bound=1, upper_bound=10_000)
    define(integer, "steps", 200_000, "Steps per member.", lower_bound=FIRST_CHECKPOINT, upper_bound=10**8)
    define(integer, "tables", 4, "Tables of MaxMin and SQT.", lower_bound=2, upper_bound=100)
    define(integer, "ddof", 1, "The std over tables divides by N - ddof.", lower_bound=0, upper_bound=1)
    define(absl_flags.DEFINE_string, "greedy", "min", f"Chooses SQT's a': {', '.join(q_learning.GREEDY)}.")
    define(number, "gamma", 0.8, "Discount factor, above 0 and below 1.", lower_bound=0.0)
    define(number, "lr_power", 0.7, "Step size 1 / n(s, a)^lr_power, above 0.5 and up to 1.", upper_bound=1.0)
    define(number, "epsilon", 1.0, "Share of random actions; 1: uniform.", lower_bound=0.0, upper_bound=1.0)
    define(number, "init_std", 0.0, "Std of the tables' initial values.", lower_bound=0.0)
    define(number, "weighted_c", 1.0, "Weighted Double Q-learning's c, above 0.", lower_bound=0.0)
    define(absl_flags.DEFINE_string, "out", "runs/tabular", "Folder of the results.")
    define(absl_flags.DEFINE_boolean, "overwrite", False, "Replace the results in the folder.")
    return values


def parse(argv: Sequence[str]) -> dict[str, Any]:
    """The command line, checked; `coefs` as numbers.

    Raises:
      UsageError: one line that names the first flag that cannot be.
    """
    values = define_flags()
    for word in argv[1:]:
        name = word.lstrip("-").split("=")[0]
        if word.startswith("-") and name in ABSL_FLAGS:
            raise UsageError(f"--{name}: unknown flag; --help lists the flags")
    try:
        rest = values(list(argv), known_only=False)[1:]
    except absl_flags.UnrecognizedFlagError as error:
        hint = nearest(f"--{error.flagname}", [f"--{name}" for name in values]) or "; --help lists the flags"
        raise UsageError(f"--{error.flagname}: unknown flag{hint}") from None
    except absl_flags.Error as error:
        found = re.search(r"-*(\w+)(?==|$)", str(error).removeprefix("flag ").splitlines()[0])
        if not found or found[1] not in values:
            raise UsageError(str(error).splitlines()[0]) from None
        wrong = values[found[1]]
        expects = wrong.parser.syntactic_help or ("true or false" if wrong.boolean else "a word")
        raise UsageError(f"--{found[1]}: expects {expects}") from None
    if rest:
        raise UsageError(f"{rest[0]}: unexpected argument; settings are given as --flag=value")
    flag: dict[str, Any] = {name: values[name].value for name in values}
    for name, known in (("mdps", mdps.MDPS), ("algos", q_learning.algorithms())):
        _check_list(name, flag[name])
        for word in flag[name]:
            if word not in known:
                raise UsageError(f"--{name}: {unknown(word, known)}")
    if flag["greedy"] not in q_learning.GREEDY:
        raise UsageError(f"--greedy: {unknown(flag['greedy'], q_learning.GREEDY)}")
    _check_list("coefs", flag["coefs"])
    coefs = [_coefficient(word) for word in flag["coefs"]]
    _check_list("coefs", coefs)
    flag["coefs"] = coefs
    for name in ("gamma", "lr_power", "epsilon", "init_std", "weighted_c"):
        if not math.isfinite(flag[name]):
            raise UsageError(f"--{name}: expects a number, not {flag[name]}")
    if not 0 < flag["gamma"] < 1:  # the ratios of eq. 16 are divided by it
        raise UsageError(f"--gamma: expects a number above 0 and below 1, not {flag['gamma']:g}")
    if flag["lr_power"] <= 0.5:
        raise UsageError(f"--lr_power: expects a number above 0.5 and up to 1, not {flag['lr_power']:g}")
    if flag["weighted_c"] == 0:
        raise UsageError("--weighted_c: expects a number above 0, not 0")
    _check_out(flag["out"], flag["overwrite"])
    return flag


def _check_list(name: str, words: Sequence) -> None:
    if not words:
        raise UsageError(f"--{name}: expects at least one")
    for word in words:
        if words.count(word) > 1:
            raise UsageError(f"--{name}: expects each value once, {word} is there {words.count(word)} times")


def _coefficient(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise UsageError(f"--coefs: expects numbers of at least 0 like 0,0.5, not {word!r}")
    return value


def _check_out(name: str, overwrite: bool) -> None:
    path = Path(name)
    if not name or "\0" in name:
        raise UsageError("--out: expects a folder")
    arguments.reject_folder("--out", path)
    try:
        if not overwrite and path.exists() and any(path.iterdir()):
            raise UsageError(f"--out={name}: is there already; expects another folder, or --overwrite beside it")
    except OSError as error:
        raise UsageError(f"--out={name}: expects a folder that can be read: {error.strerror}") from None
    arguments.reject_existing(path, (TABLE, FIGURE), overwrite)


def checkpoints(steps: int) -> np.ndarray:
    """Evenly in the logarithm, the last one `steps`."""
    count = max(2, 1 + round(CHECKPOINTS_PER_DECADE * math.log10(steps / FIRST_CHECKPOINT)))
    return np.unique(np.round(np.geomspace(FIRST_CHECKPOINT, steps, count)).astype(int))


def models(name: str, seeds: int, gamma: float) -> q_learning.Model:
    """One MDP for each seed, stacked; they are all the same where the MDP has nothing random."""
    found = [mdps.centred(mdps.MDPS[name](seed), gamma) for seed in range(seeds)]
    return q_learning.model_of(mdps.stack(found), np.stack([mdps.optimal_q(mdp, gamma) for mdp in found]))


def run(flag: dict[str, Any]) -> Iterator[tuple[report.Names, report.Curves, float]]:
    """The algorithms on the MDPs one after the other, and the share of the work that is done."""
    table = q_learning.algorithms(flag["tables"], flag["ddof"], flag["greedy"], flag["weighted_c"])
    steps = checkpoints(flag["steps"])
    lengths = jnp.asarray(np.diff(steps, prepend=0), jnp.int32)
    seeds = jnp.arange(flag["seeds"])
    # MDPs of one shape share the compiled program.
    programs = {}
    for algo in flag["algos"]:
        settings = {key: flag[key] for key in ("gamma", "epsilon", "ddof", "init_std")}
        settings |= {"algorithm": table[algo], "power": flag["lr_power"]}
        programs[algo] = jax.jit(functools.partial(q_learning.sweep, **settings))
    done, total = 0, len(flag["mdps"]) * len(flag["algos"])
    for mdp in flag["mdps"]:
        model = models(mdp, flag["seeds"], flag["gamma"])
        for algo in flag["algos"]:
            coefs = flag["coefs"] if table[algo].has_coef else [None]
            numbers = jnp.array([coef or 0.0 for coef in coefs], jnp.float32)
            learner, record = jax.device_get(programs[algo](model, seeds, numbers, lengths))
            done += 1
            curves = report.Curves(tuple(coefs), steps, record, learner.tables)
            yield (mdp, algo), curves, done / total


def settings_of(flag: dict[str, Any]) -> list[str]:
    epsilon = flag["epsilon"]
    return [
        f"{flag['seeds']} seeds, {flag['steps']:,} steps, gamma {flag['gamma']:g}; behaviour "
        + ("uniform" if epsilon == 1 else f"epsilon-greedy, epsilon {epsilon:g}"),
        f"step size 1 / n(s, a)^{flag['lr_power']:g}, n the visits from which the table has learned",
        f"MaxMin and SQT: {flag['tables']} tables, ddof {flag['ddof']}, a' greedy by the {flag['greedy']}; weighted "
        f"Double Q: c {flag['weighted_c']:g}; initial values "
        + (f"N(0, {flag['init_std']:g}^2)" if flag["init_std"] else "0"),
        "T: the expected target of eq. 13 as theorem/q_learning.py states it; the paper itself was not at hand",
        *(mdps.ABOUT[name] for name in flag["mdps"]),
    ]


def statements(
    flag: dict[str, Any], results: dict[report.Names, report.Curves], expansions: Sequence[report.Expansion]
) -> list[report.Statement]:
    return [
        report.overestimation(results),
        report.underestimation(results),
        report.monotone(results),
        report.convergence(results),
        report.penalty(results),
        report.identical(results),
        report.non_expansion(expansions, flag["tables"], flag["gamma"], flag["ddof"], contraction.PAIRS),
        report.on_the_way(results),
    ]


def terminal_table(lines: Sequence[Sequence[str]], left: int) -> Table:
    """The first line is the header; the first `left` columns hold words, and a new first word begins a section."""
    shown = Table(box=SIMPLE_HEAD)
    for index, name in enumerate(lines[0]):
        shown.add_column(name.replace(" ", "\n"), justify="left" if index < left else "right", no_wrap=True)
    before = lines[1][0] if len(lines) > 1 else ""
    for row in lines[1:]:
        if left and row[0] != before:
            shown.add_section()
        before = row[0]
        shown.add_row(*row)
    return shown


def print_statements(console: Console, found: Sequence[report.Statement]) -> None:
    colours = {"supported": "green", "contradicted": "red"}
    for statement in found:
        colour = colours.get(statement.verdict, "yellow")
        text = f"\n[bold]{escape(statement.claim)}: [{colour}]{statement.verdict}[/{colour}][/bold]"
        console.print(f"{text}\n  {escape(statement.evidence)}", highlight=False)


def main(argv: Sequence[str]) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    if any(word in ("--help", "-help", "-h") for word in argv[1:]):
        print(__doc__ + "\n" + define_flags().get_help())
        return DONE
    try:
        flag = parse(argv)
        return measure(flag, Path(flag["out"]), argv)
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt:
        return INTERRUPTED


def measure(flag: dict[str, Any], out: Path, argv: Sequence[str]) -> int:
    runtime.prepare()
    console, began = Console(), time.monotonic()
    if not console.is_terminal:
        console.width = 132
    results: dict[report.Names, report.Curves] = {}
    with console.status("compiling") as status:
        for names, curves, share in run(flag):
            results[names] = curves
            passed = time.monotonic() - began
            line = f"{', '.join(names)}: {share:.0%} after {format_seconds(passed)}"
            line += f", {format_seconds(passed / share - passed)} left"
            if console.is_terminal:
                status.update(line)
            else:
                console.print(line, highlight=False)
    sqt = q_learning.algorithms(flag["tables"], flag["ddof"], flag["greedy"])["sqt"]
    expansions = report.expansions(sqt, flag["coefs"], flag["ddof"], contraction.PAIRS)
    table, expansion = report.cells(results), report.expansion_table(expansions)
    found = statements(flag, results, expansions)
    console.print(terminal_table([report.HEADER, *table], left=2))
    console.print(" ".join(report.LEGEND), highlight=False)
    console.print(terminal_table(expansion, left=0))
    print_statements(console, found)
    command = shlex.join(["python", "-m", "experiments.tabular", *argv[1:]])
    text = report.markdown(command, settings_of(flag), table, found, expansion)
    picture = io.BytesIO()
    value_figure.draw(results, picture)
    arguments.write_files(out, {TABLE: text.encode(), FIGURE: picture.getvalue()})
    console.print(f"\n{out / TABLE}, {out / FIGURE}", soft_wrap=True, highlight=False, markup=False)
    return DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv))
